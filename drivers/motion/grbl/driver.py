"""GRBL 1.1 as a motion controller: gnea's 1.1h and grblHAL.

Positions of {R} become machine coordinates by ``origin_mm``; moves are written in machine coordinates, so that no work
offset can bend them. The driver writes two settings and no other: the travel of Z for the floor, which it restores,
and on 1.1h the bits of ``$10`` without which the controller does not tell how full its planner is.

Danger: GRBL has no watchdog. When the host dies, the queue runs out and the machine stops where the queue ends; a
process that holds ``stop_path`` may stop it sooner.
"""

from collections.abc import Callable, Mapping

from drivers.clock import Clock
from drivers.errors import (
    ConfigError,
    ConnectionLostError,
    DeviceFaultError,
    DeviceTimeoutError,
    NotHomedError,
    ProtocolError,
)
from drivers.motion.grbl import machine, protocol
from drivers.motion.grbl.limits import SoftLimits
from drivers.motion.grbl.session import REPLY_S, GrblSession
from drivers.motion.grbl.states import motion_state
from drivers.motion.grbl.stop_script import DRILL_OFF, STOP_SCRIPT
from drivers.motion.interface import MotionController, MotionState, MotionStatus, StopPath, Travel, Vector
from drivers.motion.queue import BlockQueue
from drivers.motion.transport import SerialLine

MAX_BLOCKS = 14
"""With its planner full, 1.1h runs a waiting line to its target even after a cancel; one block below that is safe."""
POLL_S = 0.08
"""Together with the reply about 12 Hz, which an AVR bears while it plans."""
MODAL_LINE = "G21G90G94"

_DEAD_TIME_GNEA_S = 0.040
_DEAD_TIME_HAL_S = 0.075
_SETTLE_S = 0.15


class GrblController(MotionController):
    """One GRBL controller. See ``MotionController`` for the promises; this adds only what is GRBL's own."""

    def __init__(
        self,
        line: SerialLine,
        clock: Clock,
        *,
        origin_mm: Vector,
        max_feed_mm_per_s: float,
        expected_settings: Mapping[str, float] | None = None,
        expected_firmware: str = "",
        reply_s: float = REPLY_S,
    ) -> None:
        """Reset the controller, read who it is and how it is set, and refuse one that is set wrongly.

        Args:
            line: an open line; closed again when the constructor raises.
            clock: monotonic seconds.
            origin_mm: where the controller's machine coordinates put the origin of {R}.
            max_feed_mm_per_s: the highest feed that ``start_move`` takes.
            expected_settings: settings such as "$100" that must read back as given.
            expected_firmware: what its version must begin with, such as "1.1h".
            reply_s: how long each status report is waited for; three missed ones in a row are an error.

        Raises:
            DeviceTimeoutError: no GRBL controller answers.
            ProtocolError: something answers that does not speak GRBL 1.1.
            ConfigError: firmware or a setting is not as the rig file or mill needs it.
        """
        self._clock = clock
        self._max_feed_mm_per_s = max_feed_mm_per_s
        self._session = GrblSession(line, clock, reply_s=reply_s)
        self._session.on_report = self._forget_executed
        self._queue = BlockQueue()
        self._homed = False
        self._held = False
        self._planner_blocks = 0
        self._floor_mm: float | None = None
        self._closed = False
        self.stop_drill: Callable[[], None] | None = None
        """How the drill is stopped, where one hangs on this controller."""
        try:
            self._session.reset_and_release(self._session.halts)
            self._limits = SoftLimits(self._session, origin_mm, expected_settings or {}, expected_firmware)
            self._planner_blocks = self._session.query().blocks_free or 0
            if self._session.query().blocks_free != self._planner_blocks or self._planner_blocks < 2:
                raise ProtocolError(
                    f"{line.name}: status reports do not tell the planner's room (Bf) twice alike; is $10 writable?"
                )
        except BaseException:
            self._session.close()
            raise

    @property
    def identity(self) -> str:
        """Firmware, version, and the text that the owner stored with ``$I=``."""
        return self._limits.info.identity

    @property
    def session(self) -> GrblSession:
        """The conversation, for a drill on the same controller."""
        return self._session

    @property
    def settings(self) -> Mapping[str, float]:
        """All ``$`` settings, with the travel of Z in full where a floor has shortened it."""
        return {f"${number}": value for number, value in sorted(self._limits.full_settings.items())}

    @property
    def buffer_bytes(self) -> int | None:
        """As $I tells it."""
        return self._limits.info.buffer_bytes

    @property
    def travel(self) -> Travel:
        """The travel in {R}, after soft limits and floor."""
        return self._limits.travel

    @property
    def dead_time_s(self) -> float:
        """Measured from writing a line to the motor's first step."""
        return _DEAD_TIME_HAL_S if self._limits.info.is_hal else _DEAD_TIME_GNEA_S

    def home(self) -> None:
        """Find the switches; releases a fault that was latched before. A floor stays in force."""
        session = self._session
        halts = session.halts
        self._homed = False
        if session.fault is None:
            self._come_to_rest()
        elif session.is_lost:
            session.check()
        if session.fault is not None:
            session.reset_and_release(halts)
        if self._floor_mm is not None:
            # The search for the switches is as long as the travel setting says.
            self._write_floor(None)
        self._find_switches()
        if self._floor_mm is not None:
            self._write_floor(self._floor_mm)
            if not self._homed:
                self._find_switches()

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        """Queue one straight move; returns when the controller has acknowledged it."""
        self._session.pump(0.0)
        self._session.check()
        if not self._homed:
            raise NotHomedError(f"{self._session.name}: the position is not trusted; home() first")
        self._limits.check_target(target_mm)
        if not 0 < feed_mm_per_s <= self._max_feed_mm_per_s:
            raise ConfigError(
                f"{self._session.name}: feed {feed_mm_per_s:g} mm/s; above 0 and at most {self._max_feed_mm_per_s:g} "
                "is allowed; nothing was sent"
            )
        if self._session.upset is not None:
            raise DeviceFaultError(
                f"{self._session.name}: {self._session.upset}, so that a move would not start where it should; "
                "flush() first; nothing was sent"
            )
        self._wait_for_room()
        machine_mm = self._limits.machine_mm(target_mm)
        self._session.command(protocol.move_line(machine_mm, feed_mm_per_s * 60.0))
        rates_mm_per_s = machine.rates_mm_per_s(self._limits.settings)
        self._queue.add(self._last_report().machine_mm, machine_mm, feed_mm_per_s, rates_mm_per_s)

    def status(self) -> MotionStatus:
        """A fresh report; with a fault latched the last that the controller gave, as 1.1h falls silent in an alarm."""
        session = self._session
        if session.fault is None:
            session.query()
        elif session.is_lost:
            session.check()
        else:
            session.try_query()
        return self._status()

    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        """Wait for the end of all queued motion, and of a hold if one stands."""
        deadline_s = self._clock.now_s() + timeout_s
        strays = 0
        while True:
            status = self.status()
            self._session.check()
            if status.state is MotionState.IDLE:
                end_mm = self._queue.last_target_mm
                if end_mm is None or machine.stand_at(self._last_report().machine_mm, end_mm, self._limits.settings):
                    return status
                # A broken line may have moved the axes, or a broken report lie; but a report does not lie twice.
                strays += 1
                if strays > 1:
                    words = f"the axes rest at {machine.shown(status.position_mm)} mm, where the last move does not end"
                    self._session.latch(words, position_lost=False)
                continue
            if status.state is MotionState.OTHER or status.state is MotionState.ALARM:
                raise DeviceFaultError(
                    f"{self._session.name}: the controller is in state {self._last_report().state}, in which nothing "
                    "moves; look at the machine, then home()"
                )
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._session.name}: still {status.state} after {timeout_s:g} s, about {status.queued_s:.1f} s "
                    "queued; hold() or flush() stops it"
                )
            self._session.pump_until(lambda: self._session.fault is not None, POLL_S)

    def hold(self) -> None:
        """Feed hold, by one real-time byte."""
        self._held = True
        self._session.urgent(protocol.HOLD)

    def resume(self) -> None:
        """Go on after ``hold()``, once the axes stand still: 1.1h throws a resume away that comes earlier."""
        self._session.check()
        if self._session.drill_stopped:
            raise DeviceFaultError(
                f"{self._session.name}: the drill was stopped within this hold, and resume() would start it; flush() "
                "drops the queue and leaves it off"
            )
        if not self._held and self._session.query().state != "Hold":
            return
        report = self._wait_for_standstill(2.0)
        self._held = False
        if report.state != "Hold":
            return
        self._session.urgent(protocol.RESUME)
        if self._held:
            # hold() from another thread may have been on the wire before.
            self._session.urgent(protocol.HOLD)
        deadline_s = self._clock.now_s() + 1.0
        while self._session.query().state == "Hold" and not self._held:
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._session.name}: the hold still stands 1 s after resume(); is a door or hold input active?"
                )
            self._session.pump(0.02)

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        """Hold, wait for standstill, reset: the way to drop a queue that keeps the position on both firmwares."""
        self._session.check()
        self.hold()
        self._wait_for_standstill(timeout_s)
        self._session.reset()
        self._session.check()
        self._forget_queue()
        if self._session.query().state == "Alarm":
            if self._homed:
                # A reset at standstill locks nothing, so that this was a power-up in the shade of it.
                self._session.latch("the controller locked itself during flush()", position_lost=True)
            self._session.command("$X")
        self._session.command(MODAL_LINE)
        self._session.query()
        return self._status()

    def halt(self) -> None:
        """Feed hold and reset in one write."""
        self._session.halt()

    @property
    def stop_path(self) -> StopPath | None:
        """The port, and: hold; a reset at standstill, which drops the queue and keeps the position; up."""
        descriptor = self._session.descriptor
        script = STOP_SCRIPT if self.stop_drill is None else STOP_SCRIPT + DRILL_OFF
        return None if descriptor is None else StopPath(descriptor, script)

    def set_floor(self, z_mm: float | None) -> None:
        """Write the travel of Z so that the controller refuses targets below, read it back; None restores it.

        Danger: grblHAL checks an axis against its new travel only after homing it again, so that there this homes when
        the position is trusted, and the axes end at their switches.

        Raises:
            OutOfTravelError: the floor is outside the travel or above the tip; nothing was written.
            ConfigError: Z homes at its low end.
        """
        session = self._session
        session.check()
        if z_mm is None and self._floor_mm is None:
            return
        if self.status().state is not MotionState.IDLE and self._homed:
            raise DeviceFaultError(
                f"{session.name}: a floor can only be written at standstill; wait_until_idle() first"
            )
        was_homed = self._homed
        if z_mm is not None:
            self._limits.check_floor(z_mm, self._status().position_mm[2] if was_homed else None)
        self._write_floor(z_mm)
        self._floor_mm = z_mm
        if was_homed and not self._homed:
            self._find_switches()
        self._session.tolerated_alarm = None

    def close(self) -> None:
        """Stop the drill, bring the machine to rest, restore the floor, give the line back."""
        if self._closed:
            return
        self._closed = True
        halts = self._session.halts
        try:
            # A fault has stopped the machine already.
            if self._session.fault is None:
                if self.stop_drill is not None:
                    self.stop_drill()
                self._come_to_rest()
            if self._floor_mm is not None and not self._session.is_lost:
                if self._session.fault is not None:
                    self._session.reset_and_release(halts)
                self._write_floor(None)
        except ConnectionLostError:
            pass  # There is nobody left to bring to rest.
        finally:
            self._session.close()

    def _write_floor(self, z_mm: float | None) -> None:
        self._homed = self._homed and not self._limits.forgets_homing
        self._limits.write_floor(z_mm)

    def _find_switches(self) -> None:
        try:
            self._session.command("$H", machine.homing_timeout_s(self._limits.settings))
        except DeviceTimeoutError:
            self.halt()
            raise
        self._session.command(MODAL_LINE)
        state = self._session.query().state
        if state != "Idle":
            raise DeviceFaultError(
                f"{self._session.name}: state {state} after homing; Idle is due; look at the machine"
            )
        self._session.tolerated_alarm = None
        self._forget_queue()
        self._homed = True

    def _come_to_rest(self) -> None:
        session = self._session
        try:
            state = session.query().state
            idle = self._status().state is MotionState.IDLE and session.upset is None and not self._held
            if state == "Alarm" or idle:
                return
            self.flush(2.0)
        except (DeviceTimeoutError, DeviceFaultError, ProtocolError):
            # A reset stops what does not come to rest when asked.
            session.latch("did not come to rest when asked", position_lost=True)
            session.reset()

    def _wait_for_standstill(self, timeout_s: float) -> protocol.Report:
        started_s = self._clock.now_s()
        while True:
            report = self._session.query()
            self._session.check()
            waited_s = self._clock.now_s() - started_s
            if report.state == "Hold" and report.substate == 0:
                return report
            # The first report after a hold may still be from before it.
            if waited_s > _SETTLE_S and (report.state == "Alarm" or self._status().state is MotionState.IDLE):
                return report
            if waited_s >= timeout_s:
                raise DeviceTimeoutError(
                    f"{self._session.name}: no standstill within {timeout_s:g} s of a hold, state {report.state}; "
                    "nothing was dropped and the hold stands; halt() stops at once"
                )
            self._session.pump(0.01)

    def _wait_for_room(self) -> None:
        limit = min(MAX_BLOCKS, self._planner_blocks - 1)
        while not self._held and len(self._queue) >= limit:
            report = self._session.query()
            self._session.check()
            if report.state not in ("Run", "Idle"):
                raise DeviceFaultError(
                    f"{self._session.name}: the queue is full and the controller is in state {report.state}; "
                    "resume() or flush() first"
                )
            if len(self._queue) >= limit:
                self._session.pump(0.02)
        if self._held:
            raise DeviceFaultError(f"{self._session.name}: a hold stands; resume() or flush() first; nothing was sent")

    def _forget_executed(self, report: protocol.Report) -> None:
        if report.blocks_free is not None:
            self._queue.keep_newest(self._planner_blocks - report.blocks_free)

    def _forget_queue(self) -> None:
        self._queue.clear()
        self._held = False

    def _last_report(self) -> protocol.Report:
        if self._session.report is None:
            self._session.query()
        assert self._session.report is not None
        return self._session.report

    def _status(self) -> MotionStatus:
        report = self._last_report()
        fault = self._session.fault
        waits = self._session.has_unacknowledged
        locked = "locked since power-up; home() releases" if report.state == "Alarm" else None
        return MotionStatus(
            state=MotionState.ALARM if fault else motion_state(report, self._planner_blocks, waits=waits),
            position_mm=self._limits.robot_mm(report.machine_mm),
            queued_s=self._queue.duration_s(report.machine_mm, standing=report.state == "Idle"),
            time_s=self._session.report_time_s,
            alarm=fault.words if fault else locked,
        )
