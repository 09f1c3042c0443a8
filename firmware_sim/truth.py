"""What only a scorer may ask of the world: how far the ring is milled, and what harm was done."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from firmware_sim.skull import Array, Skull

FREED_BELOW_MM: Final = 0.030
FREE_RING_SHARE: Final = 0.95
RING_SEARCH_MM: Final = 0.3


@dataclass(frozen=True)
class Truth:
    """What a scorer may know. Angles are about ``center_mm`` from +x of {R} towards +y."""

    center_mm: tuple[float, float]
    radius_mm: float
    angles_rad: Array
    completion: Array
    remaining_mm: Array
    depth_mm: Array
    flap_free: bool
    membrane_touched: bool
    membrane_touched_at_s: float | None
    membrane_touched_mm: tuple[float, float, float] | None
    membrane_overrun_mm: float
    heat_rise_c: float
    greatest_force_n: float

    @property
    def success(self) -> bool:
        """The flap can be lifted, and the membrane was never touched."""
        return self.flap_free and not self.membrane_touched


@dataclass(frozen=True)
class RingState:
    """The kerf at each angle round ``center_mm``, read where across it the least bone is left."""

    angles_rad: Array
    completion: Array
    remaining_mm: Array
    depth_mm: Array

    @property
    def freed_share(self) -> float:
        """Share of the ring that holds the flap no more."""
        return float(np.mean(self.remaining_mm <= FREED_BELOW_MM))


def read_ring(skull: Skull, center_mm: Array, radius_mm: float, n: int) -> RingState:
    """The kerf at ``n`` angles."""
    angles = np.arange(n, dtype=float) * (2 * np.pi / n)
    across = radius_mm + np.linspace(-RING_SEARCH_MM, RING_SEARCH_MM, 31)
    x = center_mm[0] + across[:, None] * np.cos(angles)
    y = center_mm[1] + across[:, None] * np.sin(angles)
    remaining = np.nan_to_num(skull.remaining_at(x, y), nan=np.inf)
    best = remaining.argmin(axis=0), np.arange(n)
    depth = skull.grid.sample(skull.outer_z, x[best], y[best]) - skull.grid.sample(skull.top_z, x[best], y[best])
    return RingState(np.asarray(angles), skull.completion_at(x[best], y[best]), remaining[best], depth)


def fit_ring(path_xy_mm: Array, middle_mm: Array) -> tuple[Array, float]:
    """Least-squares circle through (n, 2) where the ball cut; 2 mm round ``middle_mm`` before there was any cut."""
    if len(path_xy_mm) < 20:
        return middle_mm, 2.0
    xy = path_xy_mm - middle_mm
    a = np.column_stack([2 * xy, np.ones(len(xy))])
    solution, *_ = np.linalg.lstsq(a, (xy**2).sum(axis=1), rcond=None)
    radius = math.sqrt(max(1e-6, float(solution[2] + solution[:2] @ solution[:2])))
    return middle_mm + solution[:2], min(radius, 6.0)


def disc(radius_mm: float) -> Array:
    """Offsets (n, 2) that fill a disc about every 0.03 mm."""
    if radius_mm <= 0.0:
        return np.zeros((1, 2))
    steps = np.linspace(-radius_mm, radius_mm, 2 * max(1, round(radius_mm / 0.03)) + 1)
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.asarray(points[np.hypot(*points.T) <= radius_mm + 1e-9], float)
