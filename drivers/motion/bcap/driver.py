"""A DENSO robot as a motion controller: an RC8 over b-CAP (UDP), fed with set-points in slave mode.

Positions of {R} become positions of the robot's frame by ``origin_mm``; the orientation of the tool stays as the rig
file says. An arm with absolute encoders has no switches to find: ``home()`` clears errors, takes the arm, switches the
motor on and reads where it is. Its position is never lost.

The controller has no soft floor that could be written: travel and floor are kept by this driver alone, which refuses
targets outside. The way between two points of a box stays inside the box.

Danger: the controller executes three set-points of 8 ms and then wants more. They are sent from within
``start_move()``, ``status()`` and every wait of this driver, and by ``feed()``, which whoever owns the time must call
every few milliseconds while something is queued: a host that is late by more than the buffer stops the arm, and that
is a latched fault. It is also what stops the arm, within 24 ms, when the host dies; no other process need be able to.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from drivers.clock import Clock
from drivers.errors import (
    ConfigError,
    DeviceError,
    DeviceFaultError,
    DeviceTimeoutError,
    NotHomedError,
    OutOfTravelError,
)
from drivers.motion.bcap.feeder import BUFFERED, RETRY_S, Feeder
from drivers.motion.bcap.path import PERIOD_S
from drivers.motion.bcap.robot import VERSION, Pose, Robot
from drivers.motion.bcap.session import REPLY_S, BcapSession
from drivers.motion.interface import MotionController, MotionState, MotionStatus, Travel, Vector
from drivers.motion.transport import DatagramLine

ORIENTATION_DEG = 0.02
"""How far the tool may be turned from what the rig file says: the first set-point would turn it back at once."""
_STANDSTILL_S = 2.0
_WAIT_S = 0.002


class BcapController(MotionController):
    """One RC8. See ``MotionController`` for the promises; this adds only what is b-CAP's own."""

    def __init__(
        self,
        line: DatagramLine,
        clock: Clock,
        *,
        origin_mm: Vector,
        orientation_deg: Vector,
        travel: Travel,
        max_feed_mm_per_s: float,
        reply_s: float = REPLY_S,
    ) -> None:
        """Start the service and take handles; nothing moves, and the motor stays as it is.

        Args:
            line: an open line; closed again when the constructor raises.
            clock: monotonic seconds.
            origin_mm: where the origin of {R} is in the robot's frame.
            orientation_deg: RX, RY, RZ of the tool in every move.
            travel: the box that targets must stay in, in {R}.
            max_feed_mm_per_s: the highest feed that ``start_move`` takes.
            reply_s: how long a reply is waited for before asking again; three tries without one are an error.

        Raises:
            ConfigError: the travel is no box.
            ConnectionLostError: nobody listens there.
            DeviceTimeoutError: no b-CAP server answers.
            ProtocolError: something answers that does not speak b-CAP.
            DeviceFaultError: the controller refuses.
        """
        self._clock = clock
        self._origin_mm = origin_mm
        self._orientation_deg = orientation_deg
        self._full_travel = travel
        self._floor_mm: float | None = None
        self._max_feed_mm_per_s = max_feed_mm_per_s
        self._figure = -1.0
        self._homed = False
        self._closed = False
        self._session = BcapSession(line, clock, reply_s=reply_s)
        self._robot = Robot(self._session)
        self._feeder = Feeder(self._session, clock, self._robot, self._pose_of)
        try:
            if not all(low < high for low, high in zip(travel.low_mm, travel.high_mm, strict=True)):
                raise ConfigError(
                    f"{line.name}: travel {travel.low_mm} to {travel.high_mm} mm is no box; each low end must be below "
                    "its high end; correct [motion] travel_low_mm and travel_high_mm"
                )
            self._robot.connect()
            self._version = str(self._robot.read(VERSION))
        except BaseException:
            self._session.close()
            raise

    @property
    def identity(self) -> str:
        """The make and the version that the controller tells."""
        return f"DENSO b-CAP {self._version}"

    @property
    def travel(self) -> Travel:
        """The travel of the rig file, above the floor."""
        low, floor = self._full_travel.low_mm, self._floor_mm
        return self._full_travel if floor is None else Travel((low[0], low[1], floor), self._full_travel.high_mm)

    @property
    def dead_time_s(self) -> float:
        """Into slave mode, and the buffer of set-points."""
        return (BUFFERED + 1) * PERIOD_S

    def home(self) -> None:
        """Clear errors, take the arm, switch the motor on, read the position; nothing moves.

        Raises:
            DeviceFaultError: refused, or the tool is turned otherwise than the rig file says.
        """
        session, feeder = self._session, self._feeder
        halts = session.halts
        self._homed = False
        if session.is_lost:
            session.check()
        if session.fault is None and feeder.is_on:
            self._come_to_rest()
        if session.handles_lost:
            self._robot.connect()
        with suppress(DeviceFaultError):
            # Also where it should be off: the reply that said that it is on may be what was lost.
            feeder.leave_at_once()
        feeder.forget()
        session.release(halts)
        self._robot.take()
        pose = self._robot.pose()
        self._require_orientation(pose)
        self._figure = pose[6]
        feeder.path.restart(self._robot_to_r(pose))
        self._require_no_halt()
        self._homed = True

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        """Queue one straight move; it is cut into set-points as the controller wants them."""
        session, feeder = self._session, self._feeder
        feeder.feed()
        session.check()
        if not self._homed:
            raise NotHomedError(f"{session.name}: the position is not trusted; home() first")
        if not self.travel.contains(target_mm):
            raise OutOfTravelError(
                f"{session.name}: target {_shown(target_mm)} mm is outside the travel "
                f"{_shown(self.travel.low_mm)} to {_shown(self.travel.high_mm)} mm of {{R}}; nothing was sent"
            )
        if not 0 < feed_mm_per_s <= self._max_feed_mm_per_s:
            raise ConfigError(
                f"{session.name}: feed {feed_mm_per_s:g} mm/s; above 0 and at most {self._max_feed_mm_per_s:g} "
                "is allowed; nothing was sent"
            )
        if feeder.held:
            raise DeviceFaultError(f"{session.name}: a hold stands; resume() or flush() first; nothing was sent")
        self._go_on()
        feeder.path.add(target_mm, feed_mm_per_s)
        feeder.fill()
        feeder.feed()

    def status(self) -> MotionStatus:
        """A fresh report; at rest, the controller's own error code is looked at as well."""
        session, feeder = self._session, self._feeder
        feeder.feed()
        if session.is_lost:
            session.check()
        try:
            position_mm = self._position_mm()
        except DeviceFaultError:
            if session.fault is None:
                raise
            return self._status(feeder.path.position_mm)
        if not feeder.is_on and session.fault is None and (error := self._robot.error()) is not None:
            session.latch(f"the controller reports {error}")
        feeder.feed()
        return self._status(position_mm)

    def check(self) -> None:
        """Raise what has latched."""
        self._session.check()

    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        """Wait for the end of all queued motion, and of a hold if one stands."""
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            status = self.status()
            self._session.check()
            if status.state is MotionState.IDLE:
                return status
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._session.name}: still {status.state} after {timeout_s:g} s, about {status.queued_s:.1f} s "
                    "queued; hold() or flush() stops it"
                )
            self._wait(PERIOD_S)

    def hold(self) -> None:
        """Slow down on the path from the next set-point on; those in the buffer are executed first."""
        self._feeder.held = True

    def resume(self) -> None:
        """Go on after ``hold()``, also before standstill."""
        self._session.check()
        if self._feeder.held:
            self._feeder.held = False
            self._go_on()
            self._feeder.fill()

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        """Hold, wait for standstill, drop the rest of the path."""
        self._session.check()
        self.hold()
        deadline_s = self._clock.now_s() + timeout_s
        while self._feeder.is_on:
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._session.name}: no standstill within {timeout_s:g} s of a hold; nothing was dropped and "
                    "the hold stands; halt() stops at once"
                )
            self._wait(PERIOD_S)
            self._session.check()
        self._feeder.forget()
        return self.status()

    def halt(self) -> None:
        """ROBOT_HALT, which ends slave mode, three times in a row, as no reply is waited for."""
        self._session.halt(self._robot.handle)

    @property
    def is_fed(self) -> bool:
        """Whether set-points are due: something is queued, or the arm has not come to rest."""
        return self._feeder.is_on

    def feed(self) -> None:
        """Send the set-points that are due; returns at once. Every 5 ms at least while something is queued."""
        with self._latched():
            self._feeder.feed()

    def set_floor(self, z_mm: float | None) -> None:
        """Refuse targets below; kept by this driver, as the controller has nothing of the kind.

        Raises:
            OutOfTravelError: the floor is outside the travel or above the tip.
        """
        session = self._session
        session.check()
        if z_mm is None:
            self._floor_mm = None
            return
        if self._feeder.is_on:
            raise DeviceFaultError(f"{session.name}: a floor can only be set at standstill; wait_until_idle() first")
        low_mm, high_mm = self._full_travel.low_mm[2], self._full_travel.high_mm[2]
        if not low_mm <= z_mm < high_mm:
            raise OutOfTravelError(
                f"{session.name}: floor z = {z_mm:g} mm is outside the travel {low_mm:g} to {high_mm:g} mm; "
                "nothing was changed"
            )
        tip_mm = self._position_mm()[2]
        if self._homed and tip_mm < z_mm:
            raise OutOfTravelError(
                f"{session.name}: floor z = {z_mm:g} mm is above the tip at {tip_mm:g} mm; lift first; "
                "nothing was changed"
            )
        self._floor_mm = z_mm

    def close(self) -> None:
        """Bring the arm to rest, switch its motor off, give everything back."""
        if self._closed:
            return
        self._closed = True
        session = self._session
        try:
            if not session.is_lost and not session.handles_lost:
                if session.fault is None and self._feeder.is_on:
                    self._come_to_rest()
                self._robot.disconnect()
        finally:
            session.close()

    def _go_on(self) -> None:
        """Into slave mode, unless it is on."""
        feeder = self._feeder
        feeder.enter(self._position_mm() if not feeder.is_on else feeder.path.position_mm)
        self._require_no_halt()

    def _require_no_halt(self) -> None:
        if self._session.is_halted:
            # What was asked for since may have reached the controller behind the halt.
            self._session.halt(self._robot.handle)
        self._session.check()

    def _come_to_rest(self) -> None:
        try:
            self.flush(_STANDSTILL_S)
        except DeviceError as error:
            self._session.latch(f"did not come to rest when asked ({error})")
            self._session.halt(self._robot.handle)

    def _wait(self, duration_s: float) -> None:
        until_s = self._clock.now_s() + duration_s
        while self._clock.now_s() < until_s:
            self._feeder.feed()
            self._session.poll(_WAIT_S)

    @contextmanager
    def _latched(self) -> Iterator[None]:
        """What fails is latched, for whoever asks next."""
        try:
            yield
        except DeviceError as error:
            self._session.latch(str(error))

    def _require_orientation(self, pose: Pose) -> None:
        found = pose[3:6]
        off_deg = max(abs((a - b + 180.0) % 360.0 - 180.0) for a, b in zip(found, self._orientation_deg, strict=True))
        if not off_deg <= ORIENTATION_DEG:
            raise DeviceFaultError(
                f"{self._session.name}: the tool is turned to {_shown((found[0], found[1], found[2]))} deg where the "
                f"rig file says {_shown(self._orientation_deg)}, allowed are {ORIENTATION_DEG:g} deg more or less; "
                "turn it with the teach pendant, or correct [motion] orientation_deg"
            )

    def _position_mm(self) -> Vector:
        return self._robot_to_r(self._robot.pose(retry_s=RETRY_S if self._feeder.is_on else None))

    def _pose_of(self, point_mm: Vector) -> Pose:
        x, y, z = (value + origin for value, origin in zip(point_mm, self._origin_mm, strict=True))
        return (x, y, z, *self._orientation_deg, self._figure)

    def _robot_to_r(self, pose: Pose) -> Vector:
        x, y, z = (round(value - origin, 6) for value, origin in zip(pose[:3], self._origin_mm, strict=True))
        return (x, y, z)

    def _status(self, position_mm: Vector) -> MotionStatus:
        feeder, fault = self._feeder, self._session.fault
        if fault is not None:
            state = MotionState.ALARM
        elif feeder.held:
            state = MotionState.HOLDING if feeder.is_on else MotionState.HELD
        else:
            state = MotionState.MOVING if feeder.is_on else MotionState.IDLE
        buffered_s = BUFFERED * PERIOD_S if feeder.is_on else 0.0
        queued_s = 0.0 if fault is not None else feeder.path.duration_s + buffered_s
        return MotionStatus(state, position_mm, queued_s, self._clock.now_s(), fault)


def _shown(point: Vector) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"
