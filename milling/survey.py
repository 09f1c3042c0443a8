"""Before the drill turns: is the calibration still true, where are landmarks and surface, where is the ring."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from drivers.camera.interface import Image, StereoFrame
from drivers.errors import CalibrationError, DetectionError, MillError
from drivers.recorder import Recorder
from milling.equipment import Finders, Rig
from milling.job import Job
from milling.surface import fit_surface, point_at
from milling.trajectory import Trajectory, plan

if TYPE_CHECKING:
    from calib.calibration_file import Calibration

Floats = npt.NDArray[np.float64]

FRAMES = 4
"""Pairs of pictures that the surface is read from."""
LOOK_HALF_PX = 160.0
"""Half the side of the square round the ring's centre that is matched."""
LANDMARKS_MM = (3.0, 5.5)
"""From bregma to lambda in a mouse, with room to spare: 3.9 to 4.2 mm are published."""
BEYOND_MM = 1.5
"""How far the surface is known beyond the ring: the ball, and the offset along the normal."""


def verify_calibration(rig: Rig, calibration: "Calibration", finders: Finders, job: Job, recorder: Recorder) -> None:
    """Look at the drill at one setpoint again.

    Raises:
        CalibrationError, DetectionError: beyond the job's gates, or the calibration's own prediction.
    """
    from calib.procedure import verify

    found = verify(calibration, rig.motion, rig.camera, finders.find_tip, clock=rig.clock, recorder=recorder)
    error_mm = float(np.linalg.norm(found.error_mm))
    _gate("calibration, verified at one setpoint", error_mm, job.calibration_gate_mm, "mm", CalibrationError)
    _gate("drill tip, verified at one setpoint", found.error_px, job.detection_gate_px, "px", DetectionError)


def survey(
    rig: Rig,
    calibration: "Calibration",
    finders: Finders,
    job: Job,
    recorder: Recorder,
    tell: Callable[[str, str], None],
    *,
    flat_start: bool,
) -> tuple[Image, Trajectory]:
    """The left picture of the unmilled skull, and the ring on it. The drill must be parked out of both pictures.

    Raises:
        DetectionError: a landmark or the surface is not seen.
        PlanError: a ring that must not be milled.
    """
    frames = [rig.camera.capture() for _ in range(FRAMES)]
    frame = frames[0]
    recorder.frame("reference_left", frame.left)
    recorder.frame("reference_right", frame.right)
    landmarks_px, center_px, right_px = _center(calibration, frame, finders, job, tell)
    rough, _ = calibration.points_from_pixels(center_px[None], right_px[None])
    x, y = center_px
    matches = finders.match(
        [each.left for each in frames],
        [each.right for each in frames],
        right_from_left=calibration.right_from_left(float(rough[0, 2])),
        region=(x - LOOK_HALF_PX, y - LOOK_HALF_PX, x + LOOK_HALF_PX, y + LOOK_HALF_PX),
    )
    points, covariance = calibration.points_from_pixels(matches.left_px, matches.right_px)
    center = point_at(points, matches.left_px, center_px)
    tell("surface", f"{len(points)} matched places")
    surface = fit_surface(points, covariance[:, 2, 2], center[:2], job.radius_mm + BEYOND_MM)
    offset = np.asarray(rig.center_from_tip_mm, dtype=np.float64)
    trajectory = plan(surface, center, job, offset, rig.motion.travel, flat=flat_start)
    recorder.event(
        "surface",
        x_mm=surface.x_mm[::2],
        y_mm=surface.y_mm[::2],
        z_mm=surface.z_mm[::2, ::2],
        matches=len(points),
        measured=surface.measured.mean(),
    )
    trajectory.tell(recorder, **landmarks_px)
    tell("trajectory", trajectory.note)
    return frame.left, trajectory


def _center(
    calibration: "Calibration", frame: StereoFrame, finders: Finders, job: Job, tell: Callable[[str, str], None]
) -> tuple[dict[str, Floats], Floats, Floats]:
    """Bregma and lambda in both pictures, for the record, and the ring's centre in both."""
    if job.center_mm is not None:
        tell("center", "as told")
        left, right = calibration.project(np.array([job.center_mm]))
        return {}, left[0], right[0]
    tell("landmarks", "")
    landmarks_px, landmarks_right_px, center_px, right_px = _landmarks(frame, finders, job)
    ends, _ = calibration.points_from_pixels(landmarks_px, landmarks_right_px)
    apart_mm = float(np.linalg.norm(ends[1] - ends[0]))
    if not LANDMARKS_MM[0] <= apart_mm <= LANDMARKS_MM[1]:
        raise DetectionError(
            f"bregma and lambda are {apart_mm:.2f} mm apart, allowed {LANDMARKS_MM[0]:g} to {LANDMARKS_MM[1]:g} mm: "
            "one of them is something else; clear the skull, check light and focus"
        )
    marks = {"bregma_px": landmarks_px[0], "lambda_px": landmarks_px[1]}
    marks |= {"bregma_right_px": landmarks_right_px[0], "lambda_right_px": landmarks_right_px[1]}
    return marks, center_px, right_px


def _landmarks(frame: StereoFrame, finders: Finders, job: Job) -> tuple[Floats, Floats, Floats, Floats]:
    """Bregma and lambda (2, 2) in the left and in the right picture, and the ring's centre in each."""
    places: list[Floats] = []
    for side, image in (("left", frame.left), ("right", frame.right)):
        points = []
        for name, found in zip(("bregma", "lambda"), finders.find_landmarks(image), strict=True):
            if not found.visible:
                raise DetectionError(
                    f"{name} is not seen in the {side} picture; clear the skull, check light and focus"
                )
            _gate(f"{name} in the {side} picture", found.sigma_px, job.detection_gate_px, "px", DetectionError)
            points.append((found.x_px, found.y_px))
        places.append(np.array(points))
    left, right = places
    share = np.array([1 - job.landmark_ratio, job.landmark_ratio])
    return left, right, share @ left, share @ right


def _gate(what: str, found: float, allowed: float, unit: str, error: type[MillError]) -> None:
    if not found <= allowed:
        raise error(
            f"{what}: off by {found:.2f} {unit}, allowed {allowed:g} {unit}; calibrate again, check light and focus"
        )
