"""A g2core board (TinyG's successor, JSON over USB) as a motion controller.

Positions of {R} become machine coordinates by ``origin_mm``; moves are written in machine coordinates, so that no work
offset can bend them, with a checksum that the board verifies. The driver writes how the board is to speak, and one
other setting: the low end of Z for the floor, which it restores.

Danger: g2core has no watchdog. When the host dies, the queue runs out and the machine stops where the queue ends; a
process that holds ``stop_path`` may stop it sooner.
"""

from collections.abc import Mapping

from drivers.clock import Clock
from drivers.errors import (
    ConfigError,
    ConnectionLostError,
    DeviceFaultError,
    DeviceTimeoutError,
    NotHomedError,
    OutOfTravelError,
    ProtocolError,
)
from drivers.motion.interface import MotionController, MotionState, MotionStatus, StopPath, Travel, Vector
from drivers.motion.queue import BlockQueue
from drivers.motion.tinyg import machine, protocol
from drivers.motion.tinyg.limits import SoftLimits
from drivers.motion.tinyg.session import AT_REST, MOVING, REPLY_S, TinyGSession
from drivers.motion.transport import SerialLine

MAX_BLOCKS = 14
"""More would only lengthen what a host that dies leaves behind."""
POLL_S = 0.05

STOP_SCRIPT = (
    (protocol.HOLD, 0.2),
    (protocol.FLUSH, 0.1),
    (b"G21G91G1Z1.5F900\nG90\n", 0.4),
)
"""Hold; drop the queue at standstill, which keeps the position; 1.5 mm up at 15 mm/s, and the time that takes. A board
in an alarm refuses to lift."""

_DEAD_TIME_S = 0.050
"""From standstill the board waits 30 ms for more blocks before it moves (BLOCK_TIMEOUT_MS); the rest is on its way."""
_SETTLE_S = 0.1
_STATES = {protocol.HOMING: MotionState.HOMING, protocol.ALARM: MotionState.ALARM, protocol.SHUTDOWN: MotionState.ALARM}


class TinyGController(MotionController):
    """One board. See ``MotionController`` for the promises; this adds only what is the board's own."""

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
        """Stop what the board does, read who it is and how it is set, and refuse one that is set wrongly.

        Args:
            line: an open line; closed again when the constructor raises.
            clock: monotonic seconds.
            origin_mm: where the board's machine coordinates put the origin of {R}.
            max_feed_mm_per_s: the highest feed that ``start_move`` takes.
            expected_settings: settings such as "xtn" that must read back as given.
            expected_firmware: what its build must begin with, such as "101.".
            reply_s: how long each status report is waited for; three missed ones in a row are an error.

        Raises:
            DeviceTimeoutError: no board answers.
            ProtocolError: something answers that is no g2core.
            ConfigError: firmware or a setting is not as the rig file or mill needs it.
        """
        self._clock = clock
        self._max_feed_mm_per_s = max_feed_mm_per_s
        self._session = TinyGSession(line, clock, reply_s=reply_s)
        self._session.on_report = self._take_report
        self._queue = BlockQueue()
        self._homed = False
        self._held = False
        self._planner_blocks = 0
        self._floor_mm: float | None = None
        self._closed = False
        try:
            halts = self._session.halts
            self._session.settle()
            self._session.release(halts)
            self._limits = SoftLimits(self._session, origin_mm, expected_settings or {}, expected_firmware)
            self._planner_blocks = self._session.query().blocks_free
            if self._planner_blocks < 2:
                raise ProtocolError(f"{line.name}: {self._planner_blocks} blocks free at rest (qr); 28 or more are due")
        except BaseException:
            self._session.close()
            raise

    @property
    def identity(self) -> str:
        """Build, version, and the board's own serial number."""
        return self._limits.identity

    @property
    def settings(self) -> Mapping[str, float]:
        """Settings of system, axes and motors, with the low end of Z in full where a floor has raised it."""
        return dict(sorted(self._limits.full_settings.items()))

    @property
    def travel(self) -> Travel:
        """The travel in {R}, after soft limits and floor."""
        return self._limits.travel

    @property
    def dead_time_s(self) -> float:
        """From writing a line to the tip moving."""
        return _DEAD_TIME_S

    def home(self) -> None:
        """Find the switches; releases a fault that was latched before. A floor stays in force."""
        session = self._session
        halts = session.halts
        self._homed = False
        if session.is_lost:
            session.check()
        session.settle()
        had_fault = session.fault is not None
        session.release(halts)
        self._forget_queue()
        if had_fault:
            # The fault may have been a reset, after which the board speaks as it likes.
            self._limits.configure()
            self._limits.read_again()
        if self._floor_mm is not None:
            # The search for the switches is as long as the travel says.
            self._limits.write_floor(None)
        self._find_switches()
        if self._floor_mm is not None:
            self._limits.write_floor(self._floor_mm)
        self._homed = True

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        """Queue one straight move; returns when the board has taken it as it was written."""
        session = self._session
        session.pump(0.0)
        session.check()
        if not self._homed:
            raise NotHomedError(f"{session.name}: the position is not trusted; home() first")
        travel = self._limits.travel
        if not travel.contains(target_mm):
            raise OutOfTravelError(
                f"{session.name}: target {_shown(target_mm)} mm is outside the travel "
                f"{_shown(travel.low_mm)} to {_shown(travel.high_mm)} mm of {{R}}; nothing was sent"
            )
        if not 0 < feed_mm_per_s <= self._max_feed_mm_per_s:
            raise ConfigError(
                f"{session.name}: feed {feed_mm_per_s:g} mm/s; above 0 and at most {self._max_feed_mm_per_s:g} "
                "is allowed; nothing was sent"
            )
        if session.upset is not None:
            raise DeviceFaultError(
                f"{session.name}: {session.upset}, so that a move would not start where it should; flush() first; "
                "nothing was sent"
            )
        self._wait_for_room()
        machine_mm = self._limits.machine_mm(target_mm)
        session.gcode(protocol.move_block(machine_mm, feed_mm_per_s * 60.0))
        rates_mm_per_s = machine.rates_mm_per_s(self._limits.settings)
        self._queue.add(self._last_report().machine_mm, machine_mm, feed_mm_per_s, rates_mm_per_s)

    def status(self) -> MotionStatus:
        """A fresh report; with a fault latched the last that the board gave, if it gives no other."""
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
        while True:
            status = self.status()
            self._session.check()
            if status.state is MotionState.IDLE:
                return status
            if status.state in (MotionState.OTHER, MotionState.ALARM):
                raise DeviceFaultError(
                    f"{self._session.name}: the board is in state {self._last_report().stat}, in which nothing moves; "
                    "look at the machine, then home()"
                )
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._session.name}: still {status.state} after {timeout_s:g} s, about {status.queued_s:.1f} s "
                    "queued; hold() or flush() stops it"
                )
            self._session.pump_until(lambda: self._session.fault is not None, POLL_S)

    def hold(self) -> None:
        """Feed hold, by one character."""
        self._held = True
        self._session.urgent(protocol.HOLD)

    def resume(self) -> None:
        """Go on after ``hold()``, once the axes stand still."""
        session = self._session
        session.check()
        if not self._held and session.query().stat != protocol.HOLDING:
            return
        report = self._wait_for_standstill(2.0)
        self._held = False
        if report.stat != protocol.HOLDING:
            return
        session.urgent(protocol.RESUME)
        if self._held:
            # hold() from another thread may have been on the wire before.
            session.urgent(protocol.HOLD)
        deadline_s = self._clock.now_s() + 1.0
        while session.query().stat == protocol.HOLDING and not self._held:
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{session.name}: the hold still stands 1 s after resume(); is an interlock active?"
                )
            session.pump(0.02)

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        """Hold, wait for standstill, and have the board drop its queue, which keeps the position."""
        session = self._session
        session.check()
        self.hold()
        if self._wait_for_standstill(timeout_s).stat == protocol.HOLDING:
            session.urgent(protocol.FLUSH)
            self._wait_for_dropped_queue()
        session.check()
        session.settle()
        session.check()
        self._forget_queue()
        session.query()
        return self._status()

    def halt(self) -> None:
        """Feed hold and the end of the job in one write."""
        self._session.halt()

    @property
    def stop_path(self) -> StopPath | None:
        """The port, and: hold; drop the queue at standstill; up."""
        descriptor = self._session.descriptor
        return None if descriptor is None else StopPath(descriptor, STOP_SCRIPT)

    def set_floor(self, z_mm: float | None) -> None:
        """Write the low end of Z so that the board refuses targets below, read it back; None restores it.

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
        if z_mm is not None:
            self._limits.check_floor(z_mm, self._status().position_mm[2] if self._homed else None)
        self._limits.write_floor(z_mm)
        self._floor_mm = z_mm

    def close(self) -> None:
        """Bring the machine to rest, restore the floor, give the line back."""
        if self._closed:
            return
        self._closed = True
        session = self._session
        halts = session.halts
        try:
            if not session.is_lost:
                session.settle()
                if self._floor_mm is not None:
                    session.release(halts)
                    self._limits.write_floor(None)
        except ConnectionLostError:
            pass  # There is nobody left to bring to rest.
        finally:
            session.close()

    def _find_switches(self) -> None:
        session = self._session
        session.gcode("G28.2X0Y0Z0")
        deadline_s = self._clock.now_s() + machine.homing_timeout_s(self._limits.settings)
        session.pump(_SETTLE_S)
        while session.query().stat in MOVING:
            session.check()
            if self._clock.now_s() >= deadline_s:
                self.halt()
                raise DeviceTimeoutError(f"{session.name}: homing has not ended in time; look at the machine")
            session.pump_until(lambda: session.fault is not None, POLL_S)
        session.check()
        if session.command(protocol.query("home"), "home")["home"] != 1:
            raise DeviceFaultError(f"{session.name}: homing ended, and the board says that it is not homed; home again")
        self._forget_queue()
        session.query()

    def _wait_for_standstill(self, timeout_s: float) -> protocol.Report:
        session = self._session
        started_s = self._clock.now_s()
        while True:
            report = session.query()
            session.check()
            waited_s = self._clock.now_s() - started_s
            if report.stat == protocol.HOLDING and report.speed_mm_per_min == 0:
                return report
            # The first report after a hold may still be from before it.
            if waited_s > _SETTLE_S and self._status().state in (MotionState.IDLE, MotionState.ALARM):
                return report
            if waited_s >= timeout_s:
                raise DeviceTimeoutError(
                    f"{session.name}: no standstill within {timeout_s:g} s of a hold, state {report.stat}; nothing was "
                    "dropped and the hold stands; halt() stops at once"
                )
            session.pump(0.01)

    def _wait_for_dropped_queue(self) -> None:
        session = self._session
        deadline_s = self._clock.now_s() + 1.0
        while session.query().stat == protocol.HOLDING:
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(f"{session.name}: the queue was not dropped within 1 s; halt() ends it")
            session.urgent(protocol.FLUSH)
            session.pump(0.02)

    def _wait_for_room(self) -> None:
        session = self._session
        limit = min(MAX_BLOCKS, self._planner_blocks - 1)
        while not self._held and len(self._queue) >= limit:
            report = session.query()
            session.check()
            if report.stat == protocol.HOLDING:
                raise DeviceFaultError(
                    f"{session.name}: the queue is full and a hold stands; resume() or flush() first"
                )
            if len(self._queue) >= limit:
                session.pump(0.02)
        if self._held:
            raise DeviceFaultError(f"{session.name}: a hold stands; resume() or flush() first; nothing was sent")

    def _take_report(self, report: protocol.Report) -> None:
        if self._held and report.stat == protocol.RUN:
            # The board ignores a hold in the moment before the axes move, and in a hold another one.
            self._session.urgent(protocol.HOLD)
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
        alarm = "in an alarm; home() releases" if report.stat in (protocol.ALARM, protocol.SHUTDOWN) else None
        return MotionStatus(
            state=MotionState.ALARM if fault else self._motion_state(report),
            position_mm=self._limits.robot_mm(report.machine_mm),
            queued_s=self._queue.duration_s(report.machine_mm, standing=self._stands(report)),
            time_s=self._session.report_time_s,
            alarm=fault.words if fault else alarm,
        )

    def _stands(self, report: protocol.Report) -> bool:
        """At rest with nothing planned; a block that is planned starts a moment later."""
        return report.stat in AT_REST and report.blocks_free >= self._planner_blocks

    def _motion_state(self, report: protocol.Report) -> MotionState:
        if report.stat == protocol.HOLDING:
            return MotionState.HELD if report.speed_mm_per_min == 0 else MotionState.HOLDING
        if report.stat in _STATES:
            return _STATES[report.stat]
        if report.stat in AT_REST:
            stands = self._stands(report) and not self._session.has_unanswered
            return MotionState.IDLE if stands else MotionState.MOVING
        return MotionState.MOVING if report.stat in MOVING else MotionState.OTHER


def _shown(point_mm: Vector) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in point_mm) + ")"
