"""Where a ring in the left picture truly lies on a bench, and how far its kerf is from coming through."""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from firmware_sim.bench import Bench
from firmware_sim.optics import draw_eyes
from firmware_sim.skull import Skull
from firmware_sim.specimen import Specimen

Floats = npt.NDArray[np.float64]

UNTOUCHED_MM: Final = 5.0
_REACH_MM: Final = 6.0
"""From the skull's middle to the farthest place that a ring may lie."""


def through_z_mm(specimen: Specimen, skull: Skull, xy_mm: Floats) -> Floats:
    """(n,) height of the ball's centre, over places (n, 2), at which it comes through the inner surface somewhere."""
    radius = specimen.tool.ball_radius_mm + specimen.rig.run_out_mm
    side = np.linspace(-radius, radius, 41)
    dx, dy = (axis.ravel() for axis in np.meshgrid(side, side))
    inside = np.hypot(dx, dy) < radius
    dx, dy = dx[inside], dy[inside]
    cap = np.sqrt(radius**2 - dx**2 - dy**2)
    inner = skull.grid.sample(skull.inner_z, xy_mm[:, :1] + dx, xy_mm[:, 1:] + dy)
    return np.asarray(np.nanmax(inner + cap, axis=1))


class RingTruth:
    """The places (n, 2) of {R} that the left eye sees at ring pixels (n, 2), and their bone."""

    def __init__(self, bench: Bench, ring_px: Floats) -> None:
        self._bench = bench
        skull, specimen = bench.machine.skull, bench.specimen
        xs, ys = (axis.ravel() for axis in np.broadcast_arrays(*skull.grid.coordinates()))
        middle = specimen.skull.center_mm
        near = (np.hypot(xs - middle[0], ys - middle[1]) < _REACH_MM) & np.isfinite(skull.outer_z.ravel())
        points = np.column_stack([xs[near], ys[near], skull.outer_z.ravel()[near]])
        seen = draw_eyes(specimen.rig)[0].project(points)
        self.xy_mm = points[cKDTree(seen).query(ring_px)[1], :2]
        self._radius_mm = specimen.tool.ball_radius_mm + specimen.rig.run_out_mm
        self._through_z_mm = through_z_mm(specimen, skull, self.xy_mm)

    def excess_mm(self) -> Floats:
        """(n,) how far the ball has come past the inner surface; negative above it, ``-UNTOUCHED_MM`` at the start."""
        skull = self._bench.machine.skull
        top = skull.grid.sample(skull.top_z, self.xy_mm[:, 0], self.xy_mm[:, 1])
        uncut = skull.grid.sample(skull.outer_z, self.xy_mm[:, 0], self.xy_mm[:, 1])
        excess = self._through_z_mm - (top + self._radius_mm)
        return np.where(uncut - top > 1e-4, excess, -UNTOUCHED_MM)
