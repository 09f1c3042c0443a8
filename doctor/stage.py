"""Eyes and axes together: the drill moves in free air, and both eyes say whether it went where it was sent."""

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.calibration_file import Calibration
from calib.procedure import calibrate
from calib.setpoints import VERIFY_SETPOINT, default_setpoints
from doctor.check import Check, Patient, at_most
from drivers.camera.interface import StereoCamera
from drivers.errors import CalibrationError, DetectionError
from drivers.motion.interface import MotionController, Travel, Vector

Floats = npt.NDArray[np.float64]

INNER = Travel((1.0, -18.0, 0.0), (9.0, -2.0, 9.0))
"""Within the box of the calibration: an axis that is wrong must not carry the drill out of the pictures."""
RUN_UP_MM = 1.5
FRAMES = 4
ROUNDS = 2
SETTLE_S = 0.3
FEED_MM_S = 10.0
HEIGHT_FACTOR = 4.0
"""Height is read from the small angle between the eyes: so much less exactly than what lies across."""
SHIFT_MM = 0.15
TURN_DEG = 0.5
HOMING_MM = 0.03
_MEANT = "if the change was meant, calibrate, and run `mill doctor --recertify`"


def examine(patient: Patient, keep: Callable[[Calibration], None]) -> Iterator[Check]:
    """The drill visits the setpoints of a calibration, which ``keep`` receives, and one of them again and again."""
    with patient.open_motion() as motion, patient.open_camera() as camera:
        patient.doing("moving the drill before the cameras (most of a minute)")
        motion.home()
        motion.start_move(patient.park_mm, feed_mm_per_s=FEED_MM_S)
        motion.wait_until_idle(timeout_s=60.0)
        try:
            found = calibrate(
                motion, camera, patient.find_tip, clock=patient.clock, tool_offset_mm=patient.center_from_tip_mm,
                setpoints_mm=default_setpoints(travel=INNER), frames_per_setpoint=2, recorder=patient.recorder,
            )  # fmt: skip
        except (CalibrationError, DetectionError) as error:
            yield Check("eyes: left, right and mirrored", str(error), "", "a drill that moves as it should", False)
            return
        yield Check("eyes: left, right and mirrored", found.handedness, "", "right-handed", True)
        yield at_most("eyes: error of a fresh calibration", found.rmse_mm, 0.15, "mm", "see `mill calibrate`")
        keep(found)
        if patient.earlier is not None and patient.earlier.calibration is not None:
            yield from _against(patient, patient.earlier.calibration, found)
        patient.doing("looking for play in the axes")
        eyes = _Eyes(patient, motion, camera, found)
        yield from _backlash(patient, eyes)
        patient.doing("homing again")
        before = eyes.see(VERIFY_SETPOINT, RUN_UP_MM)
        motion.home()
        off = float(np.linalg.norm((eyes.see(VERIFY_SETPOINT, RUN_UP_MM) - before)[:2]))
        yield at_most("stage: homing repeats, seen from above", off, HOMING_MM, "mm", "clean and fasten the switches")
        motion.start_move((*VERIFY_SETPOINT[:2], patient.park_mm[2]), feed_mm_per_s=FEED_MM_S)
        motion.start_move(patient.park_mm, feed_mm_per_s=FEED_MM_S)
        motion.wait_until_idle(timeout_s=60.0)


class _Eyes:
    """Where the ball is, as a fresh calibration reads it."""

    def __init__(
        self, patient: Patient, motion: MotionController, camera: StereoCamera, calibration: Calibration
    ) -> None:
        self._patient, self._motion, self._camera, self._calibration = patient, motion, camera, calibration

    def see(self, target: Vector, run_up_mm: float, axis: int = 0) -> Floats:
        """(3,) mm at ``target``, reached along an axis from so far before (or, if negative, beyond) it."""
        start = list(target)
        start[axis] -= run_up_mm
        for place in ((start[0], start[1], start[2]), target):
            self._motion.start_move(place, feed_mm_per_s=FEED_MM_S)
            self._motion.wait_until_idle(timeout_s=60.0)
        self._patient.clock.sleep_s(SETTLE_S)
        pixels: list[list[float]] = []
        for _ in range(FRAMES):
            frame = self._camera.capture()
            self._patient.recorder.frame("left", frame.left)
            self._patient.recorder.frame("right", frame.right)
            left, right = self._patient.find_tip(frame.left), self._patient.find_tip(frame.right)
            if left.visible and right.visible:
                pixels.append([left.x_px, left.y_px, right.x_px, right.y_px])
        if not pixels:
            raise DetectionError(f"the drill is not seen at {target} mm; clean the lenses, look what hides it")
        middle = np.median(pixels, axis=0)
        return np.asarray(self._calibration.points_from_pixels(middle[None, :2], middle[None, 2:])[0][0])


def _backlash(patient: Patient, eyes: _Eyes) -> Iterator[Check]:
    """One place reached from both sides: what lies between is play."""
    for axis, letter in enumerate("XYZ"):
        plays = [
            (eyes.see(VERIFY_SETPOINT, RUN_UP_MM, axis) - eyes.see(VERIFY_SETPOINT, -RUN_UP_MM, axis))[axis]
            for _ in range(ROUNDS)
        ]
        limit_mm = patient.limits.backlash_mm * (HEIGHT_FACTOR if letter == "Z" else 1.0)
        advice = f"tighten the nut of {letter}, or let the controller take up its backlash"
        yield at_most(f"stage: backlash of {letter}", abs(float(np.mean(plays))), limit_mm, "mm", advice)


def _against(patient: Patient, earlier: Calibration, found: Calibration) -> Iterator[Check]:
    """The drill's places of today through the eyes of the certificate: scale of each axis, turn and shift."""
    points = np.array([setpoint.point_mm for setpoint in found.setpoints if setpoint.used])
    left = np.array([setpoint.left_px for setpoint in found.setpoints if setpoint.used])
    right = np.array([setpoint.right_px for setpoint in found.setpoints if setpoint.used])
    center = points.mean(axis=0)

    def miss(p: Floats) -> Floats:
        turned = Rotation.from_rotvec(p[3:6]).apply((points - center) * (1.0 + p[:3])) + center + p[6:]
        seen_left, seen_right = earlier.project(turned)
        return np.concatenate([seen_left - left, seen_right - right]).ravel()

    fit = least_squares(miss, np.zeros(9), loss="soft_l1").x
    for axis, letter in enumerate("XYZ"):
        limit = 100.0 * patient.limits.scale * (HEIGHT_FACTOR if letter == "Z" else 1.0)
        advice = f"steps per mm of {letter} (slipping belt, wrong screw, changed setting)? {_MEANT}"
        yield at_most(f"stage: scale of {letter} as certified", 100.0 * abs(float(fit[axis])), limit, "%", advice)
    turn_deg = float(np.degrees(np.linalg.norm(fit[3:6])))
    yield at_most("stage: microscope turned since certified", turn_deg, TURN_DEG, "deg", _MEANT)
    shift_mm = float(np.linalg.norm(fit[6:8]))
    yield at_most("stage: microscope shifted since certified", shift_mm, SHIFT_MM, "mm", _MEANT)
