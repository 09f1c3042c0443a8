"""The automatic procedure: the drill visits setpoints, both eyes find its ball, and the camera pair follows.

Everything moves in free air. Nothing here knows a make of device or a network: positions come from a
`MotionController`, pictures from a `StereoCamera`, and `find_tip` finds the ball's centre in one picture.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from calib.calibration_file import Calibration, Provenance, RigIdentity, Setpoint
from calib.camera_fit import MIN_SETPOINTS, PairFit, fit_camera_pair, fit_paper
from calib.setpoints import FREE_AIR, PAPER_SETPOINTS, VERIFY_SETPOINT, default_setpoints
from calib.transform import Array
from drivers.camera.interface import Image, StereoCamera
from drivers.clock import Clock
from drivers.errors import CalibrationError, DetectionError, OutOfTravelError
from drivers.motion.interface import MotionController, Vector
from drivers.recorder import NullRecorder, Recorder

Recipe = Literal["default", "paper"]

TIP_LIMIT_PX = 10.0
"""The paper's gate on a detected tip."""
RMSE_LIMIT_MM = 1.0
"""The paper's gate on a calibration."""
_READ_BACK_MM = 0.02
_MISPAIRED_PX = 40.0
"""More than roll and scale of two eyes of one microscope can part their rows by."""
_MAX_HIDDEN_SHARE = 0.25
_SECOND_TRY_MM = 1.5
_MECHANICS_SIGMA_MM = 0.02
"""Backlash and run-out of the drill at standstill, per axis."""
_VERIFY_SIGMAS = 4.5
"""Limit on the Mahalanobis distance of four pixel coordinates: one false alarm in some 2500 checks."""


class Keypoint(Protocol):
    """What a finder tells of the ball's centre in one picture."""

    @property
    def x_px(self) -> float:
        """To the right."""

    @property
    def y_px(self) -> float:
        """Downwards."""

    @property
    def sigma_px(self) -> float:
        """1-sigma of each coordinate."""

    @property
    def visible(self) -> bool:
        """Whether the place means anything."""


FindTip = Callable[[Image], Keypoint]
Progress = Callable[[int, int, str], None]
"""Setpoints done, setpoints in all, and a line for a person."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One setpoint as both eyes saw it."""

    point_mm: Array
    """(3,): the ball's centre in {R}, from the controller's position and the tool offset."""
    left_px: Array
    right_px: Array
    sigma_px: float
    """What the detector claims for one coordinate of one picture."""


@dataclass(frozen=True, eq=False)
class Verification:
    """One setpoint seen again with an existing calibration."""

    error_mm: Array
    """(3,): where the eyes put the ball's centre minus where the robot put it."""
    sigma_mm: Array
    """(3,): the predicted 1-sigma of that."""
    error_px: float
    """RMS of the four pixel coordinates against their prediction."""
    distance_sigmas: float
    """Mahalanobis distance of the four pixel coordinates."""


def calibrate(
    motion: MotionController,
    camera: StereoCamera,
    find_tip: FindTip,
    *,
    clock: Clock,
    setpoints_mm: Sequence[Vector] | None = None,
    recipe: Recipe = "default",
    tool_offset_mm: Vector = (0.0, 0.0, 0.0),
    frames_per_setpoint: int = 4,
    settle_s: float = 0.3,
    feed_mm_per_s: float = 10.0,
    spindle_identity: str = "",
    camera_settings: str = "",
    provenance: Provenance | None = None,
    recorder: Recorder | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Visit the setpoints in free air and fit both eyes to what they see. Blocks; the drill ends above the last one.

    Args:
        motion: homed; its drill must not turn.
        camera: sees the drill at every setpoint.
        find_tip: finds the ball's centre in one picture.
        clock: the devices' clock.
        setpoints_mm: tip positions in {R}; the recipe's own where left out.
        recipe: ``default``, or ``paper`` for its five coplanar setpoints and linear model (not for milling).
        tool_offset_mm: from the tip to the ball's centre.
        frames_per_setpoint: pairs to take the median of.
        settle_s: rest before the first picture.
        feed_mm_per_s: of all moves.
        spindle_identity: goes into the file.
        camera_settings: exposure and what else must stay as it is; goes into the file.
        provenance: date, software and weights for the file.
        recorder: takes an event for each sighting, and its pictures.
        progress: told after each setpoint.

    Raises:
        OutOfTravelError: a setpoint outside the travel or the free air; nothing moved.
        CalibrationError: the drill was not seen often enough, or the fit cannot be trusted; the cause is named.
        DeviceError: a device failed.
    """
    recorder = recorder or NullRecorder()
    if setpoints_mm is None:
        setpoints_mm = PAPER_SETPOINTS if recipe == "paper" else default_setpoints(travel=motion.travel)
    _require_free_air(motion, setpoints_mm)
    sightings: list[Sighting] = []
    hidden: list[str] = []
    recorder.event("calibration.setpoints", targets_mm=[list(target) for target in setpoints_mm])
    _lift(motion, max(target[2] for target in setpoints_mm), feed_mm_per_s)
    _approach(motion, setpoints_mm[0], feed_mm_per_s)
    for done, target in enumerate(setpoints_mm, start=1):
        sighting = None
        for place in (target, _beside(target, setpoints_mm)):
            reached = _go(motion, place, feed_mm_per_s)
            clock.sleep_s(settle_s)
            try:
                sighting = _sight(camera, find_tip, reached, tool_offset_mm, frames_per_setpoint, recorder)
                break
            except DetectionError as error:
                reason = str(error)
                recorder.event("calibration.hidden", target_mm=list(place), reason=reason)
        if sighting is None:
            hidden.append(f"{target}: {reason}")
            recorder.event("calibration.missed", target_mm=list(target), reason=reason)
            note = "not seen"
        else:
            sightings.append(sighting)
            recorder.event(
                "calibration.sighting",
                target_mm=list(target),
                point_mm=sighting.point_mm.tolist(),
                left_px=sighting.left_px.tolist(),
                right_px=sighting.right_px.tolist(),
            )
            note = f"left {sighting.left_px.round(1).tolist()} right {sighting.right_px.round(1).tolist()} px"
        if progress is not None:
            progress(done, len(setpoints_mm), f"{target} mm: {note}")
    _lift(motion, max(target[2] for target in setpoints_mm), feed_mm_per_s)
    sightings, mispaired = _paired(sightings)
    hidden += [f"{tuple(sighting.point_mm.tolist())}: the eyes see it in rows apart" for sighting in mispaired]
    if len(hidden) > _MAX_HIDDEN_SHARE * len(setpoints_mm):
        raise CalibrationError(
            f"calibration: the drill was not seen at {len(hidden)} of {len(setpoints_mm)} setpoints "
            f"({'; '.join(hidden)}); check focus, light and that the drill is in both pictures"
        )
    fit = _fit(sightings, recipe, camera.size_px)
    _require_paper_gates(fit)
    rig = RigIdentity(
        motion=motion.identity,
        camera=camera.identity,
        spindle=spindle_identity,
        center_from_tip_mm=tool_offset_mm,
        camera_settings=camera_settings,
    )
    calibration = _calibration(sightings, fit, recipe, rig, provenance or Provenance())
    recorder.event(
        "calibration.fit",
        model=fit.model,
        rmse_mm=fit.rmse_mm,
        predicted_rmse_mm=calibration.predicted_rmse_mm,
        sigma_px=fit.pair.sigma_px,
        left_out=hidden,
        outliers_mm=[list(setpoint.point_mm) for setpoint in calibration.outliers],
    )
    return calibration


def verify(
    calibration: Calibration,
    motion: MotionController,
    camera: StereoCamera,
    find_tip: FindTip,
    *,
    clock: Clock,
    setpoint_mm: Vector = VERIFY_SETPOINT,
    frames: int = 4,
    settle_s: float = 0.3,
    feed_mm_per_s: float = 10.0,
    recorder: Recorder | None = None,
) -> Verification:
    """Look at one setpoint again; the drill ends at it. The tool offset is the calibration's own.

    Raises:
        OutOfTravelError: the setpoint lies outside the travel or the free air; nothing moved.
        CalibrationError: the eyes and the robot disagree by more than the calibration predicts, or by 10 px or 1 mm.
        DetectionError: the drill is not seen.
        DeviceError: a device failed.
    """
    recorder = recorder or NullRecorder()
    _require_free_air(motion, [setpoint_mm])
    _approach(motion, setpoint_mm, feed_mm_per_s)
    reached = _go(motion, setpoint_mm, feed_mm_per_s)
    clock.sleep_s(settle_s)
    offset = calibration.rig.center_from_tip_mm
    sighting = _sight(camera, find_tip, reached, offset, frames, recorder)
    point, left, right = sighting.point_mm[None], sighting.left_px[None], sighting.right_px[None]
    pair = calibration.pair
    residual = np.hstack([left, right])[0] - np.hstack(pair.project(point))[0]
    spread = pair.pixel_covariance_at(point, _MECHANICS_SIGMA_MM)[0]
    triangulated, covariance = pair.points_from_pixels(left, right)
    result = Verification(
        triangulated[0] - point[0],
        np.sqrt(np.diag(covariance[0]) + _MECHANICS_SIGMA_MM**2),
        float(np.sqrt((residual**2).mean())),
        float(np.sqrt(residual @ np.linalg.solve(spread, residual))),
    )
    error_mm = float(np.linalg.norm(result.error_mm))
    recorder.event(
        "calibration.verified",
        error_mm=result.error_mm.tolist(),
        sigma_mm=result.sigma_mm.tolist(),
        error_px=result.error_px,
        distance_sigmas=result.distance_sigmas,
    )
    if not (result.distance_sigmas <= _VERIFY_SIGMAS and result.error_px <= TIP_LIMIT_PX and error_mm <= RMSE_LIMIT_MM):
        raise CalibrationError(
            f"verification at {setpoint_mm} mm: off by {result.error_mm.round(3).tolist()} mm "
            f"(1 sigma {result.sigma_mm.round(3).tolist()} mm), {result.error_px:.2f} px, "
            f"{result.distance_sigmas:.1f} sigmas; allowed {_VERIFY_SIGMAS} sigmas, {TIP_LIMIT_PX:g} px, "
            f"{RMSE_LIMIT_MM:g} mm: camera, drill or stage has moved, or steps were lost; home and run `mill calibrate`"
        )
    return result


def _require_free_air(motion: MotionController, targets: Sequence[Vector]) -> None:
    for target in targets:
        if not motion.travel.contains(target):
            raise OutOfTravelError(
                f"setpoint {target} mm is outside the travel {motion.travel.low_mm} to {motion.travel.high_mm} mm; "
                "nothing moved"
            )
        if target[2] < FREE_AIR.low_mm[2]:
            raise OutOfTravelError(
                f"setpoint {target} mm is below z = {FREE_AIR.low_mm[2]:g} mm, where the specimen may be; nothing moved"
            )


def _lift(motion: MotionController, z_mm: float, feed_mm_per_s: float) -> None:
    """Straight up to ``z_mm``, if the tip is below."""
    x, y, z = motion.status().position_mm
    if z < z_mm:
        _go(motion, (x, y, z_mm), feed_mm_per_s)


def _approach(motion: MotionController, target: Vector, feed_mm_per_s: float) -> None:
    """Above ``target`` without ever going down beside it: the way there may cross the specimen."""
    _lift(motion, target[2], feed_mm_per_s)
    _go(motion, (target[0], target[1], motion.status().position_mm[2]), feed_mm_per_s)


def _beside(target: Vector, setpoints_mm: Sequence[Vector]) -> Vector:
    """A little nearer to the middle of all setpoints, where glare or dust need not hide the drill again."""
    inwards = np.mean(setpoints_mm, axis=0) - target
    distance = float(np.linalg.norm(inwards))
    share = min(1.0, _SECOND_TRY_MM / distance) if distance > 0.0 else 0.0
    x, y, z = (round(float(value), 3) for value in target + share * inwards)
    return x, y, z


def _go(motion: MotionController, target: Vector, feed_mm_per_s: float) -> Array:
    """Move, wait, and read the position back: (3,), mm."""
    distance = float(np.linalg.norm(np.subtract(target, motion.status().position_mm)))
    motion.start_move(target, feed_mm_per_s=feed_mm_per_s)
    reached = np.array(motion.wait_until_idle(timeout_s=5.0 + 3.0 * distance / feed_mm_per_s).position_mm)
    if (error := float(np.linalg.norm(reached - target))) > _READ_BACK_MM:
        raise CalibrationError(
            f"calibration: the controller stopped at {reached.tolist()} mm, {error:.3f} mm from {target}, "
            f"allowed {_READ_BACK_MM} mm; home the machine and check its steps per mm"
        )
    return reached


def _sight(
    camera: StereoCamera,
    find_tip: FindTip,
    reached_mm: Array,
    tool_offset_mm: Vector,
    frames: int,
    recorder: Recorder,
) -> Sighting:
    """The median over ``frames`` fresh pairs, so that one wild detection does not count.

    Raises:
        DetectionError: one eye misses the drill in more than half of them.
    """
    seen: dict[str, list[tuple[float, float, float]]] = {"left": [], "right": []}
    for index in range(frames):
        pair = camera.capture()
        for side, image in (("left", pair.left), ("right", pair.right)):
            if index == 0:
                recorder.frame(f"calibration_{side}", image)
            tip = find_tip(image)
            if tip.visible and np.isfinite([tip.x_px, tip.y_px, tip.sigma_px]).all():
                seen[side].append((tip.x_px, tip.y_px, tip.sigma_px))
    for side, places in seen.items():
        if 2 * len(places) < frames or not places:
            raise DetectionError(f"drill tip seen in {len(places)} of {frames} {side} pictures, at least half needed")
    left, right = (np.array(places) for places in seen.values())
    return Sighting(
        reached_mm + tool_offset_mm,
        np.median(left[:, :2], axis=0),
        np.median(right[:, :2], axis=0),
        float(np.sqrt((np.concatenate([left[:, 2], right[:, 2]]) ** 2).mean())),
    )


def _paired(sightings: Sequence[Sighting]) -> tuple[list[Sighting], list[Sighting]]:
    """The sightings whose two eyes can be looking at one thing, their rows differing as elsewhere; and the others."""
    if not sightings:
        return [], []
    rows = [sighting.left_px[1] - sighting.right_px[1] for sighting in sightings]
    apart = np.abs(rows - np.median(rows)) > _MISPAIRED_PX
    good = [sighting for sighting, is_apart in zip(sightings, apart, strict=True) if not is_apart]
    return good, [sighting for sighting, is_apart in zip(sightings, apart, strict=True) if is_apart]


def _fit(sightings: Sequence[Sighting], recipe: Recipe, size_px: tuple[int, int]) -> PairFit:
    if len(sightings) < MIN_SETPOINTS - 2:
        raise CalibrationError(f"calibration: {len(sightings)} usable setpoints, at least {MIN_SETPOINTS} are needed")
    fit = fit_paper if recipe == "paper" else fit_camera_pair
    return fit(
        np.array([s.point_mm for s in sightings]),
        np.array([s.left_px for s in sightings]),
        np.array([s.right_px for s in sightings]),
        size_px=size_px,
        detector_sigma_px=float(np.sqrt(np.mean([s.sigma_px**2 for s in sightings]))),
    )


def _calibration(
    sightings: Sequence[Sighting], fit: PairFit, recipe: Recipe, rig: RigIdentity, provenance: Provenance
) -> Calibration:
    def vector(values: Array) -> Vector:
        x, y, z = (float(value) for value in values)
        return x, y, z

    def pixel(values: Array) -> tuple[float, float]:
        return float(values[0]), float(values[1])

    setpoints = tuple(
        Setpoint(
            point_mm=vector(s.point_mm),
            left_px=pixel(s.left_px),
            right_px=pixel(s.right_px),
            residual_mm=vector(fit.residuals_mm[i]),
            leave_one_out_mm=float(fit.leave_one_out_mm[i]),
            used=bool(fit.used[i]),
        )
        for i, s in enumerate(sightings)
    )
    return Calibration(
        fit.pair,
        recipe,
        fit.model,
        fit.candidates_mm,
        fit.handedness,
        fit.handedness != "right-handed" or recipe == "paper",
        fit.rmse_mm,
        setpoints,
        rig,
        provenance,
    )


def _require_paper_gates(fit: PairFit) -> None:
    error_px = np.sqrt((fit.residuals_px[fit.used] ** 2).mean(axis=1)).max()
    if not (error_px <= TIP_LIMIT_PX and fit.rmse_mm <= RMSE_LIMIT_MM):
        raise CalibrationError(
            f"calibration: held-out RMSE {fit.rmse_mm:.3f} mm, worst setpoint {error_px:.2f} px; "
            f"allowed {RMSE_LIMIT_MM:g} mm and {TIP_LIMIT_PX:g} px: check focus and light, that nothing slips, and the "
            "robot's steps per mm"
        )
