"""A drill on the spindle output of a GRBL controller: ``M3 S``, on the motion's own port and session (GRBL 1.1 manual).

The controller tells what it asks of the drill, not what the drill does: there is no torque, a blocked drill is not
noticed, and after a change of speed mill waits as long as the rig file says. Nothing at the other end watches the host:
``heartbeat_s`` is infinite.

Danger: a reset stops the drill, and so does ``flush()``. A stop holds the motion, and going on would start the drill
again; so the controller refuses ``resume()``, and what is queued can only be dropped.
"""

import math
from collections.abc import Callable

from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceError, DeviceFaultError, DeviceTimeoutError
from drivers.motion.grbl import protocol
from drivers.motion.grbl.driver import GrblController
from drivers.spindle.interface import Spindle, SpindleStatus

_POLL_S = 0.02
_HOLD_S = 0.3
"""A hold stands by then, and with it the drill's output is off; what does not come to that is reset."""
_SPEED_TOLERANCE = 0.02
_STANDSTILL_S = 5.0
_GREATEST, _LEAST, _LASER = "$30", "$31", "$32"


class GrblSpindle(Spindle):
    """A drill that shares the controller of the motion, which stays open when the drill is closed."""

    def __init__(
        self,
        controller: GrblController,
        clock: Clock,
        *,
        max_speed_rpm: float,
        run_up_s: float = 2.0,
        on_close: Callable[[], None] = lambda: None,
    ) -> None:
        """Check how the controller is set for a drill.

        Args:
            controller: open; its reset at opening has stopped the drill.
            clock: monotonic seconds.
            max_speed_rpm: refused above this, whatever ``$30`` allows.
            run_up_s: how long the drill takes to any speed, and to standstill.
            on_close: called once the drill is closed.

        Raises:
            ConfigError: laser mode is on, or the range of speeds is empty.
        """
        if not (math.isfinite(max_speed_rpm) and max_speed_rpm > 0):
            raise ValueError(f"max_speed_rpm is {max_speed_rpm}: allowed are finite speeds above 0")
        self._controller = controller
        self._session = controller.session
        self._clock = clock
        self._run_up_s = run_up_s
        self._on_close = on_close
        self._commanded_rpm = 0.0
        self._changed_s = -math.inf
        self._stops = 0
        self._override = [protocol.SPINDLE_STOP]
        """Holds the one stop override that a hold may be given; taking it out is atomic."""
        self._closed = False
        settings, name = controller.settings, self._session.name
        if settings.get(_LASER, 0.0):
            raise ConfigError(f"{name}: setting $32 (laser mode) is on, a drill needs it off; write $32=0 into it")
        self._low_rpm = max(1.0, settings.get(_LEAST, 0.0))
        self._high_rpm = min(max_speed_rpm, settings.get(_GREATEST, 0.0))
        if self._low_rpm > self._high_rpm:
            raise ConfigError(
                f"{name}: settings $31 and $30 (least and greatest speed) are {settings.get(_LEAST, 0.0):g} and "
                f"{settings.get(_GREATEST, 0.0):g} rpm, which leaves no speed up to {max_speed_rpm:g} rpm; write the "
                "drill's range into them"
            )
        controller.stop_drill = self.stop

    @property
    def identity(self) -> str:
        """The controller's; the drill has none of its own."""
        return f"{self._controller.identity}, spindle output without torque"

    @property
    def heartbeat_s(self) -> float:
        """Infinite: GRBL watches no host."""
        return math.inf

    @property
    def feels_load(self) -> bool:
        """No."""
        return False

    def start(self, speed_rpm: float) -> None:
        """Have the controller turn the drill; a turning drill changes its speed. The axes must stand.

        Raises:
            ConfigError: (also ValueError) a speed outside the limits; nothing was sent.
            DeviceFaultError: the controller moves, is in fault or refuses, or ``stop()`` came meanwhile.
        """
        name = self._session.name
        if not self._low_rpm <= speed_rpm <= self._high_rpm:
            raise ConfigError(
                f"{name}: speed {speed_rpm:g} rpm is outside the limits, allowed {self._low_rpm:g} to "
                f"{self._high_rpm:g} rpm; nothing was sent"
            )
        seen_stops = self._stops
        self._session.pump(0.0)
        self._session.check()
        if self._session.drill_stopped:
            self._controller.flush()
        state = self._session.query().state
        if state == "Alarm":
            # Locked since power-up. The drill needs no position, and the axes stay refused until they are homed.
            self._session.command("$X")
        elif state != "Idle":
            raise DeviceFaultError(f"{name}: state {state}; the drill is started at standstill only, nothing was sent")
        self._override = [protocol.SPINDLE_STOP]
        if self._stops == seen_stops:
            self._commanded_rpm, self._changed_s = speed_rpm, self._clock.now_s()
            try:
                self._session.command(f"M3S{speed_rpm:.0f}")
            except DeviceError:
                self.stop()
                raise
        if self._stops != seen_stops:
            self.stop()
            raise self._stopped_meanwhile()

    def stop(self) -> None:
        """Hold and spindle stop override, by real-time bytes: the drill is off when the axes stand.

        The override is a toggle, so that one hold gets one of it.

        Raises:
            ConnectionLostError: the bytes did not get out.
        """
        self._stops += 1
        self._commanded_rpm, self._changed_s = 0.0, self._clock.now_s()
        self._session.drill_stopped = True
        self._controller.hold()
        try:
            override = self._override.pop()
        except IndexError:
            return
        self._session.urgent(override)

    def status(self) -> SpindleStatus:
        """What the controller asks of the drill; the torque is NaN.

        Raises:
            DeviceTimeoutError: three status queries without a reply.
            ConnectionLostError: the wire is gone.
        """
        session = self._session
        if session.is_lost:
            session.check()
        report = session.query() if session.fault is None else session.try_query()
        # An alarm or a reset has switched the output off, and 1.1h answers nothing before it is reset.
        speed_rpm = 0.0 if report is None else report.spindle_rpm
        if speed_rpm is None:
            speed_rpm = self._commanded_rpm
        fault = None
        if session.fault is not None:
            fault = f"{session.fault.words}, which stops the drill"
        elif self._commanded_rpm and speed_rpm == 0:
            fault = "the drill was switched off by the controller; was it reset, by flush() or a button?"
        return SpindleStatus(speed_rpm, math.nan, fault, self._clock.now_s())

    def wait_until_at_speed(self, timeout_s: float) -> SpindleStatus:
        """Wait until the controller asks for the speed, and for the drill to follow.

        After ``stop()`` the hold is ended by dropping the queue; a controller that does not stop is reset.

        Raises:
            DeviceTimeoutError: not in time.
            DeviceFaultError: a fault, or ``stop()`` from another thread, while running up.
        """
        commanded_rpm, seen_stops = self._commanded_rpm, self._stops
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            status = self.status()
            if commanded_rpm == 0:
                self._insist(status)
            elif self._stops != seen_stops:
                raise self._stopped_meanwhile()
            elif status.fault is not None:
                raise DeviceFaultError(f"{self._session.name}: {status.fault}")
            followed = self._clock.now_s() - self._changed_s >= self._run_up_s
            if followed and abs(status.speed_rpm - commanded_rpm) <= _SPEED_TOLERANCE * commanded_rpm:
                if commanded_rpm == 0 and self._session.drill_stopped and self._session.fault is None:
                    self._controller.flush()
                return status
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._session.name}: not at {commanded_rpm:g} rpm after {timeout_s:g} s, the controller asks "
                    f"for {status.speed_rpm:g} rpm; the drill is given {self._run_up_s:g} s to follow"
                )
            self._clock.sleep_s(_POLL_S)

    def reset_fault(self) -> None:
        """Nothing: a fault is the controller's, and ``home()`` releases it.

        Raises:
            DeviceFaultError: one is latched.
        """
        self._session.check()

    def close(self) -> None:
        """Stop and wait for standstill; the controller stays open.

        Raises:
            DeviceError: standstill could not be confirmed.
        """
        if self._closed:
            return
        self._closed = True
        try:
            # A controller that was closed has stopped the drill.
            if not self._session.is_lost:
                self.stop()
                self.wait_until_at_speed(_STANDSTILL_S)
        finally:
            self._controller.stop_drill = None
            self._on_close()

    def _insist(self, status: SpindleStatus) -> None:
        """Reset a controller that was told to stop the drill, and has not; at standstill, if it comes to that."""
        if status.speed_rpm and self._session.fault is None and self._clock.now_s() - self._changed_s > _HOLD_S:
            try:
                self._controller.flush(_HOLD_S)
            except DeviceTimeoutError:
                self._session.reset()
            self._changed_s = self._clock.now_s()

    def _stopped_meanwhile(self) -> DeviceFaultError:
        return DeviceFaultError(f"{self._session.name}: stop() came while the drill was to run up")
