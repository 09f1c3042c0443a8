"""A calibration as a rig's would be, without a rig."""

import numpy as np

from calib.calibration_file import Calibration, RigIdentity, Setpoint
from calib.camera_fit import fit_camera_pair


def a_calibration() -> Calibration:
    """Of a microscope that looks straight down; the eyes were far off at one setpoint, which is left out."""
    points_mm = np.random.default_rng(0).uniform((0.0, -20.0, 0.0), (10.0, 0.0, 10.0), (16, 3))
    across_px, down_px = 480.0 + (points_mm[:, 1] + 10.0) / 0.0395, 270.0 + (points_mm[:, 0] - 5.0) / 0.0395
    left, right = (
        np.column_stack([across_px + sign * 3.2 * points_mm[:, 2], down_px]).round(1) for sign in (1.0, -1.0)
    )
    left[3] += 9.0
    fit = fit_camera_pair(points_mm, left, right, size_px=(960, 540), detector_sigma_px=0.3)
    setpoints = tuple(
        Setpoint(
            point_mm=tuple(points_mm[k].tolist()),
            left_px=tuple(left[k].tolist()),
            right_px=tuple(right[k].tolist()),
            residual_mm=tuple(fit.residuals_mm[k].tolist()),
            leave_one_out_mm=float(fit.leave_one_out_mm[k]),
            used=bool(fit.used[k]),
        )
        for k in range(16)
    )
    rig = RigIdentity(motion="stage <7>", camera="eyes L1 R2")
    return Calibration(
        fit.pair, "default", fit.model, fit.candidates_mm, "right-handed", False, fit.rmse_mm, setpoints, rig
    )
