"""Motion and spindle under one watch: every move gives a sign of life, looks at the drill, and can be stopped."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from math import ceil

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceTimeoutError, SafetyStop
from drivers.motion.interface import MotionController, MotionState, MotionStatus, Vector
from drivers.recorder import ForgivingRecorder, Recorder
from drivers.spindle.interface import Spindle, SpindleStatus
from milling.equipment import Guard
from milling.latch import Latch, Reaction

READ_BACK_MM = 0.02
LIFT_MM = 0.1
"""Up from the bone after a hold: dwelling on the membrane tears it."""
RETRACT_MM = 1.5
HIGH_MM = 1.0
"""From here on up the drill may stop."""
RETRACT_FEED_MM_S = 15.0
TRAVEL_FEED_MM_S = 15.0
PIECE_S = 0.04
QUEUED_S = 0.12
"""Written ahead of where the tip is: what it still does when nobody speaks any more."""
_POLL_S = 0.02
_BEAT_S = 0.005
_SPEED_SHARE = 0.15
_STANDSTILL_RPM = 100.0
SLOWS_WITHIN_S = 0.5
"""A drill that was told to stop loses speed at least so often."""
LATE_S = 0.05


class Interrupted(Exception):  # noqa: N818  (a person's wish, not an error)
    """A person asked for a stop."""


@dataclass
class Hands:
    """The two devices that can do harm, and the request to stop that is looked at in every wait."""

    motion: MotionController
    spindle: Spindle
    clock: Clock
    recorder: Recorder
    stop_requested: Callable[[], bool]
    guard: Guard | None = None
    speed_rpm: float = 0.0
    """The speed the drill should have; 0 while it should stand."""
    on_torque: list[Callable[[SpindleStatus], None]] = field(default_factory=list)
    """Told each new report of the drill."""
    _reported_s: float = float("-inf")
    _beat_at_s: float = float("inf")
    _in_bone: bool = False

    def beat(self) -> SpindleStatus:
        """A sign of life to the drive, and its report, judged.

        Raises:
            Interrupted: a stop was asked for.
            DeviceError: the drive faults, stalls, runs away, or starts by itself.
        """
        if self.stop_requested():
            raise Interrupted("stop requested")
        self._live()
        status = self.spindle.status()
        if status.fault is not None:
            raise DeviceError(f"spindle: {status.fault}")
        if abs(abs(status.speed_rpm) - self.speed_rpm) > max(_SPEED_SHARE * self.speed_rpm, _STANDSTILL_RPM):
            raise DeviceError(
                f"spindle: {status.speed_rpm:.0f} rpm where {self.speed_rpm:.0f} rpm are commanded, allowed "
                f"+-{100 * _SPEED_SHARE:.0f} %"
            )
        if status.time_s > self._reported_s:
            self._reported_s = status.time_s
            for told in self.on_torque:
                told(status)
        return status

    def _live(self) -> None:
        """A sign of life to the supervisor; in the bone, long waits between them go into the record."""
        self._tell_guard(lambda guard: guard.beat())
        now_s = self.clock.now_s()
        if self._in_bone and now_s - self._beat_at_s > LATE_S:
            self.recorder.event("late", silent_s=now_s - self._beat_at_s)
        self._beat_at_s = now_s

    def go(self, target_mm: Vector, feed_mm_s: float) -> MotionStatus:
        """One straight move, watched to its end and read back.

        Raises:
            SafetyStop: the controller stands somewhere else than it was sent to.
            DeviceTimeoutError: it does not arrive.
            Interrupted, DeviceError: as ``beat``.
        """
        self.beat()
        self.motion.start_move(target_mm, feed_mm_per_s=feed_mm_s)
        return self._arrive(target_mm, feed_mm_s)

    def travel(self, target_mm: Vector, feed_mm_s: float) -> MotionStatus:
        """A long way, straight, in pieces: when nobody speaks any more, the tip runs for ``QUEUED_S`` at most.

        Raises:
            SafetyStop, DeviceTimeoutError, Interrupted, DeviceError: as ``go``.
        """
        if not self.motion.travel.contains(target_mm):
            # Refused as a whole, in the controller's words, and not where the way leaves the travel.
            return self.go(target_mm, feed_mm_s)
        start_mm, deadline_s = self.motion.status().position_mm, float("inf")
        pieces = max(1, ceil(distance_mm(start_mm, target_mm) / (feed_mm_s * PIECE_S)))
        ahead_s, written = 0.0, 0
        while True:
            self.beat()
            while written < pieces and ahead_s + PIECE_S <= QUEUED_S:
                written, ahead_s = written + 1, ahead_s + PIECE_S
                piece = between_mm(start_mm, target_mm, written / pieces) if written < pieces else target_mm
                self.motion.start_move(piece, feed_mm_per_s=feed_mm_s)
            if written == pieces:
                return self._arrive(target_mm, feed_mm_s)
            if deadline_s == float("inf"):
                deadline_s = self.clock.now_s() + 3.0 + 3.0 * pieces * PIECE_S
            ahead_s = self._on_the_way(target_mm, deadline_s).queued_s
            self.clock.sleep_s(_BEAT_S)

    def _arrive(self, target_mm: Vector, feed_mm_s: float) -> MotionStatus:
        """Watch the last of the way, and read back where it ends."""
        began_s, deadline_s = self.clock.now_s(), float("inf")
        while True:
            self.beat()
            status = self._on_the_way(target_mm, deadline_s)
            if deadline_s == float("inf"):
                deadline_s = began_s + 3.0 + 3.0 * distance_mm(status.position_mm, target_mm) / feed_mm_s
            if status.state is MotionState.IDLE and status.queued_s <= 0:
                break
            self.clock.sleep_s(_BEAT_S)
        if (miss := distance_mm(status.position_mm, target_mm)) > READ_BACK_MM:
            raise SafetyStop(
                f"the controller stands at {status.position_mm} mm, {miss:.3f} mm from where it was sent "
                f"({target_mm} mm), allowed {READ_BACK_MM} mm"
            )
        return status

    def _on_the_way(self, target_mm: Vector, deadline_s: float) -> MotionStatus:
        status = self.motion.status()
        if status.state not in (MotionState.IDLE, MotionState.MOVING):
            raise DeviceError(f"motion: {status.state} ({status.alarm or 'no alarm'}) on the way to {target_mm} mm")
        if self.clock.now_s() > deadline_s:
            raise DeviceTimeoutError(f"motion: not at {target_mm} mm in time, now at {status.position_mm} mm")
        return status

    def go_high(self, target_mm: Vector, high_z_mm: float) -> None:
        """Up first, then across, then down: the way may lead over the skull.

        Raises:
            SafetyStop, DeviceTimeoutError, Interrupted, DeviceError: as ``go``.
        """
        x, y, z = self.motion.status().position_mm
        high = max(z, high_z_mm)
        if high > z:
            self.travel((x, y, high), TRAVEL_FEED_MM_S)
        self.travel((target_mm[0], target_mm[1], high), TRAVEL_FEED_MM_S)
        if target_mm[2] < high:
            self.travel(target_mm, TRAVEL_FEED_MM_S)

    def settle(self) -> MotionStatus:
        """Let the queue, which is short, run out.

        Raises:
            DeviceTimeoutError: it does not.
        """
        deadline_s = self.clock.now_s() + 1.0
        while True:
            self.beat()
            status = self.motion.status()
            if status.state is MotionState.IDLE and status.queued_s <= 0:
                return status
            if self.clock.now_s() > deadline_s:
                raise DeviceTimeoutError(f"motion: still {status.state} 1 s after the last segment")
            self.clock.sleep_s(_BEAT_S)

    def watch(self, duration_s: float) -> None:
        """Let time pass with signs of life."""
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            self.beat()
            self.clock.sleep_s(_BEAT_S)

    def start_spindle(self, speed_rpm: float, timeout_s: float = 8.0) -> None:
        """Run up and wait; the drill must be in the air.

        Raises:
            DeviceTimeoutError: not at speed in time.
        """
        self.spindle.start(speed_rpm)
        deadline_s = self.clock.now_s() + timeout_s
        while True:
            if self.stop_requested():
                raise Interrupted("stop requested")
            status = self.spindle.status()
            if status.fault is not None:
                raise DeviceError(f"spindle: {status.fault}")
            if abs(abs(status.speed_rpm) - speed_rpm) < 0.02 * speed_rpm:
                break
            if self.clock.now_s() > deadline_s:
                raise DeviceTimeoutError(
                    f"spindle: {status.speed_rpm:.0f} rpm after {timeout_s:g} s, {speed_rpm:.0f} rpm commanded"
                )
            self.clock.sleep_s(_POLL_S)
        self.speed_rpm = speed_rpm
        self.recorder.event("spindle", state="at speed", speed_rpm=status.speed_rpm)

    def into_the_bone(self) -> None:
        """From now on a silence of this process stops the motion."""
        self._in_bone, self._beat_at_s = True, self.clock.now_s()
        self._arm(True)

    def out_of_the_bone(self) -> None:
        """The drill is in the air: this process may take its time."""
        self._in_bone = False
        self._arm(False)

    def _arm(self, watched: bool) -> None:
        self._tell_guard(lambda guard: guard.arm() if watched else guard.disarm())

    def _tell_guard(self, say: Callable[[Guard], None]) -> None:
        """A supervisor that is gone is an error once; what makes the machine safe must not stumble over it again."""
        guard = self.guard
        if guard is not None:
            try:
                say(guard)
            except DeviceError:
                self.guard = None
                raise

    def lift(self, height_mm: float, when_high: Callable[[], None] = lambda: None) -> None:
        """Drop what is queued, then straight up.

        Args:
            height_mm: how far.
            when_high: called once, ``HIGH_MM`` up as the controller reports it, or at the end.

        Raises:
            DeviceError: the controller does not answer, or its position is lost.
        """
        status = self.motion.status()
        if status.state is not MotionState.IDLE or status.queued_s > 0:
            # Its first bytes hold the motion. Until it is over nobody gives a sign of life, and nobody else may reset.
            if self._in_bone:
                self._arm(False)
            self.motion.hold()
            # The drive waits a quarter of a second for a sign of life, and a flush takes most of that. Should it be
            # silent itself, the lift is what counts; the next beat says so.
            with contextlib.suppress(DeviceError):
                self.spindle.status()
            status = self.motion.flush(timeout_s=0.5)
            if self._in_bone:
                self._arm(True)
        position = status.position_mm
        top = min(position[2] + height_mm, self.motion.travel.high_mm[2])
        self.motion.start_move((position[0], position[1], top), feed_mm_per_s=RETRACT_FEED_MM_S)
        deadline_s = self.clock.now_s() + 0.5
        is_low, lost = True, None
        while True:
            self._live()
            # A drive that cannot be asked any more is told of once the drill is out of the bone.
            lost = lost or _error_of(self.spindle.status)
            status = self.motion.status()
            if is_low and status.position_mm[2] >= min(position[2] + HIGH_MM, top):
                is_low = False
                lost = _error_of(when_high) or lost
            if status.state is MotionState.IDLE and status.queued_s <= 0:
                break
            if self.clock.now_s() > deadline_s:
                raise DeviceTimeoutError(f"motion: lifting is not confirmed, now at {status.position_mm} mm")
            self.clock.sleep_s(_BEAT_S)
        if abs(status.position_mm[2] - top) > READ_BACK_MM:
            raise DeviceError(f"motion: lifted to z = {status.position_mm[2]:.3f} mm, {top:.3f} mm commanded")
        if lost is not None:
            raise lost

    def make_safe(self, latch: Latch) -> Latch:
        """React to what is latched. Whatever fails on the way, both stops are tried; never raises a device's error."""
        self.recorder = ForgivingRecorder(self.recorder)
        self.recorder.event("latched", reaction=latch.reaction.name, reason=latch.reason)
        if latch.reaction is not Reaction.KILL:
            # Where the supervisor has stopped the motion as well, this waits until it is done: never both at a time.
            if self.guard is not None and self.guard.stopped() is not None:
                self.guard = None
            try:
                if latch.reaction is Reaction.HOLD:
                    self.lift(LIFT_MM)
                self.lift(RETRACT_MM, self._let_spindle_stop)
                self.recorder.event("state", state="lifted")
                self.out_of_the_bone()
                self.stop_spindle()
            except (DeviceError, OSError) as error:
                latch.trip(Reaction.KILL, str(error))
                self.recorder.event("error", where="retract", reason=str(error))
            else:
                return latch
        self.kill()
        return latch

    def _let_spindle_stop(self) -> None:
        self.speed_rpm = 0.0
        self.spindle.stop()

    def stop_spindle(self, timeout_s: float = 3.0) -> None:
        """Stop the drill and see it stand.

        Raises:
            DeviceError: it does not stand in time, or the drive is silent.
        """
        self._let_spindle_stop()
        self._see_it_stand(timeout_s)
        self.recorder.event("spindle", state="off, confirmed")

    def kill(self) -> None:
        """Spindle off and controller reset together; each is tried whatever the other does."""
        self.recorder = ForgivingRecorder(self.recorder)
        self.speed_rpm = 0.0
        for name, stop in (("spindle", self.spindle.stop), ("motion", self.motion.halt)):
            try:
                stop()
            except (DeviceError, OSError) as error:
                self.recorder.event("error", where=f"stop {name}", reason=str(error))
        # Not before both: a supervisor that is at work is waited for here.
        with contextlib.suppress(DeviceError):
            self.out_of_the_bone()
        try:
            self._see_it_stand(2.0)
        except (DeviceError, OSError) as error:
            self.recorder.event("spindle", state="off, NOT confirmed", reason=str(error))
        else:
            self.recorder.event("spindle", state="off, confirmed")

    def _see_it_stand(self, timeout_s: float) -> None:
        """Wait for standstill, as long as the drill slows down; one that does not is not waited for.

        Raises:
            DeviceError: it turns on, does not stand in time, or the drive is silent.
        """
        start_s = slowed_s = self.clock.now_s()
        lowest_rpm = float("inf")
        while (speed_rpm := abs(self.spindle.status().speed_rpm)) > _STANDSTILL_RPM:
            now_s = self.clock.now_s()
            if speed_rpm < lowest_rpm - _STANDSTILL_RPM:
                lowest_rpm, slowed_s = speed_rpm, now_s
            if now_s - slowed_s > SLOWS_WITHIN_S or now_s - start_s > timeout_s:
                raise DeviceError(
                    f"spindle: told to stop {now_s - start_s:.1f} s ago and still at {speed_rpm:.0f} rpm; use the "
                    "emergency stop"
                )
            self.clock.sleep_s(_BEAT_S)
        self.spindle.wait_until_at_speed(timeout_s)


def _error_of(do: Callable[[], object]) -> DeviceError | None:
    try:
        do()
    except DeviceError as error:
        return error
    return None


def distance_mm(a: Vector, b: Vector) -> float:
    """Between two points."""
    return float(sum((p - q) ** 2 for p, q in zip(a, b, strict=True)) ** 0.5)


def between_mm(a: Vector, b: Vector, share: float) -> Vector:
    """The point so far on the way from ``a`` to ``b``; rounded, as a path's points are."""
    x, y, z = (round(p + (q - p) * share, 4) for p, q in zip(a, b, strict=True))
    return (x, y, z)
