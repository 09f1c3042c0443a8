"""One window, from the parked drill to the report's last line.

    home -> verify the calibration -> park, look: landmarks, surface, ring -> floor into the controller
    -> approach, run up, feel the air -> contact at every point -> laps -> look with the drill aside -> laps ...
    -> retract

Whatever ends it, the drill is lifted (or killed) and confirmed to stand, and the record says why.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from drivers.camera.interface import Image, StereoCamera, StereoFrame
from drivers.clock import Clock
from drivers.errors import CalibrationError, DetectionError, MillError, NotHomedError, PlanError, SafetyStop
from drivers.motion.interface import MotionController, Vector
from drivers.recorder import Recorder
from drivers.spindle.interface import Spindle
from milling.contact import ContactFinder, measure_idle
from milling.eyes import CompletionReader, RingView, Watch
from milling.hands import RETRACT_MM, Hands, Interrupted
from milling.job import Job
from milling.laps import Laps, Permits
from milling.load import LoadMeter
from milling.permission import Latch, Ledger, Limits, PointState, Reaction, reaction_to
from milling.planner import policy_for
from milling.published import Unguarded
from milling.surface import fit_surface, point_at
from milling.trajectory import Trajectory, plan

if TYPE_CHECKING:
    from calib.calibration_file import Calibration

Floats = npt.NDArray[np.float64]
Outcome = Literal["complete", "held", "aborted"]

TRAVEL_FEED_MM_S = 15.0
CLEARANCE_MM = 3.0
"""Above the highest start while crossing the skull."""
ASIDE_MM = 3.0
"""From the ring's edge to the drill while the ring is looked at: the shank leans away from the ring."""
LOOK_FRAMES = 4
LOOK_HALF_PX = 160.0


class Keypoint(Protocol):
    """A place in a picture; see ``vision.keypoints``."""

    @property
    def x_px(self) -> float:
        """To the right."""

    @property
    def y_px(self) -> float:
        """Downwards."""

    @property
    def sigma_px(self) -> float:
        """Of each coordinate."""

    @property
    def visible(self) -> bool:
        """Whether the place means anything."""


FindTip = Callable[[Image], Keypoint]
FindLandmarks = Callable[[Image], tuple[Keypoint, Keypoint]]


@dataclass(frozen=True)
class Rig:
    """The devices and what the rig file says about them."""

    motion: MotionController
    spindle: Spindle
    camera: StereoCamera
    clock: Clock
    center_from_tip_mm: Vector
    park_mm: Vector


@dataclass(frozen=True)
class Finders:
    """What looks at pictures: ``TipFinder.find``, ``LandmarkFinder.find``, and a ``CompletionReader``."""

    find_tip: FindTip
    find_landmarks: FindLandmarks
    completion: CompletionReader


@dataclass(frozen=True)
class Progress:
    """What a person sees while it goes on."""

    stage: str
    detail: str = ""
    lap: float = 0.0
    depth_mm: tuple[float, ...] = ()
    completion: tuple[float, ...] = ()
    state: tuple[str, ...] = ()
    torque_fraction: float = 0.0
    milling_time_s: float = 0.0


@dataclass(frozen=True)
class RunResult:
    """How it ended. ``points`` holds one object per point: depth, contact, completion, state, permission history."""

    outcome: Outcome
    reason: str
    milling_time_s: float
    laps: float
    points: tuple[dict[str, Any], ...] = ()
    center_mm: Vector | None = None
    radius_mm: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain JSON."""
        return asdict(self)


def run(
    rig: Rig,
    calibration: "Calibration",
    finders: Finders,
    job: Job,
    recorder: Recorder,
    *,
    progress: Callable[[Progress], None] = lambda _: None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> RunResult:
    """Mill one window. Never raises for what a machine, a picture or a person can do; the result says why it ended.

    Afterwards the drill stands, confirmed or else named in the record, and is out of the bone unless the
    controller's position was lost.

    Args:
        rig: open devices.
        calibration: of this rig.
        finders: tip, landmarks, completion.
        job: what to mill.
        recorder: takes every event; the caller closes it.
        progress: told at each stage and lap.
        stop_requested: looked at before every segment and in every wait; True ends the run within a second.
    """
    return _Run(rig, calibration, finders, job, recorder, progress, stop_requested).run()


@dataclass
class _Run:
    rig: Rig
    calibration: "Calibration"
    finders: Finders
    job: Job
    recorder: Recorder
    progress: Callable[[Progress], None]
    stop_requested: Callable[[], bool]
    latch: Latch = field(default_factory=Latch)
    trajectory: Trajectory | None = None
    contact_z_mm: list[float] = field(default_factory=list)
    ledger: Ledger | None = None
    permits: Permits | None = None
    laps: Laps | None = None
    milling_from_s: float | None = None
    milling_time_s: float = 0.0

    def __post_init__(self) -> None:
        rig = self.rig
        self.hands = Hands(rig.motion, rig.spindle, rig.clock, self.recorder, self.stop_requested)
        self.policy = policy_for(self.job)
        self.offset = np.asarray(rig.center_from_tip_mm, dtype=np.float64)

    def run(self) -> RunResult:
        """All stages, and whatever ends them."""
        outcome: Outcome
        self.recorder.event("state", state="start", job=asdict(self.job))
        try:
            outcome, reason = self._stages()
        except (Interrupted, KeyboardInterrupt):
            outcome, reason = "aborted", "stopped by a person"
            self._make_safe(Reaction.RETRACT, reason)
        except (CalibrationError, DetectionError, PlanError) as error:
            # The machine is well; it is the plan that must not be carried out.
            outcome, reason = ("aborted" if self.milling_from_s is None else "held"), str(error)
            self._make_safe(Reaction.RETRACT, reason)
        except (MillError, OSError) as error:
            outcome, reason = ("held" if isinstance(error, SafetyStop) else "aborted"), str(error)
            self._make_safe(reaction_to(error), reason)
        except BaseException as error:
            self._make_safe(Reaction.RETRACT, f"{type(error).__name__}: {error}")
            raise
        self._stop_watch()
        if self.latch.reaction is Reaction.KILL:
            outcome = "aborted"
            reason = f"{reason}; the drill was stopped where it stood, the position is lost: lift by hand, then home"
        result = self._result(outcome, reason)
        self.recorder.event("outcome", **result.to_json())
        self._tell("done", f"{outcome}: {reason}")
        return result

    # The stages.

    def _stages(self) -> tuple[Outcome, str]:
        self._home()
        self._verify()
        reference, self.trajectory = self._survey()
        self._set_floor(self.trajectory.lowest_tip_z_mm(self.job.thickness_high_mm))
        self._approach()
        idle = measure_idle(self.hands)
        self.recorder.event("idle", torque=idle.mean, sigma=idle.sigma)
        self.milling_from_s = self.rig.clock.now_s()
        meter = None
        if self.policy.guarded:
            self._tell("contact")
            self._find_contacts(ContactFinder(self.hands, idle, self._floor_mm))
            meter = LoadMeter(
                self.job.n_points,
                idle,
                ball_radius_mm=self.job.ball_radius_mm,
                sound_depth_mm=self.job.thickness_low_mm,
            )
        top = np.asarray(self.contact_z_mm) if self.policy.guarded else self.trajectory.tip_mm[:, 2]
        watch = self._watch(reference, top)
        self.laps = Laps(
            self.hands, watch, self._permits(), meter, self.policy, self.trajectory, top, self.job, self._tell_lap
        )
        outcome, reason = self._mill(self.laps, watch)
        self._tell("retract")
        self._leave()
        return outcome, reason

    def _home(self) -> None:
        motion = self.rig.motion
        try:
            motion.start_move(motion.status().position_mm, feed_mm_per_s=1.0)
        except NotHomedError:
            self._tell("home")
            motion.home()
        self._check_stop()

    def _verify(self) -> None:
        from calib.procedure import verify

        self._tell("verify", "one setpoint, both eyes")
        found = verify(
            self.calibration,
            self.rig.motion,
            self.rig.camera,
            self.finders.find_tip,
            clock=self.rig.clock,
            recorder=self.recorder,
        )
        error_mm = float(np.linalg.norm(found.error_mm))
        self._gate("calibration", error_mm, self.job.calibration_gate_mm, "mm", CalibrationError)
        self._gate("drill tip", found.error_px, self.job.detection_gate_px, "px", DetectionError)
        self._check_stop()

    def _survey(self) -> tuple[Image, Trajectory]:
        """The picture of the unmilled skull, and the ring on it."""
        from vision.disparity import match

        job, motion = self.job, self.rig.motion
        self._tell("park")
        self._go_high(self.rig.park_mm)
        self.rig.clock.sleep_s(0.2)
        frame = self.rig.camera.capture()
        self.recorder.frame("reference_left", frame.left)
        self.recorder.frame("reference_right", frame.right)
        self._tell("landmarks")
        center_px, left_px, right_px = self._landmarks(frame)
        rough, _ = self.calibration.points_from_pixels(center_px[None], right_px[None])
        x, y = center_px
        matches = match(
            frame.left,
            frame.right,
            right_from_left=self.calibration.right_from_left(float(rough[0, 2])),
            region=(x - LOOK_HALF_PX, y - LOOK_HALF_PX, x + LOOK_HALF_PX, y + LOOK_HALF_PX),
        )
        self._check_stop()
        points, covariance = self.calibration.points_from_pixels(matches.left_px, matches.right_px)
        center = point_at(points, matches.left_px, center_px)
        self._tell("surface", f"{len(points)} matched places")
        surface = fit_surface(points, covariance[:, 2, 2], center[:2], job.radius_mm + 2 * job.ball_radius_mm + 0.5)
        trajectory = plan(surface, center, job, self.offset, motion.travel, flat=self.policy.flat_start)
        self.recorder.event(
            "surface",
            x_mm=surface.x_mm[::2],
            y_mm=surface.y_mm[::2],
            z_mm=surface.z_mm[::2, ::2],
            matches=len(points),
            measured=surface.measured.mean(),
        )
        self.recorder.event(
            "trajectory",
            center_mm=trajectory.center_mm,
            ball_mm=trajectory.ball_mm,
            tip_mm=trajectory.tip_mm,
            fit_mm=trajectory.fit_mm,
            sigma_mm=trajectory.sigma_mm,
            offset_mm=trajectory.offset_mm,
            bregma_px=left_px[0],
            lambda_px=left_px[1],
            note=trajectory.note,
        )
        self._tell("trajectory", trajectory.note)
        return frame.left, trajectory

    def _landmarks(self, frame: StereoFrame) -> tuple[Floats, Floats, Floats]:
        """The ring's centre in the left picture, the landmarks (2, 2) there, and the centre in the right picture."""
        centers = []
        for side, image in (("left", frame.left), ("right", frame.right)):
            points = []
            for name, found in zip(("bregma", "lambda"), self.finders.find_landmarks(image), strict=True):
                if not found.visible:
                    raise DetectionError(
                        f"{name} is not seen in the {side} picture; clear the skull, check light and focus"
                    )
                self._gate(
                    f"{name} in the {side} picture", found.sigma_px, self.job.detection_gate_px, "px", DetectionError
                )
                points.append((found.x_px, found.y_px))
            ratio = self.job.landmark_ratio
            places = np.array(points)
            centers.append((places, (1 - ratio) * places[0] + ratio * places[1]))
        (left, center), (_, right_center) = centers
        return center, left, right_center

    def _set_floor(self, z_mm: float) -> None:
        self.rig.motion.set_floor(z_mm)
        self._floor_mm = self.rig.motion.travel.low_mm[2]
        self.recorder.event("floor", z_mm=z_mm, read_back_mm=self._floor_mm)

    def _approach(self) -> None:
        assert self.trajectory is not None
        x, y, _ = self.trajectory.tip_mm[0]
        self._tell("approach")
        self._go_high((float(x), float(y), float(self.trajectory.tip_mm[:, 2].max()) + CLEARANCE_MM))
        self._tell("spindle", f"{self.job.spindle_rpm:.0f} rpm")
        self.hands.start_spindle(self.job.spindle_rpm)

    def _find_contacts(self, finder: ContactFinder) -> None:
        assert self.trajectory is not None
        tip = self.trajectory.tip_mm
        ledger = self.ledger = Ledger(self.job.n_points, self._limits())

        def told(index: int, height: float) -> None:
            self.contact_z_mm.append(height)
            ledger.touched(index)
            self.recorder.event("contact", point=index + 1, z_mm=height, predicted_mm=predicted[index])
            self._tell("contact", f"point {index + 1} of {self.job.n_points}")

        predicted = [float(z) for z in self.trajectory.contact_z_mm]
        finder.find_all([(float(x), float(y)) for x, y in tip[:, :2]], [float(z) for z in tip[:, 2]], predicted, told)

    def _mill(self, laps: Laps, watch: Watch) -> tuple[Outcome, str]:
        while True:
            self._tell("mill")
            finished = laps.mill()
            if self.ledger is None:
                if finished:
                    return "complete", "the picture says that every point is done"
                return "held", "every point stands at the calibrated floor and the picture does not say done"
            if not finished:
                self.ledger.stall()
            self._look(watch)
            if self.ledger.done:
                return "complete", "every point is through, judged again with the drill aside"
            if not self.ledger.open_points:
                stuck = [i for i, point in enumerate(self.ledger.points) if point.state is PointState.STOPPED]
                names = ", ".join(f"{i + 1} ({self.ledger.points[i].why})" for i in stuck)
                return "held", f"no cue says that these points are through, and no look may re-open them: {names}"

    def _look(self, watch: Watch) -> None:
        """Judge every point again with nothing in front of it."""
        assert self.trajectory is not None
        assert self.ledger is not None
        self._tell("look")
        self.hands.lift(RETRACT_MM)
        edge = float(self.trajectory.center_mm[0]) + self.job.radius_mm + ASIDE_MM - float(self.offset[0])
        x, y, z = self.rig.motion.status().position_mm
        high = max(z, float(self.trajectory.tip_mm[:, 2].max()) + CLEARANCE_MM)
        self.hands.go((x, y, high), TRAVEL_FEED_MM_S)
        self.hands.go((edge, float(self.trajectory.center_mm[1]), high), TRAVEL_FEED_MM_S)
        self.hands.watch(0.1)
        for _ in range(LOOK_FRAMES):
            self.hands.beat()
            watch.stare(1)
        for index, point in enumerate(self.ledger.points):
            before = point.state
            after = self.ledger.look(index)
            if after is not before:
                kind = "reopened" if after is PointState.OPEN else after.value
                self.recorder.event(kind, point=index + 1, why=point.why, depth_mm=point.cut_mm)

    def _leave(self) -> None:
        self.hands.lift(RETRACT_MM)
        self.recorder.event("state", state="lifted")
        self.hands.stop_spindle()
        self._stop_watch()
        self.rig.motion.set_floor(None)
        self._go_high(self.rig.park_mm)

    # Helpers.

    def _permits(self) -> Permits:
        if self.ledger is not None:
            self.permits = self.ledger
        else:
            assert self.trajectory is not None
            self.permits = Unguarded([float(z) - self._floor_mm for z in self.trajectory.tip_mm[:, 2]])
        return self.permits

    def _watch(self, reference: Image, top_z_mm: Floats) -> Watch:
        assert self.trajectory is not None
        ball = self.trajectory.ball_mm
        bottom = top_z_mm + self.offset[2] - self.job.ball_radius_mm
        if not self.policy.guarded:
            bottom = self.trajectory.fit_mm[:, 2]
        ring = np.column_stack([ball[:, :2], bottom])
        view = RingView(self.calibration, ring, self.job.ball_radius_mm, self.offset)
        self.recorder.event("ring", ring_px=view.ring_px, radius_px=view.radius_px, ring_mm=ring)
        witness = self._permits()
        return Watch(self.rig.camera, self.finders.completion, view, reference, witness, self.rig.clock, self.recorder)

    def _limits(self) -> Limits:
        job = self.job
        return Limits(
            bite_mm=job.bite_mm,
            late_bite_mm=job.late_bite_mm,
            late_margin_mm=job.late_margin_mm,
            thickness_low_mm=job.thickness_low_mm,
            thickness_high_mm=job.thickness_high_mm,
            threshold=job.completion_threshold,
        )

    def _go_high(self, target: Vector) -> None:
        """Up first, then across, then down: the way may lead over the skull."""
        x, y, z = self.rig.motion.status().position_mm
        high = max(z, target[2], self.rig.park_mm[2] if self.trajectory is None else target[2])
        if high > z:
            self.hands.go((x, y, high), TRAVEL_FEED_MM_S)
        self.hands.go((target[0], target[1], high), TRAVEL_FEED_MM_S)
        if target[2] < high:
            self.hands.go(target, TRAVEL_FEED_MM_S)

    def _gate(self, what: str, found: float, allowed: float, unit: str, error: type[MillError]) -> None:
        if not found <= allowed:
            raise error(
                f"{what}: off by {found:.2f} {unit}, allowed {allowed:g} {unit}; calibrate again, check light and focus"
            )

    def _check_stop(self) -> None:
        if self.stop_requested():
            raise Interrupted("stop requested")

    def _make_safe(self, reaction: Reaction, reason: str) -> None:
        self.latch.trip(reaction, reason)
        try:
            self.hands.make_safe(self.latch)
        except BaseException:
            # A second Ctrl-C while lifting: both stops, at once.
            self.hands.kill()
            self.latch.trip(Reaction.KILL, reason)
            raise

    def _stop_watch(self) -> None:
        if self.milling_from_s is not None:
            self.milling_time_s = self.rig.clock.now_s() - self.milling_from_s
            self.milling_from_s = None

    def _tell(self, stage: str, detail: str = "") -> None:
        self.recorder.event("stage", stage=stage, detail=detail)
        self.progress(Progress(stage, detail))

    def _tell_lap(self) -> None:
        assert self.laps is not None
        assert self.permits is not None
        n = self.job.n_points
        depth = tuple(self.permits.cut_mm(i) for i in range(n))
        completion = tuple(self.permits.completion(i) for i in range(n))
        state = tuple(point.state.value for point in self.ledger.points) if self.ledger is not None else ()
        elapsed = 0.0 if self.milling_from_s is None else self.rig.clock.now_s() - self.milling_from_s
        self.recorder.event(
            "lap",
            lap=round(self.laps.laps, 3),
            depth_mm=depth,
            completion=completion,
            upper=[point.upper for point in self.ledger.points] if self.ledger is not None else None,
            load_ratio=[point.load_ratio for point in self.ledger.points] if self.ledger is not None else None,
            state=state,
            torque=self.laps.torque,
        )
        self.progress(Progress("mill", "", self.laps.laps, depth, completion, state, self.laps.torque, elapsed))

    def _result(self, outcome: Outcome, reason: str) -> RunResult:
        points: list[dict[str, Any]] = []
        for index in range(self.job.n_points if self.permits is not None else 0):
            assert self.permits is not None
            entry: dict[str, Any] = {
                "depth_mm": self.permits.cut_mm(index),
                "completion": self.permits.completion(index),
            }
            if self.ledger is not None:
                point = self.ledger.points[index]
                entry |= {
                    "contact_mm": self.contact_z_mm[index],
                    "upper": point.upper,
                    "load_ratio": point.load_ratio,
                    "state": point.state.value,
                    "why": point.why,
                    "permissions": dict(point.verdicts),
                }
            points.append(entry)
        center = None if self.trajectory is None else tuple(float(v) for v in self.trajectory.ball_mm.mean(axis=0))
        return RunResult(
            outcome,
            reason,
            self.milling_time_s,
            0.0 if self.laps is None else self.laps.laps,
            tuple(points),
            None if center is None else (center[0], center[1], center[2]),
            None if center is None else self.job.radius_mm,
        )
