"""Calibration against the emulated rigs: their optics, and once with the real drivers, boards and pictures."""

from dataclasses import replace

import numpy as np
import pytest
from instant_rig import Tip
from synthetic_microscope import SIZE_PX, box_samples

from calib.camera_fit import fit_camera_pair
from calib.procedure import calibrate, verify
from calib.setpoints import default_setpoints, skull_points
from drivers.camera.stereo import StereoPair
from drivers.errors import CalibrationError
from drivers.motion.grbl.driver import GrblController
from firmware_sim.bench import MAX_FEED_MM_S, ORIGIN_MM, Bench, open_in_process
from firmware_sim.clock import SimClock
from firmware_sim.optics import draw_eyes
from firmware_sim.specimen import draw_specimen

NOISE_PX = 0.5


def rms(errors):
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def scores():
    """For rigs drawn from a seed: true error of the calibration alone, of new sightings, and the predicted one."""
    result = []
    for seed in range(20):
        eyes = draw_eyes(draw_specimen(seed).rig)
        rng = np.random.default_rng(seed)

        def see(points, eyes=eyes, rng=rng):
            return [eye.project(points) + rng.normal(0, NOISE_PX, (len(points), 2)) for eye in eyes]

        setpoints = np.add(default_setpoints(), (0.32, 0.0, 0.38))
        fit = fit_camera_pair(setpoints, *see(setpoints), size_px=SIZE_PX, detector_sigma_px=NOISE_PX)
        row = []
        for points in (box_samples(rng, 100), skull_points()):
            row.append(rms(fit.pair.points_from_pixels(*(eye.project(points) for eye in eyes))[0] - points))
            row.append(rms(fit.pair.points_from_pixels(*see(points))[0] - points))
            row.append(rms(fit.pair.sigma_at(points)))
        result.append(row)
    return np.array(result)


def test_held_out_points_of_the_box_are_within_a_tenth_of_a_millimetre(scores):
    assert np.sqrt((scores[:, 0] ** 2).mean()) < 0.07
    assert np.quantile(scores[:, 0], 0.9) <= 0.1


def test_the_skull_below_the_setpoints_is_within_a_tenth_of_a_millimetre(scores):
    assert np.sqrt((scores[:, 3] ** 2).mean()) < 0.09


@pytest.mark.parametrize("first", [0, 3])
def test_the_predicted_error_is_the_true_one(scores, first):
    true, predicted = scores[:, first + 1], scores[:, first + 2]
    assert np.sqrt((predicted**2).mean() / (true**2).mean()) == pytest.approx(1.0, abs=0.1)
    assert (predicted / true).min() > 0.6


def test_the_whole_procedure_over_driver_board_and_pictures():
    """Only the detector is played: the true place of the ball with noise, where the renderer says it is visible."""
    bench, clock = Bench(draw_specimen(5)), SimClock()
    line, _, left, right = open_in_process(bench, clock)
    noise = np.random.default_rng(0)
    side = 0

    def find_tip(image):
        nonlocal side
        assert image.shape == (540, 960, 3)
        truth = bench.microscope.project(bench.machine.ball_center_mm[None])[side][0]
        side = 1 - side
        x, y = truth + noise.normal(0, NOISE_PX, 2)
        return Tip(x, y, NOISE_PX, True)

    offset = tuple(float(v) for v in bench.machine.ball_center_mm - bench.machine.tip_mm)
    with (
        GrblController(line, clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=MAX_FEED_MM_S) as motion,
        StereoPair(left, right, clock, size_px=SIZE_PX, max_skew_s=0.02) as camera,
    ):
        motion.home()
        started_s = clock.now_s()
        calibration = calibrate(
            motion, camera, find_tip, clock=clock, tool_offset_mm=offset, frames_per_setpoint=2, settle_s=0.2
        )
        assert clock.now_s() - started_s < 60.0
        points = box_samples(np.random.default_rng(1), 200)
        triangulated, _ = calibration.points_from_pixels(*bench.microscope.project(points))
        assert rms(triangulated - points) < 0.1
        assert not calibration.outliers
        assert verify(calibration, motion, camera, find_tip, clock=clock, frames=2).distance_sigmas < 4.5
        moved = calibrated_elsewhere(calibration)
        with pytest.raises(CalibrationError, match="verification"):
            verify(moved, motion, camera, find_tip, clock=clock, frames=2)


def calibrated_elsewhere(calibration):
    """The same calibration as if the microscope had moved by 0.2 mm since."""
    x, y, z = calibration.pair.optics.origin_mm
    optics = replace(calibration.pair.optics, origin_mm=(x, y + 0.2, z))
    return replace(calibration, pair=replace(calibration.pair, optics=optics))
