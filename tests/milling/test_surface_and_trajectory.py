"""From points in space to tip positions, on surfaces whose truth is a formula; and the errata that lie here."""

from math import pi

import numpy as np
import numpy.typing as npt
import pytest

from drivers.errors import DetectionError, PlanError
from drivers.motion.interface import Travel
from milling.job import Job
from milling.surface import Surface, fit_surface, point_at
from milling.trajectory import Trajectory, plan

Array = npt.NDArray[np.float64]
CENTER = np.array([5.0, -10.0])
TRAVEL = Travel((-10.0, -30.0, -8.0), (25.0, 10.0, 20.0))
AXIS = np.array([np.sin(np.radians(40)), 0.0, np.cos(np.radians(40))])
OFFSET = 0.5 * AXIS
RADIUS_MM = 8.0


def dome(xy: Array) -> Array:
    """A sphere of 8 mm whose pole is at CENTER, z = -2.5."""
    return np.asarray(-2.5 - RADIUS_MM + np.sqrt(RADIUS_MM**2 - ((xy - CENTER) ** 2).sum(axis=1)))


def cloud(noise_mm: float = 0.03, *, outliers: float = 0.0, hole: bool = False, n: int = 9000) -> Array:
    rng = np.random.default_rng(4)
    xy = CENTER + rng.uniform(-4.2, 4.2, (n, 2))
    z = dome(xy) + rng.normal(0, noise_mm, n)
    wild = rng.random(n) < outliers
    z[wild] += rng.uniform(-2, 2, int(wild.sum()))
    points = np.column_stack([xy, z])
    if hole:
        points = points[np.hypot(*(xy - CENTER - [2.0, 0.0]).T) > 0.8]
    return points


def fitted(points: Array, variance: float = 1e-4) -> Surface:
    return fit_surface(points, np.full(len(points), variance), CENTER, 3.5)


def ring(radius_mm: float = 2.0, n: int = 32) -> Array:
    theta = 2 * pi * np.arange(1, n + 1) / n
    return CENTER + radius_mm * np.column_stack([np.cos(theta), np.sin(theta)])


@pytest.mark.parametrize(("outliers", "hole"), [(0.0, False), (0.15, False), (0.1, True)])
def test_heights_and_normals_of_a_dome(outliers: float, hole: bool) -> None:
    surface = fitted(cloud(outliers=outliers, hole=hole))
    height, sigma = surface.height(ring())
    error = height - dome(ring())
    assert np.abs(error).max() < 0.04
    assert (np.abs(error) < 4 * sigma + 0.005).all()
    truth = np.column_stack([ring() - CENTER, dome(ring()) + 2.5 + RADIUS_MM]) / RADIUS_MM
    lean = np.degrees(np.arccos(np.clip((surface.normal(ring()) * truth).sum(axis=1), -1, 1)))
    assert lean.max() < 3.0


def test_normals_point_towards_the_eyes() -> None:
    assert (fitted(cloud()).normals[..., 2] > 0.5).all()


def test_holes_are_filled_named_and_less_sure() -> None:
    surface = fitted(cloud(hole=True))
    _, inside = surface.height(CENTER[None] + [2.0, 0.0])
    _, outside = surface.height(CENTER[None] - [2.0, 0.0])
    assert inside[0] > outside[0]
    assert 0.9 < surface.measured.mean() < 1.0


def test_the_calibrations_own_error_does_not_average_out() -> None:
    _, sigma = fitted(cloud(), variance=0.2**2).height(ring())
    assert (sigma >= 0.2).all()


def test_too_few_matches_are_refused() -> None:
    with pytest.raises(DetectionError, match="300 are needed"):
        fitted(cloud(n=250))


def test_outside_the_patch_is_refused() -> None:
    with pytest.raises(PlanError, match="outside it"):
        fitted(cloud()).height(CENTER[None] + [9.0, 0.0])


def test_the_surface_point_that_one_eye_sees_at_a_pixel() -> None:
    points = cloud(0.01)
    left_px = (points[:, [1, 0]] - CENTER[::-1]) * 25 + [480, 270]
    found = point_at(points, left_px, np.array([480.0, 270.0]))
    np.testing.assert_allclose(found, [5.0, -10.0, -2.5], atol=0.03)
    with pytest.raises(DetectionError, match="not seen"):
        point_at(points, left_px, np.array([50.0, 50.0]))


def planned(job: Job | None = None, **kwargs: bool) -> Trajectory:
    return plan(fitted(cloud(0.01)), np.array([*CENTER, -2.5]), job or Job(), OFFSET, TRAVEL, **kwargs)


def test_erratum_11_the_first_point_is_not_at_theta_zero() -> None:
    trajectory = planned()
    np.testing.assert_allclose(trajectory.theta_rad, 2 * pi * np.arange(1, 33) / 32)
    assert trajectory.theta_rad[0] > 0
    np.testing.assert_allclose(trajectory.fit_mm[-1, :2], CENTER + np.array([2.0, 0.0]), atol=1e-9)


def test_erratum_11_the_offset_along_the_normal_moves_x_and_y() -> None:
    trajectory = planned()
    shift = np.linalg.norm(trajectory.ball_mm - trajectory.fit_mm, axis=1)
    np.testing.assert_allclose(shift, 1.0, atol=1e-9)
    outward = np.linalg.norm(trajectory.ball_mm[:, :2] - CENTER, axis=1) - 2.0
    np.testing.assert_allclose(outward, 2.0 / RADIUS_MM, atol=0.06)


def test_erratum_10_the_offset_is_the_balls_and_the_machine_is_sent_the_tip() -> None:
    trajectory = planned()
    np.testing.assert_allclose(trajectory.ball_mm - trajectory.tip_mm, np.tile(OFFSET, (32, 1)), atol=1e-12)
    gap = np.linalg.norm(trajectory.ball_mm - [*CENTER, -2.5 - RADIUS_MM], axis=1) - RADIUS_MM - 0.5
    np.testing.assert_allclose(gap, 0.5, atol=0.04)


def test_erratum_10_a_predicted_error_beyond_the_safety_offset_raises_it_or_refuses() -> None:
    points = cloud(0.01)
    center = np.array([*CENTER, -2.5])
    raised = plan(fitted(points, 0.4**2), center, Job(), OFFSET, TRAVEL)
    assert raised.offset_mm >= 0.8
    assert "raised" in raised.note
    with pytest.raises(PlanError, match="calibrate again"):
        plan(fitted(points, 0.8**2), center, Job(), OFFSET, TRAVEL)
    assert planned().note == ""


def test_erratum_14_the_radius_is_that_of_the_ball_path_and_the_flap_is_narrower() -> None:
    """With r = 2 mm and r_d = 0.5 mm the flap that stays is 3 mm across."""
    job = Job()
    assert 2 * (job.radius_mm - job.ball_radius_mm) == 3.0
    assert job.circumference_mm == pytest.approx(12.57, abs=0.01)


def test_contact_is_predicted_straight_below_the_start() -> None:
    trajectory = planned()
    ball = trajectory.ball_mm.copy()
    ball[:, 2] = trajectory.contact_z_mm + OFFSET[2]
    gap = np.linalg.norm(ball - [*CENTER, -2.5 - RADIUS_MM], axis=1) - RADIUS_MM - 0.5
    assert np.abs(gap).max() < 0.03


def test_the_flat_start_is_one_height_above_the_ring() -> None:
    trajectory = planned(Job(policy="previous"), flat=True)
    assert np.ptp(trajectory.tip_mm[:, 2]) == 0.0
    assert trajectory.ball_mm[0, 2] == pytest.approx(trajectory.fit_mm[:, 2].max() + 1.0)
    np.testing.assert_allclose(trajectory.ball_mm[:, :2], ring())


def test_the_path_is_closed_and_goes_through_the_points() -> None:
    trajectory = planned()
    np.testing.assert_allclose(trajectory.path(trajectory.knots_mm), trajectory.tip_mm[:, :2], atol=1e-9)
    np.testing.assert_allclose(trajectory.path(0.0), trajectory.path(trajectory.length_mm), atol=1e-9)
    speed = np.linalg.norm(trajectory.path(np.linspace(0, trajectory.length_mm, 500), 1), axis=1)
    assert speed.min() > 0.9
    assert speed.max() < 1.1


@pytest.mark.parametrize(
    ("travel", "says"),
    [
        (Travel((-10.0, -30.0, -8.0), (6.0, 10.0, 20.0)), "outside the travel"),
        (Travel((-10.0, -30.0, -3.0), (25.0, 10.0, 20.0)), "outside the travel"),
    ],
)
def test_a_ring_outside_the_travel_is_refused(travel: Travel, says: str) -> None:
    with pytest.raises(PlanError, match=says):
        plan(fitted(cloud(0.01)), np.array([*CENTER, -2.5]), Job(), OFFSET, travel)


def test_a_ring_wider_than_the_patch_is_refused() -> None:
    with pytest.raises(PlanError, match="smaller radius"):
        planned(Job(radius_mm=4.0))
