"""Where the drill's ball and the skull's landmarks are in a picture, and how sure that is."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from vision.runtime import WEIGHTS, Floats, Image, Network

CELL_PX = 2.0
"""The network answers on a grid of 2 x 2 pixels; the centre of the first cell lies at pixel 0.5."""
WINDOW_CELLS = 5
"""Half the side of the window round the peak that the place is averaged over."""
PICTURE_PX = (960, 540)
"""Width and height of the pictures that the networks are made for."""
SPAN_MM = 4.2
"""From bregma to lambda: turns px into mm where a picture has no scale of its own."""
BORDER = 128
"""Grey round a picture of other proportions."""
VISIBLE_FROM = 0.5
"""Least probability with which a point counts as visible."""


@dataclass(frozen=True)
class Keypoint:
    """A point in a picture; pixel centres have whole coordinates."""

    x_px: float
    y_px: float
    sigma_px: float
    """Standard deviation per axis."""
    score: float
    """Probability that the point is visible at all."""
    visible: bool
    """False: the place means nothing, the point is outside the picture or hidden."""


class Finder:
    """One network that finds a fixed number of points."""

    task: str
    weights: Path

    def __init__(self, network: Network) -> None:
        self._network = network
        self.sha256 = network.sha256
        self.sigma_scale = network.constants.get("sigma_scale", 1.0)

    @classmethod
    def load(cls, weights: Path | None = None) -> Self:
        """Read the weights, those that come with mill unless told otherwise.

        Raises:
            ConfigError: they are missing, or not what their manifest says.
        """
        return cls(Network(weights or cls.weights, cls.task))

    def find_all(self, image: Image) -> list[Keypoint]:
        """Every point this network knows, in its order.

        Raises:
            DetectionError: a picture of another size than the network is made for.
        """
        raise NotImplementedError


class TipFinder(Finder):
    """Finds the drill's tip: the projection of its ball's centre."""

    task = "tip"
    weights = WEIGHTS / "tip.onnx"

    def find(self, image: Image) -> Keypoint:
        """The centre of the ball; ``visible=False`` where there is no drill in the picture."""
        (tip,) = self.find_all(image)
        return tip

    def find_all(self, image: Image) -> list[Keypoint]:
        """The tip alone.

        Raises:
            DetectionError: a picture of another size than the network is made for.
        """
        corners, maps = self._network.run(picture=np.ascontiguousarray(image))
        return [decode(maps[0], corners[0], sigma_scale=self.sigma_scale)]


class LandmarkFinder(Finder):
    """Finds bregma and lambda on the skull."""

    task = "landmarks"
    weights = WEIGHTS / "landmarks.onnx"

    def find(self, image: Image) -> tuple[Keypoint, Keypoint]:
        """Bregma and lambda, in this order."""
        bregma, lambda_ = self.find_all(image)
        return bregma, lambda_

    def find_all(self, image: Image) -> list[Keypoint]:
        """Bregma and lambda, from a picture of any size: the close views agree on the place, or their spread tells."""
        picture, scale, corner = letterboxed(image)
        places, log_sigmas, visibles = self._network.run(picture=picture)
        found = []
        for k in range(places.shape[1]):
            place = (np.median(places[:, k], axis=0) - corner) / scale
            spread = places[:, k].astype(np.float64).std(axis=0).mean()
            sigma = np.hypot(np.exp(np.median(log_sigmas[:, k])), spread) * self.sigma_scale / scale
            score = float(1.0 / (1.0 + np.exp(-np.median(visibles[:, k]))))
            found.append(Keypoint(float(place[0]), float(place[1]), float(sigma), score, visible=score >= VISIBLE_FROM))
        return found


def letterboxed(image: Image) -> tuple[Image, float, npt.NDArray[np.float64]]:
    """A picture of any size brought to the network's, whole and with its proportions.

    Returns:
        The picture, its scale, and where its first pixel lies: px there = scale * px here + corner.
    """
    width, height = PICTURE_PX
    scale = min(width / image.shape[1], height / image.shape[0])
    if scale == 1.0 and image.shape[:2] == (height, width):
        return np.ascontiguousarray(image), 1.0, np.zeros(2)
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    small = cv2.resize(image, (round(image.shape[1] * scale), round(image.shape[0] * scale)), interpolation=way)
    left, top = (width - small.shape[1]) // 2, (height - small.shape[0]) // 2
    result = np.full((height, width, 3), BORDER, np.uint8)
    result[top : top + small.shape[0], left : left + small.shape[1]] = small
    # Pixel centres have whole coordinates, so scaling moves the origin by half a pixel.
    return result, scale, np.array([left, top]) + (scale - 1.0) / 2.0


def decode(maps: Floats, corner_px: npt.NDArray[Any], *, sigma_scale: float = 1.0) -> Keypoint:
    """The point that the three maps (log-probability, log of sigma in px, logit of visible) of a crop speak of.

    The place is the mean over a window round the peak, which is exact for a peak that fits into it.

    Args:
        maps: (3, h, w).
        corner_px: x and y of the crop's first pixel.
        sigma_scale: what held-out pictures say the predicted sigma must be multiplied with.
    """
    heat, log_sigma, visible = (np.asarray(plane, dtype=np.float64) for plane in maps)
    row, column = np.unravel_index(int(heat.argmax()), heat.shape)
    rows = slice(max(int(row) - WINDOW_CELLS, 0), int(row) + WINDOW_CELLS + 1)
    columns = slice(max(int(column) - WINDOW_CELLS, 0), int(column) + WINDOW_CELLS + 1)
    weight = np.exp(heat[rows, columns] - heat[row, column])
    weight /= weight.sum()
    y_cell, x_cell = np.mgrid[rows, columns][:, : weight.shape[0], : weight.shape[1]]
    probability = float(1.0 / (1.0 + np.exp(-(weight * visible[rows, columns]).sum())))
    return Keypoint(
        x_px=float(corner_px[0] + (weight * x_cell).sum() * CELL_PX + 0.5),
        y_px=float(corner_px[1] + (weight * y_cell).sum() * CELL_PX + 0.5),
        sigma_px=float(np.exp((weight * log_sigma[rows, columns]).sum()) * sigma_scale),
        score=probability,
        visible=probability >= VISIBLE_FROM,
    )
