"""How far the ring is milled, read from the picture now and the picture of the unmilled skull, both unrolled."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from vision.runtime import WEIGHTS, Image, Network
from vision.strip import ACROSS_PX, CELL_PX, CELLS, Strip, at_points, unroll

MARGIN = "upper_margin"
"""Constant of the network: what is added to its bound, so that held-out truth stays below."""
MISSING = 128
"""Grey that stands for a reference picture that does not exist."""
DRILL_NOT_EXCLUDED = 0.05
"""Probability of the drill from which a point counts as hidden. A point that waits for a better picture costs a frame;
a reading of the drill's own surface could cost more. Chosen on validation data."""
HOLE_NOT_EXCLUDED = 0.1
"""Probability of a hole from which the upper bound is 1, whatever else the network says. Chosen on validation data."""
HOLE_SEEN = 0.5
"""Probability of a hole from which the best estimate is through."""
THROUGH = 0.995
"""From here on a completion means "through". A hole is seen as such: thin bone over the bed looks different."""
THIN = 0.99
"""The most that bone without a hole in it is said to be milled."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CompletionReading:
    """What one picture says about the ring. Completion is the share of the thickness that is gone; 1 is through."""

    completion: Floats
    """(n,) best estimate, 0..1."""
    upper: Floats
    """(n,) bound that the truth exceeds in at most 2.5 % of cases; never below ``completion``."""
    visible: npt.NDArray[np.bool_]
    """(n,) False where something like a drill hides it or it lies outside the picture. Who knows that the drill is far
    away (``milling.eyes``) may read the others all the same."""
    kerf: npt.NDArray[np.float32]
    """Logit of kerf at each cell of the strip."""
    depth: npt.NDArray[np.float32]
    """Completion at each cell of the strip, whether there is a kerf or not."""
    strip: Strip
    """Where the strip lies in the picture."""
    shape: tuple[int, int]
    """Height and width of the picture."""

    @cached_property
    def box_px(self) -> tuple[float, float, float, float] | None:
        """x0, y0, x1, y1 of the kerf in the picture; None while there is none."""
        return box_of(self.kerf, self.strip)

    @cached_property
    def heat_map(self) -> npt.NDArray[np.float32]:
        """(h, w) completion everywhere in the picture; 0 where there is no kerf."""
        return self.strip.painted(np.where(self.kerf > 0, self.depth, 0.0).astype(np.float32), self.shape)


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
            ConfigError: they are missing, not what their manifest says, or without a bound, so that nothing may be
                milled by them.
        """
        network = Network(weights or cls.weights, "completion")
        if MARGIN not in network.constants:
            raise ConfigError(
                f"{network.path}: has no {MARGIN}, and its readings no bound: it is for comparison only; "
                f"train one by the default recipe: mill train completion --out {network.path}"
            )
        return cls(network)

    def over(self, ring_px: Floats, ball_px: float, *, reference: Image | None) -> "RingReader":
        """A reader of one ring.

        Args:
            ring_px: (n, 2) the ring's points, at equal shares of the way round, as projected from the unmilled surface.
            ball_px: radius of the ball at the picture's scale there.
            reference: the picture taken just before milling; without one the readings are less sure.
        """
        return RingReader(self._network, ring_px, ball_px, reference)


class RingReader:
    """Reads one ring from picture after picture."""

    def __init__(self, network: Network, ring_px: Floats, ball_px: float, reference: Image | None) -> None:
        self._network = network
        self._ring_px = ring_px
        self._strip = unroll(ring_px, ball_px)
        before = np.full((*self._strip.x_px.shape, 3), MISSING, np.uint8)
        if reference is not None:
            before = self._strip.cut(reference)
        self._strips = np.concatenate([before, before], axis=2)[None]

    def read(self, image: Image) -> CompletionReading:
        """Read the completion at each point of the ring.

        Raises:
            DetectionError: the network's answer is not a number.
        """
        self._strips[0, ..., :3] = self._strip.cut(image)
        (line,), (maps,) = self._network.run(strips=self._strips)
        n = len(self._ring_px)
        completion, upper, drill, hole = at_points(line, n)
        margin = self._network.constants.get(MARGIN, 0.0)
        completion, upper = bounded(completion, upper + margin, probability(hole))
        limit = np.array([image.shape[1], image.shape[0]]) - 1
        inside = ((self._ring_px >= 0) & (self._ring_px <= limit)).all(axis=1)
        visible = inside & (probability(drill) < DRILL_NOT_EXCLUDED)
        return CompletionReading(completion, upper, visible, maps[0], maps[1], self._strip, image.shape[:2])


def bounded(completion: Floats, upper: Floats, hole: Floats) -> tuple[Floats, Floats]:
    """Estimate and upper bound, once the network's probability of a hole has its say.

    How thin bone is shows in its colour only roughly; whether there is a hole in it shows plainly. So "through" is
    said by the hole alone, and denied only where a hole is excluded.
    """
    completion = np.where(hole >= HOLE_SEEN, np.clip(completion, THROUGH, 1.0), np.clip(completion, 0.0, THIN))
    upper = np.where(hole >= HOLE_NOT_EXCLUDED, 1.0, np.clip(upper, 0.0, THIN))
    return completion, np.maximum(upper, completion)


def probability(logit: Floats) -> Floats:
    """Of a logit."""
    return np.asarray(1.0 / (1.0 + np.exp(-logit)), dtype=np.float64)


def box_of(kerf: npt.NDArray[np.floating], strip: Strip) -> tuple[float, float, float, float] | None:
    """x0, y0, x1, y1 in the picture round the cells of the strip where ``kerf`` is above 0; None where none is.

    The border lies where ``kerf`` passes through 0 between two cells across the strip.
    """
    columns = np.flatnonzero((kerf > 0).any(axis=0))
    if len(columns) == 0:
        return None
    rows = np.arange(CELLS[0])
    there = kerf[:, columns] > 0
    first, last = there.argmax(axis=0), CELLS[0] - 1 - there[::-1].argmax(axis=0)
    edges = []
    for edge, beyond in ((first, first - 1), (last, last + 1)):
        inner = kerf[edge, columns]
        outer = kerf[np.clip(beyond, 0, CELLS[0] - 1), columns]
        share = np.where((beyond >= 0) & (beyond < CELLS[0]), inner / np.maximum(inner - outer, 1e-6), 0.5)
        edges.append(rows[edge] + (beyond - edge) * share)
    across = (np.concatenate(edges) * CELL_PX[0] + (CELL_PX[0] - 1) / 2).astype(np.float32)
    along = np.tile(columns * CELL_PX[1] + (CELL_PX[1] - 1) / 2, 2).astype(np.float32)
    x, y = (_at(plane, across, along) for plane in (strip.x_px, strip.y_px))
    return float(x.min()), float(y.min()), float(x.max()), float(y.max())


def _at(plane: npt.NDArray[np.float32], rows: npt.NDArray[np.float32], columns: npt.NDArray[np.float32]) -> Floats:
    rows = np.clip(rows, 0, ACROSS_PX - 1)
    return np.asarray(cv2.remap(plane, columns[:, None], rows[:, None], cv2.INTER_LINEAR)[:, 0], dtype=np.float64)
