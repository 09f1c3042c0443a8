"""How far a finished calibration is off, asked at places of the paper's validation box on a virtual bench."""

from collections.abc import Callable
from typing import Any

import numpy as np

from calib.calibration_file import Calibration
from calib.procedure import FindTip
from calib.setpoints import FREE_AIR
from drivers.camera.interface import StereoCamera
from drivers.clock import Clock
from drivers.errors import DetectionError
from drivers.motion.interface import MotionController
from studies.trials import rms

PLACES = 20
CENTRAL = 13
"""The paper's m, and how many of them lie nearest to the middle."""


def errors_in_box(
    motion: MotionController,
    camera: StereoCamera,
    clock: Clock,
    find_tip: FindTip,
    calibration: Calibration,
    truth: Callable[[], dict[str, Any]],
    seed: int,
) -> dict[str, Any]:
    """Visit 20 random places of the box; the calibration tells where the ball is, the robot where it truly is.

    The 13 places nearest to the middle of the box are its centre and the other 7 its periphery, as in the paper.

    Args:
        motion: homed.
        camera: sees the drill.
        clock: the devices' clock.
        find_tip: finds the ball's centre in one picture.
        calibration: finished.
        truth: what the bench says of itself: ``ball_px`` is where the ball's centre truly is in each picture.
        seed: draws the places.

    Returns:
        ``rmse_mm``, ``rmse_center_mm``, ``rmse_periphery_mm`` of the place (Euclidean), ``predicted_rmse_mm`` there by
        the calibration's own covariance, ``tip_rmse_px`` and ``tip_errors_px`` (Euclidean, both eyes), and
        ``setpoints_seen``, of 20.

    Raises:
        DetectionError: the drill was seen at fewer than two places.
    """
    places = np.random.default_rng([seed, PLACES]).uniform(FREE_AIR.low_mm, FREE_AIR.high_mm, (PLACES, 3))
    errors_mm, errors_px, off_center_mm, seen_at = [], [], [], []
    for x, y, z in places.tolist():
        motion.start_move((x, y, z), feed_mm_per_s=10.0)
        motion.wait_until_idle(timeout_s=30.0)
        clock.sleep_s(0.3)
        pair = camera.capture()
        left, right = find_tip(pair.left), find_tip(pair.right)
        if not (left.visible and right.visible):
            continue
        ball_px = truth()["ball_px"]
        seen = np.array([[left.x_px, left.y_px], [right.x_px, right.y_px]])
        errors_px += list(np.hypot(*(seen - np.array([ball_px["left"], ball_px["right"]])).T))
        points_mm, _ = calibration.points_from_pixels(seen[:1], seen[1:])
        center_mm = np.array([x, y, z]) + calibration.rig.center_from_tip_mm
        errors_mm.append(float(np.linalg.norm(points_mm[0] - center_mm)))
        off_center_mm.append(float(np.hypot(x - 5.0, y + 10.0)))
        seen_at.append(center_mm)
    if len(errors_mm) < 2:
        raise DetectionError(f"the drill was seen at {len(errors_mm)} of {PLACES} places of the box; check the light")
    sorted_mm = np.array(errors_mm)[np.argsort(off_center_mm)]
    central = max(1, min(len(sorted_mm) - 1, round(CENTRAL / PLACES * len(sorted_mm))))
    return {
        "setpoints_seen": len(errors_mm),
        "rmse_mm": rms(sorted_mm),
        "rmse_center_mm": rms(sorted_mm[:central]),
        "rmse_periphery_mm": rms(sorted_mm[central:]),
        "predicted_rmse_mm": calibration.predicted_rmse_at(np.array(seen_at)),
        "tip_rmse_px": rms(errors_px),
        "tip_errors_px": [round(float(error), 4) for error in errors_px],
    }
