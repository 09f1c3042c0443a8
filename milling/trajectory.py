"""The ring: where its centre is, its points on the surface, and the tip positions above them.

theta_i = 2 pi i / n for i = 1..n; the ball's centre starts at p_fit + (r_d + delta_d) n, so the offset along the
normal moves x and y as well. The ball's centre is what the offset speaks of and what the eyes see; the machine moves
the tip, and ``center_from_tip_mm`` joins the two.
"""

from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline

from drivers.errors import PlanError
from drivers.motion.interface import Travel
from drivers.recorder import Recorder
from milling.job import Job
from milling.spline import periodic_spline
from milling.surface import Surface

Floats = npt.NDArray[np.float64]

PREDICTED_SIGMAS = 2.0
"""The predicted error that is held against the safety offset: 95 % of cases."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """n points of a closed ring, in the order they are milled. All arrays (n, ...) in {R}, mm."""

    center_mm: Floats
    theta_rad: Floats
    fit_mm: Floats
    normals: Floats
    sigma_mm: Floats
    offset_mm: float
    """The gap between ball and fitted surface at the start; at least the job's."""
    ball_mm: Floats
    """Centre of the ball at the start, p_ini."""
    tip_mm: Floats
    """The same as positions of the drill's tip: what the machine is sent."""
    contact_z_mm: Floats
    """(n,) height of the tip at which the ball, going straight down from its start, should meet the bone."""
    note: str = ""

    @property
    def n(self) -> int:
        """Number of points."""
        return len(self.theta_rad)

    @cached_property
    def path(self) -> CubicHermiteSpline:
        """X and y of the tip over arc length; closed."""
        return closed_path(self.theta_rad, self.tip_mm[:, :2])

    @property
    def length_mm(self) -> float:
        """Length of one lap."""
        return float(self.path.x[-1])

    @property
    def pitch_mm(self) -> float:
        """Mean arc length from point to point."""
        return self.length_mm / self.n

    @property
    def knots_mm(self) -> Floats:
        """(n,) arc length at the points; the first is 0."""
        return np.asarray(self.path.x[:-1], dtype=np.float64)

    def tell(self, recorder: Recorder, **more: Any) -> None:
        """Enter it into the record, whole."""
        recorder.event(
            "trajectory",
            center_mm=self.center_mm,
            ball_mm=self.ball_mm,
            tip_mm=self.tip_mm,
            fit_mm=self.fit_mm,
            normals=self.normals,
            sigma_mm=self.sigma_mm,
            contact_z_mm=self.contact_z_mm,
            offset_mm=self.offset_mm,
            note=self.note,
            **more,
        )

    def lowest_tip_z_mm(self, depth_mm: float) -> float:
        """The lowest tip height that ``depth_mm`` below the fitted surface can need, predicted error included."""
        return float(np.min(self.contact_z_mm - depth_mm - PREDICTED_SIGMAS * self.sigma_mm))


def closed_path(theta_rad: Floats, xy_mm: Floats) -> CubicHermiteSpline:
    """The closed curve through points (n, 2) at angles (n,), over its arc length."""
    rough = periodic_spline(theta_rad, xy_mm, 2 * pi)
    fine = np.linspace(theta_rad[0], theta_rad[0] + 2 * pi, 64 * len(theta_rad) + 1)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rough(fine), axis=0), axis=1))])
    return periodic_spline(along[:-1:64], xy_mm, float(along[-1]))


def plan(
    surface: Surface, center_mm: Floats, job: Job, center_from_tip_mm: Floats, travel: Travel, *, flat: bool = False
) -> Trajectory:
    """The initial trajectory, checked against everything that can be known before milling.

    Args:
        surface: the reconstructed patch; it must hold the whole ring.
        center_mm: p_c on the surface.
        job: radius, points, offsets.
        center_from_tip_mm: from the tip to the ball's centre.
        travel: the machine's.
        flat: start every point at one height, above the ring's highest (policy ``previous``).

    Raises:
        PlanError: the ring leaves the travel or the surface, or its error cannot be covered by the safety offset.
    """
    theta = 2 * pi * np.arange(1, job.n_points + 1) / job.n_points
    xy = center_mm[:2] + job.radius_mm * np.stack([np.cos(theta), np.sin(theta)], axis=1)
    z, sigma = surface.height(xy)
    fit = np.column_stack([xy, z])
    offset, note = _offset(sigma, job)
    normals = surface.normal(xy)
    if flat:
        ball = np.column_stack([xy, np.full(job.n_points, z.max() + job.ball_radius_mm + offset)])
        touching = fit[:, 2] + job.ball_radius_mm / normals[:, 2]
    else:
        ball = fit + (job.ball_radius_mm + offset) * normals
        touching = ball[:, 2] - offset / normals[:, 2]
    trajectory = Trajectory(
        center_mm=np.asarray(center_mm, dtype=np.float64),
        theta_rad=theta,
        fit_mm=fit,
        normals=normals,
        sigma_mm=sigma,
        offset_mm=offset,
        ball_mm=ball,
        tip_mm=ball - center_from_tip_mm,
        contact_z_mm=touching - center_from_tip_mm[2],
        note=note,
    )
    check(trajectory, job, travel)
    return trajectory


def check(trajectory: Trajectory, job: Job, travel: Travel) -> None:
    """Refuse a trajectory that must not be milled.

    Raises:
        PlanError: NaN, a step that is too large, a slope that no window has, or a point outside the travel.
    """
    tip = trajectory.tip_mm
    if not np.all(np.isfinite(tip)):
        raise PlanError(f"the trajectory holds NaN at points {_names(~np.isfinite(tip).all(axis=1))}; nothing moves")
    pitch = 2 * pi * job.radius_mm / job.n_points
    steps = np.linalg.norm(np.diff(tip, axis=0, append=tip[:1]), axis=1)
    if steps.max() > 2.0 * pitch:
        raise PlanError(
            f"points {_names(steps > 2.0 * pitch)}: {steps.max():.2f} mm to the next, allowed {2.0 * pitch:.2f} mm; "
            "the reconstructed surface is broken there: check light and glare, then try again"
        )
    lean = np.arccos(np.clip(trajectory.normals[:, 2], -1.0, 1.0))
    if lean.max() > np.radians(50):
        raise PlanError(
            f"points {_names(lean > np.radians(50))}: the surface leans {np.degrees(lean.max()):.0f} deg, "
            "allowed 50 deg; level the skull"
        )
    lowest = trajectory.lowest_tip_z_mm(job.thickness_high_mm)
    corners = np.vstack([tip, np.column_stack([tip[:, :2], np.full(len(tip), lowest)])])
    for index, corner in enumerate(corners):
        point = (float(corner[0]), float(corner[1]), float(corner[2]))
        if not travel.contains(point):
            raise PlanError(
                f"point {index % trajectory.n + 1} at {tuple(round(v, 3) for v in point)} mm is outside the travel "
                f"{travel.low_mm} to {travel.high_mm} mm; move the skull"
            )


def _offset(sigma: Floats, job: Job) -> tuple[float, str]:
    worst = PREDICTED_SIGMAS * float(sigma.max())
    if not np.isfinite(worst):
        raise PlanError("the predicted error of the trajectory is not finite; calibrate again")
    if worst <= job.safety_offset_mm:
        return job.safety_offset_mm, ""
    at = int(sigma.argmax()) + 1
    if worst <= job.max_safety_offset_mm:
        return worst, (
            f"the predicted error at point {at} is {worst:.2f} mm (95 %), more than the safety offset of "
            f"{job.safety_offset_mm:g} mm: the offset is raised to it"
        )
    raise PlanError(
        f"the predicted error at point {at} is {worst:.2f} mm (95 %), allowed {job.max_safety_offset_mm:g} mm "
        "(max_safety_offset_mm); calibrate again"
    )


def _names(which: npt.ArrayLike) -> str:
    return ", ".join(str(int(index) + 1) for index in np.flatnonzero(which))
