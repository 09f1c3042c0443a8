"""The ring unrolled: a strip of the picture that follows the kerf, as wide as the ball needs, always of one shape.

Along the strip a ring of any radius has ``ALONG_PX`` columns; across it, from the inside outwards, a pixel always is
the same share of the ball's radius. So one small network reads every ring, and a kerf always looks equally wide.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from vision.runtime import Image

ACROSS_PX = 48
ALONG_PX = 320
BALL_PX = 12.5
"""Radius of the ball in the strip."""
CELL_PX = (2, 4)
"""A cell of the network's answer, across and along."""
CELLS = (ACROSS_PX // CELL_PX[0], ALONG_PX // CELL_PX[1])

REACH_PX = 1.5
"""A pixel of the picture this near to one of the strip is covered by it: on large rings those lie 2 px apart."""

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Strip:
    """Where each pixel of the strip lies in the picture."""

    x_px: npt.NDArray[np.float32]
    """(across, along) column in the picture."""
    y_px: npt.NDArray[np.float32]
    """(across, along) row in the picture."""
    _painted: dict[tuple[int, int], tuple[Indices, Indices]] = field(default_factory=dict, repr=False)

    def cut(self, image: Image) -> Image:
        """(across, along, 3): the picture along the ring."""
        strip = cv2.remap(image, self.x_px, self.y_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(strip, dtype=np.uint8)

    def of_plane(self, plane: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(across, along): values of a map of the picture along the ring, the nearest ones; 0 outside the picture."""
        return np.asarray(cv2.remap(plane, self.x_px, self.y_px, cv2.INTER_NEAREST), dtype=np.float32)

    def painted(self, cells: npt.NDArray[np.float32], shape: tuple[int, int]) -> npt.NDArray[np.float32]:
        """(h, w): a map of the strip's ``CELLS`` laid back into a picture of ``shape``; 0 off the strip."""
        if shape not in self._painted:
            self._painted[shape] = self._pixels(shape)
        pixels, cell = self._painted[shape]
        picture = np.zeros(shape, np.float32)
        picture.ravel()[pixels] = cells.ravel()[cell]
        return picture

    def _pixels(self, shape: tuple[int, int]) -> tuple[Indices, Indices]:
        """Pixels of a picture that the strip covers, and the cell that each shows."""
        points = np.stack([self.x_px.ravel(), self.y_px.ravel()], axis=1)
        low = np.maximum(np.floor(points.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(points.max(axis=0)).astype(int) + 1, shape[::-1])
        rows, columns = (axis.ravel() for axis in np.mgrid[low[1] : high[1], low[0] : high[0]])
        away_px, nearest = KDTree(points).query(np.stack([columns, rows], axis=1), distance_upper_bound=REACH_PX)
        near = np.isfinite(away_px)
        across, along = np.divmod(np.asarray(nearest)[near], ALONG_PX)
        return rows[near] * shape[1] + columns[near], across // CELL_PX[0] * CELLS[1] + along // CELL_PX[1]


def unroll(ring_px: Floats, ball_px: float, *, across_px: int = ACROSS_PX) -> Strip:
    """The strip along a closed ring.

    Args:
        ring_px: (n, 2) points of the ring in the picture, in order, n >= 3, at equal shares of the way round.
        ball_px: radius of the ball at the picture's scale.
        across_px: rows of the strip.

    Point i of n is in the middle of cell ``i * CELLS[1] / n``, see ``cells_at``.
    """
    n = len(ring_px)
    around = CubicSpline(np.arange(n + 1) / n, np.vstack([ring_px, ring_px[:1]]), bc_type="periodic")
    share = (np.arange(ALONG_PX) - (CELL_PX[1] - 1) / 2) / ALONG_PX % 1.0
    place, along = around(share), around(share, 1)
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    if np.sum((place - place.mean(axis=0)) * outward) < 0:
        outward = -outward
    rows = (np.arange(across_px) - (across_px - 1) / 2) * ball_px / BALL_PX
    points = (place[None] + rows[:, None, None] * outward[None]).astype(np.float32)
    return Strip(np.ascontiguousarray(points[..., 0]), np.ascontiguousarray(points[..., 1]))


def cells_at(n: int) -> Floats:
    """(n,) where the points of a ring are along the strip, in cells."""
    return np.arange(n) * CELLS[1] / n


def at_points(values: npt.NDArray[np.floating], n: int) -> Floats:
    """(..., n) values at the points of a ring, from (..., cells along) round it."""
    place = cells_at(n)
    before = np.floor(place).astype(int)
    share = place - before
    after = (before + 1) % CELLS[1]
    return np.asarray(values[..., before] * (1 - share) + values[..., after] * share, dtype=np.float64)
