"""The camera pair: its derivatives, its fit, its covariance, and the faults that it names."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_microscope import PLAIN, SIZE_PX, Microscope, box_samples

from calib.camera_fit import fit_camera_pair
from calib.camera_pair import N_PARAMETERS, eye_jacobians, project_eye
from calib.setpoints import box_points, default_setpoints, skull_points
from calib.stereo import PAPER_MODEL
from drivers.errors import CalibrationError

CENTER_FROM_TIP_MM = (0.32, 0.0, 0.38)
SETPOINTS = np.add(default_setpoints(), CENTER_FROM_TIP_MM)


def fit(microscope, *, noise_px=0.0, seed=0, setpoints=SETPOINTS, detector_sigma_px=0.05):
    rng = np.random.default_rng(seed)
    left, right = (pixels + rng.normal(0, noise_px, pixels.shape) for pixels in microscope.project(setpoints))
    return fit_camera_pair(setpoints, left, right, size_px=SIZE_PX, detector_sigma_px=detector_sigma_px)


def rms(errors):
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def drawn_microscope(rng):
    return Microscope(
        toe_in_deg=rng.normal(7.26, 0.3),
        tilt_about_deg=rng.uniform(0, 360),
        yaw_deg=rng.normal(0, 4),
        roll_deg=tuple(rng.normal(0, 0.5, 2)),
        px_per_mm=tuple(rng.normal(25.4, 0.3, 2)),
    )


def test_derivatives_agree_with_differences():
    pair = fit(Microscope()).pair
    points = box_samples(np.random.default_rng(1), 20)
    _, by_point, by_parameters = eye_jacobians(pair.left, pair.optics, points)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-4
        change = project_eye(pair.left, pair.optics, points + step) - project_eye(pair.left, pair.optics, points - step)
        assert by_point[:, :, axis] == pytest.approx(change / 2e-4, abs=1e-5)
    for index in range(N_PARAMETERS):
        step = np.eye(N_PARAMETERS)[index] * 1e-6
        change = project_eye(pair.left + step, pair.optics, points) - project_eye(pair.left - step, pair.optics, points)
        assert by_parameters[:, :, index] == pytest.approx(change / 2e-6, abs=1e-3, rel=1e-5)


def test_pixels_and_points_are_inverse():
    pair = fit(Microscope()).pair
    points = np.vstack([box_samples(np.random.default_rng(2), 200), skull_points()])
    assert pair.points_from_pixels(*pair.project(points))[0] == pytest.approx(points, abs=1e-7)


def test_many_points_at_once_are_the_same_as_few():
    pair = fit(Microscope()).pair
    left, right = pair.project(box_samples(np.random.default_rng(3), 45_000))
    points, covariance = pair.points_from_pixels(left, right)
    some, some_covariance = pair.points_from_pixels(left[20_000:20_003], right[20_000:20_003])
    assert points[20_000:20_003] == pytest.approx(some, abs=1e-12)
    assert covariance[20_000:20_003] == pytest.approx(some_covariance, rel=1e-9)


@pytest.mark.parametrize(
    ("microscope", "model"),
    [
        (PLAIN, "affine"),
        (replace(PLAIN, perspective_per_mm=0.002), "perspective"),
        (replace(PLAIN, perspective_per_mm=0.002, distortion=0.01), "radial"),
    ],
)
def test_the_simplest_model_that_explains_the_setpoints_is_chosen(microscope, model):
    found = fit(microscope, noise_px=0.02, detector_sigma_px=0.02)
    assert found.model == model
    samples = box_samples(np.random.default_rng(4), 300)
    assert rms(found.pair.points_from_pixels(*microscope.project(samples))[0] - samples) < 0.01
    assert found.candidates_mm[model] == pytest.approx(found.rmse_mm)


def test_the_linear_model_is_chosen_on_its_own_microscope_when_setpoints_are_few():
    setpoints = SETPOINTS[[0, 3, 7, 10, 12, 15]]
    in_mi = np.stack([setpoints[:, 1] + 10.0, 5.0 - setpoints[:, 0], setpoints[:, 2]], axis=1)
    rng = np.random.default_rng(5)
    left, right = (pixels + rng.normal(0, 0.5, pixels.shape) for pixels in PAPER_MODEL.project(in_mi))
    found = fit_camera_pair(setpoints, left, right, size_px=SIZE_PX, detector_sigma_px=0.5)
    assert found.model == "linear"
    assert found.handedness == "right-handed"
    assert found.rmse_mm < 0.4


def test_sixteen_setpoints_at_half_a_pixel_leave_less_than_a_tenth_of_a_millimetre():
    box, skull = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        microscope = drawn_microscope(rng)
        found = fit(microscope, noise_px=0.5, seed=seed, detector_sigma_px=0.5)
        for errors, points in ((box, box_samples(rng, 100)), (skull, skull_points())):
            errors.append(rms(found.pair.points_from_pixels(*microscope.project(points))[0] - points))
    assert rms(np.array(box)[:, None]) < 0.065
    assert np.quantile(box, 0.9) < 0.1
    assert rms(np.array(skull)[:, None]) < 0.08
    assert np.quantile(skull, 0.9) < 0.12


@pytest.mark.parametrize(("noise_px", "within"), [((0.5, 0.5), 0.15), ((0.2, 0.6), 0.25), ((0.6, 0.2), 0.25)])
def test_predicted_error_is_the_true_error(noise_px, within):
    """On average over rigs, for the transform's share and a new detection's together and along each axis.

    The detector claims one sigma for both coordinates, which still weighs a little.
    """
    true, predicted = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        microscope = drawn_microscope(rng)
        found = fit(microscope, noise_px=noise_px, seed=seed, detector_sigma_px=rms(np.array([noise_px])) / np.sqrt(2))
        points = np.vstack([box_points(), skull_points()])
        left, right = (pixels + rng.normal(0, noise_px, pixels.shape) for pixels in microscope.project(points))
        triangulated, covariance = found.pair.points_from_pixels(left, right)
        true.append(((triangulated - points) ** 2).mean(axis=0))
        predicted.append(np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0))
    ratio = np.sqrt(np.mean(predicted, axis=0) / np.mean(true, axis=0))
    assert ratio == pytest.approx(np.ones(3), abs=within)


def test_sigma_of_matches_replaces_the_tips_sigma():
    pair = fit(Microscope(), noise_px=0.3, detector_sigma_px=0.3).pair
    left, right = pair.project([[5.0, -10.0, -2.5]] * 2)
    covariance = pair.points_from_pixels(left, right, np.array([0.1, 2.0]))[1]
    assert np.trace(covariance[1]) > 20 * np.trace(covariance[0])
    assert pair.sigma_at([[5.0, -10.0, -2.5]], 2.0)[0] == pytest.approx(np.sqrt(np.diag(covariance[1])), rel=1e-6)


def test_error_grows_away_from_the_setpoints():
    pair = fit(Microscope(), noise_px=0.3, detector_sigma_px=0.3).pair
    near, far = np.linalg.norm(pair.sigma_at([[5.0, -10.0, 5.0], [5.0, -10.0, -40.0]], 1e-6), axis=1)
    assert far > 3 * near


@pytest.mark.parametrize("z_mm", [-4.0, 0.0, 8.0])
def test_right_from_left_carries_points_of_its_height(z_mm):
    microscope = Microscope()
    pair = fit(microscope).pair
    points = np.column_stack([box_samples(np.random.default_rng(6), 100)[:, :2], np.full(100, z_mm)])
    left, right = microscope.project(points)
    affine = pair.right_from_left(z_mm)
    assert affine.shape == (2, 3)
    assert np.abs(left @ affine[:, :2].T + affine[:, 2] - right).max() < 1.5


def test_disagreement_shows_pixels_of_different_things():
    pair = fit(Microscope()).pair
    left, right = pair.project(box_samples(np.random.default_rng(7), 5))
    assert pair.disagreement_px(left, right).max() < 1e-6
    right[2, 1] += 10.0
    assert pair.disagreement_px(left, right)[2] == pytest.approx(10 / np.sqrt(2), rel=0.05)


@pytest.mark.parametrize("wild", [(3,), (3, 9), (0, 7, 12)])
def test_outliers_are_found_left_out_and_pointed_at(wild):
    microscope = Microscope()
    rng = np.random.default_rng(8)
    left, right = (pixels + rng.normal(0, 0.3, pixels.shape) for pixels in microscope.project(SETPOINTS))
    left[list(wild)] += rng.choice([-1, 1], (len(wild), 2)) * [25.0, 12.0]
    found = fit_camera_pair(SETPOINTS, left, right, size_px=SIZE_PX, detector_sigma_px=0.3)
    assert tuple(np.flatnonzero(~found.used)) == wild
    samples = box_samples(rng, 200)
    assert rms(found.pair.points_from_pixels(*microscope.project(samples))[0] - samples) < 0.12
    assert found.rmse_mm < 0.25
    assert found.leave_one_out_mm[list(wild)].min() > 0.3


def test_honest_noise_has_no_outliers():
    flagged = sum((~fit(Microscope(), noise_px=0.6, seed=seed, detector_sigma_px=0.3).used).sum() for seed in range(12))
    assert flagged == 0


def test_too_many_outliers_are_refused_with_their_places():
    rng = np.random.default_rng(9)
    left, right = Microscope().project(SETPOINTS)
    left[1:15:3] += rng.choice([-1, 1], (5, 2)) * [40.0, 20.0]
    with pytest.raises(CalibrationError, match=r"of 16 setpoints disagree with the others \(\("):
        fit_camera_pair(SETPOINTS, left, right, size_px=SIZE_PX, detector_sigma_px=0.3)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"swapped": True}, "cameras are swapped"),
        ({"mirrored": (True, True)}, "both pictures are mirrored"),
        ({"mirrored": (True, False)}, "left picture is mirrored"),
        ({"mirrored": (False, True)}, "right picture is mirrored"),
        ({"mirrored": (True, True), "swapped": True}, "both pictures are mirrored"),
    ],
)
@pytest.mark.parametrize("yaw_deg", [0.0, 180.0])
def test_swapped_and_mirrored_pictures_are_named(change, cause, yaw_deg):
    with pytest.raises(CalibrationError, match=cause):
        fit(replace(Microscope(), yaw_deg=yaw_deg, **change), noise_px=0.5, detector_sigma_px=0.5)


def test_a_microscope_that_stands_on_the_other_side_is_right_handed():
    assert fit(replace(Microscope(), yaw_deg=180.0)).handedness == "right-handed"


@pytest.mark.parametrize(
    ("setpoints", "reason"),
    [
        (SETPOINTS[:4], "4 usable setpoints"),
        (np.column_stack([SETPOINTS[:, :2], SETPOINTS[:, 0] * 0.3]), "one plane"),
        (np.outer(np.linspace(0, 1, 12), [10.0, -20.0, 10.0]), "one line"),
    ],
)
def test_degenerate_setpoints_are_refused(setpoints, reason):
    with pytest.raises(CalibrationError, match=reason):
        fit(Microscope(), setpoints=setpoints)


@pytest.mark.parametrize("count", [5, 6, 7, 8, 10])
def test_few_setpoints_get_a_model_that_they_can_hold_out(count):
    setpoints = np.array(default_setpoints(12))[np.linspace(0, 11, count).astype(int)]
    found = fit(replace(PLAIN, perspective_per_mm=0.001), setpoints=setpoints, noise_px=0.2, detector_sigma_px=0.2)
    assert np.isfinite(found.leave_one_out_mm).all()
    assert found.used.all()


def test_pixels_that_are_not_finite_and_wrong_shapes_are_refused():
    pair = fit(Microscope()).pair
    with pytest.raises(CalibrationError, match="not finite"):
        pair.points_from_pixels([[1.0, np.nan]], [[1.0, 2.0]])
    with pytest.raises(ValueError, match="as many of each"):
        pair.points_from_pixels(np.zeros((2, 2)), np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"\(n, 3\) wanted"):
        pair.project([1.0, 2.0, 3.0])


def test_the_same_input_gives_the_same_fit():
    one, other = (fit(Microscope(), noise_px=0.4, seed=3) for _ in range(2))
    assert (one.pair.left == other.pair.left).all()
    assert (one.pair.covariance == other.pair.covariance).all()
