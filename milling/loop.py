"""One window, from the parked drill to the report's last line.

    home -> verify the calibration -> park, look: landmarks, surface, ring -> floor into the controller
    -> approach, run up, feel the air -> contact at every point -> laps -> look with the drill aside -> laps ...
    -> retract

Whatever ends it, the drill is lifted (or killed) and confirmed to stand, and the record says why.
"""

import gc
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from drivers.camera.interface import Image
from drivers.errors import CalibrationError, DetectionError, MillError, NotHomedError, PlanError, SafetyStop
from drivers.recorder import Recorder
from milling.conclusion import conclude
from milling.contact import ContactFinder, measure_idle, measure_idle_again
from milling.equipment import Finders, Rig
from milling.eyes import RingView, Watch
from milling.hands import RETRACT_MM, Hands, Interrupted
from milling.job import Job
from milling.journal import lap_told, points_told
from milling.laps import Laps, Permits
from milling.latch import Latch, Reaction, reaction_to
from milling.load import Idle, LoadMeter, require_load
from milling.permission import Ledger
from milling.planner import policy_for
from milling.point import PointState
from milling.published import Unguarded
from milling.result import Outcome, Progress, RunResult
from milling.standing import Standing, require_unmoved, touch_again
from milling.survey import survey, verify_calibration
from milling.thickness import Thickness
from milling.trajectory import Trajectory

if TYPE_CHECKING:
    from calib.calibration_file import Calibration

__all__ = ["Finders", "Outcome", "Progress", "Rig", "RunResult", "run"]

Floats = npt.NDArray[np.float64]

CLEARANCE_MM = 3.0
"""Above the highest start while crossing the skull."""
ASIDE_MM = 3.0
"""From the ring's edge to the drill while the ring is looked at: the shank leans away from the ring."""
LOOK_FRAMES = 4
MOST_IDLE_ROUNDS = 2
"""Laps and looks in a row in which no point got deeper."""


def run(
    rig: Rig,
    calibration: "Calibration",
    finders: Finders,
    job: Job,
    recorder: Recorder,
    *,
    progress: Callable[[Progress], None] = lambda _: None,
    stop_requested: Callable[[], bool] = lambda: False,
    standing: Standing | None = None,
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
        standing: an earlier run's window, to go on with.

    Raises:
        ConfigError: the drill cannot feel bone; nothing has moved.
    """
    require_load(rig.spindle)
    try:
        return _Run(rig, calibration, finders, job, recorder, progress, stop_requested, standing).run()
    finally:
        gc.unfreeze()


def _settle_memory() -> None:
    """A full garbage collection looks at all that was ever loaded, for a tenth of a second, and that in the bone.

    What is there by now is not looked at again until the run is over.
    """
    gc.collect()
    gc.freeze()


@dataclass
class _Ring:
    """What exists once the bone is under the drill."""

    trajectory: Trajectory
    top_z_mm: Floats
    """(n,) tip heights at depth zero."""
    permits: Permits
    ledger: Ledger | None
    """The permits where they are guarded."""
    watch: Watch
    laps: Laps
    meter: LoadMeter | None
    """What the spindle feels, where permits are guarded."""


@dataclass
class _Run:
    rig: Rig
    calibration: "Calibration"
    finders: Finders
    job: Job
    recorder: Recorder
    progress: Callable[[Progress], None]
    stop_requested: Callable[[], bool]
    standing: Standing | None = None
    recalled: Ledger | None = None
    """The permits of an earlier run."""
    latch: Latch = field(default_factory=Latch)
    ring: _Ring | None = None
    milling_from_s: float | None = None
    milling_time_s: float = 0.0

    def __post_init__(self) -> None:
        rig = self.rig
        self.hands = Hands(rig.motion, rig.spindle, rig.clock, self.recorder, self.stop_requested, rig.guard)
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
            reason = f"{reason}; the position is not trusted any more: see that the drill is out of the bone, then home"
        result = self._result(outcome, reason)
        self.recorder.event("outcome", **result.to_json())
        self._tell("done", f"{outcome}: {reason}")
        return result

    # The stages.

    def _stages(self) -> tuple[Outcome, str]:
        self._home()
        self._tell("verify", "one setpoint, both eyes")
        verify_calibration(self.rig, self.calibration, self.finders, self.job, self.recorder)
        self._check_stop()
        self._tell("park")
        self.hands.go_high(self.rig.park_mm, self.rig.park_mm[2])
        self.hands.watch(0.2)
        if self.standing is None:
            reference, trajectory = survey(
                self.rig, self.calibration, self.finders, self.job, self.recorder, self._tell,
                flat_start=self.policy.flat_start,
            )  # fmt: skip
        else:
            reference, trajectory = self._recognize(self.standing)
        self._check_stop()
        _settle_memory()
        floor_mm = self._set_floor(trajectory.lowest_tip_z_mm(self.job.thickness_high_mm))
        idle = self._approach(trajectory)
        self.milling_from_s = self.rig.clock.now_s()
        self.ring = self._guarded(trajectory, reference, idle, floor_mm) if self.policy.guarded else None
        self.ring = self.ring or self._unguarded(trajectory, reference, floor_mm)
        if self.standing is not None and self.ring.ledger is not None:
            self._look(self.ring, self.ring.ledger)
        outcome, reason = self._mill(self.ring)
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

    def _set_floor(self, z_mm: float) -> float:
        self.rig.motion.set_floor(z_mm)
        floor_mm = self.rig.motion.travel.low_mm[2]
        self.recorder.event("floor", z_mm=z_mm, read_back_mm=floor_mm)
        return floor_mm

    def _approach(self, trajectory: Trajectory) -> Idle:
        """Above the first point, turning; the torque of the air."""
        x, y, _ = trajectory.tip_mm[0]
        self._tell("approach")
        above = (float(x), float(y), float(trajectory.tip_mm[:, 2].max()) + CLEARANCE_MM)
        self.hands.go_high(above, above[2])
        self._tell("spindle", f"{self.job.spindle_rpm:.0f} rpm")
        self.hands.start_spindle(self.job.spindle_rpm)
        idle = measure_idle(self.hands)
        self.recorder.event("idle", torque=idle.mean, sigma=idle.sigma)
        return idle

    def _recognize(self, standing: Standing) -> tuple[Image, Trajectory]:
        """The skull of the earlier run, where it was; its unmilled picture and its ring."""
        now = self.rig.camera.capture().left
        self.recorder.frame("reference_left", standing.reference)
        self.recorder.frame("now_left", now)
        ring_px = self.calibration.project(standing.trajectory.fit_mm)[0]
        shift_px = require_unmoved(standing, now, ring_px)
        self._tell("recognized", f"the skull lies where it lay, to {shift_px:.1f} px")
        standing.trajectory.tell(self.recorder)
        # Here, where the drill is parked: it takes longer than the drive waits for a sign of life.
        self.recalled = standing.ledger(self.job)
        return standing.reference, standing.trajectory

    def _guarded(self, trajectory: Trajectory, reference: Image, idle: Idle, floor_mm: float) -> _Ring:
        """Contact under every point, and the ledger that counts from it; or both as an earlier run left them."""
        job, tip = self.job, trajectory.tip_mm
        ledger = Ledger(job.n_points, job.limits, Thickness(job.n_points, job.limits, pitch_mm=trajectory.pitch_mm))
        predicted = [float(z) for z in trajectory.contact_z_mm]

        def told(index: int, height: float) -> None:
            ledger.touched(index)
            self.recorder.event("contact", point=index + 1, z_mm=height, predicted_mm=predicted[index])
            self._tell("contact", f"point {index + 1} of {job.n_points}")

        def told_again(index: int, height: float) -> None:
            self._tell("contact", f"the kerf's floor under point {index + 1}, z = {height:.3f} mm")

        self._tell("contact")
        self.hands.into_the_bone()
        finder = ContactFinder(self.hands, idle, floor_mm)
        if self.standing is None or self.recalled is None:
            found = finder.find_all(
                [(float(x), float(y)) for x, y in tip[:, :2]], [float(z) for z in tip[:, 2]], predicted, told
            )
        else:
            ledger = self.recalled
            found = touch_again(self.standing, ledger, finder, told_again)
            self.hands.lift(RETRACT_MM)
            self.hands.out_of_the_bone()
            self.standing.tell(self.recorder)
            # What is deeper than the old journal says, and last of all the contacts, which make this record whole.
            for index, height in enumerate(found):
                self.recorder.event("cut", point=index + 1, depth_mm=ledger.cut_mm(index))
                self.recorder.event("contact", point=index + 1, z_mm=height, predicted_mm=predicted[index])
        top = np.asarray(found)
        meter = LoadMeter(
            found,
            finder.idle,
            pitch_mm=trajectory.pitch_mm,
            ball_radius_mm=job.ball_radius_mm,
            sound_depth_mm=job.thickness_low_mm,
        )
        if self.standing is not None:
            self.standing.recall_loads(meter)
        bottom = top + self.offset[2] - job.ball_radius_mm
        return self._ring(trajectory, reference, top, bottom, ledger, ledger, meter)

    def _unguarded(self, trajectory: Trajectory, reference: Image, floor_mm: float) -> _Ring:
        """As published: from the start, down to the floor."""
        top = trajectory.tip_mm[:, 2]
        permits = Unguarded([float(z) - floor_mm for z in top])
        return self._ring(trajectory, reference, top, trajectory.fit_mm[:, 2], permits, None, None)

    def _ring(
        self,
        trajectory: Trajectory,
        reference: Image,
        top: Floats,
        surface_z: Floats,
        permits: Permits,
        ledger: Ledger | None,
        meter: LoadMeter | None,
    ) -> _Ring:
        ring_mm = np.column_stack([trajectory.ball_mm[:, :2], surface_z])
        view = RingView(self.calibration, ring_mm, self.job.ball_radius_mm, self.offset)
        self.recorder.event("ring", ring_px=view.ring_px, radius_px=view.radius_px, ring_mm=ring_mm)
        rig = self.rig
        watch = Watch(rig.camera, self.finders.completion, view, reference, permits, rig.clock, self.recorder)
        laps = Laps(self.hands, watch, permits, meter, self.policy, trajectory, top, self.job, self._tell_lap)
        return _Ring(trajectory, top, permits, ledger, watch, laps, meter)

    def _mill(self, ring: _Ring) -> tuple[Outcome, str]:
        idle_rounds, cut_before_mm = 0, -1.0
        while True:
            self._tell("mill")
            self.hands.into_the_bone()
            finished = ring.laps.mill()
            ledger = ring.ledger
            if ledger is None:
                if finished:
                    return "complete", "the picture says that every point is done"
                return "held", "every point stands at the calibrated floor and the picture does not say done"
            if not finished:
                ledger.stall()
                self.recorder.event("stalled")
            self._look(ring, ledger)
            if ledger.done:
                return conclude(ledger)
            cut_mm = sum(point.cut_mm for point in ledger.points)
            idle_rounds = 0 if cut_mm > cut_before_mm else idle_rounds + 1
            cut_before_mm = cut_mm
            if not ledger.open_points or idle_rounds >= MOST_IDLE_ROUNDS:
                return conclude(ledger)

    def _look(self, ring: _Ring, ledger: Ledger) -> None:
        """Judge every point again with nothing in front of it."""
        self._tell("look")
        self.hands.lift(RETRACT_MM)
        self.hands.out_of_the_bone()
        center = ring.trajectory.center_mm
        edge = float(center[0]) + self.job.radius_mm + ASIDE_MM - float(self.offset[0])
        z = self.rig.motion.status().position_mm[2]
        high = max(z, float(ring.trajectory.tip_mm[:, 2].max()) + CLEARANCE_MM)
        aside = (edge, float(center[1]), high)
        self.hands.go_high(aside, high)
        if ring.meter is not None:
            ring.meter.idle = measure_idle_again(self.hands, ring.meter.idle)
        for _ in range(LOOK_FRAMES):
            self.hands.beat()
            ring.watch.stare(1, aside)
        for index, point in enumerate(ledger.points):
            before = point.state
            after = ledger.look(index)
            if after is not before:
                kind = "reopened" if after is PointState.OPEN else after.value
                self.recorder.event(kind, point=index + 1, why=point.why, depth_mm=point.cut_mm)
        self.recorder.event("looked", known=[ledger.snapshot(index) for index in range(len(ledger.points))])

    def _leave(self) -> None:
        self.hands.lift(RETRACT_MM)
        self.hands.out_of_the_bone()
        self.recorder.event("state", state="lifted")
        self.hands.stop_spindle()
        self._stop_watch()
        self.rig.motion.set_floor(None)
        self.hands.go_high(self.rig.park_mm, self.rig.park_mm[2])

    # Helpers.

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

    def _tell_lap(self, laps: Laps) -> None:
        elapsed_s = 0.0 if self.milling_from_s is None else self.rig.clock.now_s() - self.milling_from_s
        told, progress = lap_told(laps, self.job.n_points, elapsed_s)
        self.recorder.event("lap", **told)
        self.progress(progress)

    def _result(self, outcome: Outcome, reason: str) -> RunResult:
        ring = self.ring
        if ring is None:
            return RunResult(outcome, reason, self.milling_time_s, 0.0)
        points = points_told(ring.permits, ring.top_z_mm.tolist())
        x, y, z = (float(value) for value in ring.trajectory.ball_mm.mean(axis=0))
        radius_mm = float(np.linalg.norm(ring.trajectory.ball_mm[:, :2] - [x, y], axis=1).mean())
        return RunResult(outcome, reason, self.milling_time_s, ring.laps.laps, points, (x, y, z), radius_mm)
