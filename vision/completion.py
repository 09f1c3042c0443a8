"""How far the ring is milled, read from the picture now and the picture of the unmilled skull.

The crop round the ring is scaled so that the ring's radius always is ``RING_PX``: one network serves every radius.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

from vision.runtime import WEIGHTS, Floats, Image, Network

RING_PX = 48.0
"""Radius of the ring in the network's crop."""
CROP_PX = 160
CELL_PX = 2.0
MISSING = 128
"""Grey that stands for a reference picture that does not exist."""
DRILL_NOT_EXCLUDED = 0.12
"""Probability of the drill from which a point counts as hidden. A point that waits for a better picture costs a frame;
a reading of the drill's own surface could cost more. Chosen on validation data."""
HOLE_NOT_EXCLUDED = 0.2
"""Probability of a hole from which the upper bound is 1, whatever else the network says."""
HOLE_SEEN = 0.5
"""Probability of a hole from which the best estimate is through."""
THROUGH = 0.995
"""From here on a completion means "through". A hole is seen as such: thin bone over the bed looks different."""
THIN = 0.99
"""The most that bone without a hole in it is said to be milled."""


@dataclass(frozen=True)
class CompletionReading:
    """What one picture says about the ring. Completion is the share of the thickness that is gone; 1 is through."""

    completion: npt.NDArray[np.float64]
    """(n,) best estimate, 0..1."""
    upper: npt.NDArray[np.float64]
    """(n,) bound that the truth exceeds in at most 2.5 % of cases; never below ``completion``."""
    visible: npt.NDArray[np.bool_]
    """(n,) False where the drill hides it or it lies outside the picture: its other figures mean nothing."""
    box_px: tuple[float, float, float, float] | None
    """x0, y0, x1, y1 of the kerf in the picture; None while there is none."""
    heat_map: npt.NDArray[np.float32]
    """(h, w) completion everywhere in the crop."""
    image_from_heat: npt.NDArray[np.float64]
    """(2, 3) affine from (column, row) of the heat map to pixels of the picture."""


class CompletionReader:
    """The completion network, loaded once."""

    weights = WEIGHTS / "completion.onnx"

    def __init__(self, network: Network) -> None:
        self._network = network
        self.sha256 = network.sha256

    @classmethod
    def load(cls, weights: Path | None = None) -> Self:
        """Read the weights, those that come with mill unless told otherwise.

        Raises:
            ConfigError: they are missing, or not what their manifest says.
        """
        return cls(Network(weights or cls.weights, "completion"))

    def read(
        self, image: Image, ring_px: npt.NDArray[np.float64], radius_px: float, *, reference: Image | None
    ) -> CompletionReading:
        """Read the completion at each point of the ring.

        Args:
            image: the left picture now.
            ring_px: (n, 2) the ring's points, as projected from the unmilled surface.
            radius_px: the ring's radius at the picture's mean scale.
            reference: the left picture taken just before milling; without one the reading is less sure.
        """
        crop_from_image = crop_affine(ring_px, radius_px)
        before = None if reference is None else cut(reference, crop_from_image)
        crop = stacked(cut(image, crop_from_image), before)
        maps = np.asarray(self._network.run(crops=crop[None])[0][0], dtype=np.float32)
        cells = cell_from_crop(ring_px @ crop_from_image[:, :2].T + crop_from_image[:, 2])
        completion, upper, _, drill, through = (sample(plane, cells) for plane in maps)
        margin = self._network.constants.get("upper_margin", 0.0)
        completion, upper = bounded(completion, upper + margin, probability(through))
        height, width = image.shape[:2]
        inside = (ring_px >= 0).all(axis=1) & (ring_px[:, 0] <= width - 1) & (ring_px[:, 1] <= height - 1)
        image_from_heat = _image_from_heat(crop_from_image)
        return CompletionReading(
            completion=completion,
            upper=upper,
            visible=inside & (probability(drill) < DRILL_NOT_EXCLUDED),
            box_px=_box(maps[2] > 0.0, image_from_heat),
            heat_map=np.where(maps[2] > 0.0, maps[0], 0.0).astype(np.float32),
            image_from_heat=image_from_heat,
        )


def bounded(
    completion: npt.NDArray[np.float64], upper: npt.NDArray[np.float64], hole: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Estimate and upper bound, once the network's probability of a hole has its say.

    How thin bone is shows in its colour only roughly; whether there is a hole in it shows plainly. So "through" is
    said by the hole alone, and denied only where a hole is excluded.
    """
    completion = np.where(hole >= HOLE_SEEN, np.clip(completion, THROUGH, 1.0), np.clip(completion, 0.0, THIN))
    upper = np.where(hole >= HOLE_NOT_EXCLUDED, 1.0, np.clip(upper, 0.0, THIN))
    return completion, np.maximum(upper, completion)


def crop_affine(
    ring_px: npt.NDArray[np.float64], radius_px: float, *, side_px: int = CROP_PX
) -> npt.NDArray[np.float64]:
    """(2, 3) map from the picture into a crop that has the ring in its middle, ``RING_PX`` in radius."""
    center = (ring_px.min(axis=0) + ring_px.max(axis=0)) / 2.0
    scale = RING_PX / radius_px
    middle = (side_px - 1) / 2.0
    return np.array([[scale, 0.0, middle - scale * center[0]], [0.0, scale, middle - scale * center[1]]])


def cut(image: Image, crop_from_image: npt.NDArray[np.float64], *, side_px: int = CROP_PX) -> Image:
    """The crop; smoothed first where it shrinks the picture, so that fine texture does not alias."""
    scale = float(crop_from_image[0, 0])
    if scale < 0.8:
        image = cv2.GaussianBlur(image, (0, 0), 0.4 / scale).astype(np.uint8)
    crop = cv2.warpAffine(
        image, crop_from_image, (side_px, side_px), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return crop.astype(np.uint8)


def stacked(now: Image, before: Image | None) -> Image:
    """(S, S, 6): the picture now and the one before milling."""
    if before is None:
        before = np.full_like(now, MISSING)
    return np.concatenate([now, before], axis=2)


def cell_from_crop(points_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Pixels of the crop to cells of the maps."""
    return (points_px - 0.5) / CELL_PX


def sample(plane: Floats, cells: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Bilinear values of a map at (n, 2) places."""
    x, y = (cells[:, axis].astype(np.float32).reshape(-1, 1) for axis in (0, 1))
    return cv2.remap(plane.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0].astype(
        np.float64
    )


def probability(logit: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Of a logit."""
    return np.asarray(1.0 / (1.0 + np.exp(-logit)), dtype=np.float64)


def _image_from_heat(crop_from_image: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    image_from_crop = cv2.invertAffineTransform(crop_from_image)
    crop_from_cell = np.array([[CELL_PX, 0.0, 0.5], [0.0, CELL_PX, 0.5], [0.0, 0.0, 1.0]])
    return np.asarray(image_from_crop @ crop_from_cell, dtype=np.float64)


def box_of(kerf: npt.NDArray[np.bool_]) -> tuple[float, float, float, float] | None:
    """x0, y0, x1, y1 round the cells that are True, in cells; None where none is."""
    rows, columns = np.nonzero(kerf)
    if len(rows) == 0:
        return None
    x0, y0, x1, y1 = columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5
    return float(x0), float(y0), float(x1), float(y1)


def _box(
    kerf: npt.NDArray[np.bool_], image_from_heat: npt.NDArray[np.float64]
) -> tuple[float, float, float, float] | None:
    box = box_of(kerf)
    if box is None:
        return None
    (x0, y0), (x1, y1) = np.array(box).reshape(2, 2) @ image_from_heat[:, :2].T + image_from_heat[:, 2]
    return (float(x0), float(y0), float(x1), float(y1))
