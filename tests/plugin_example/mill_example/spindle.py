"""The drill's driver: mill's promises (drivers/spindle/interface.py) kept on this make's wire."""

import contextlib
from collections.abc import Mapping
from typing import Any

from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.motion.serial_line import open_serial
from drivers.motion.transport import SerialLine
from drivers.spindle.interface import SILENT_AFTER, Spindle, SpindleStatus
from mill_example.table import Table, checked
from mill_example.wire import STOP, Wire

POLL_S = 0.005
AT_SPEED = 0.01
STANDING_RPM = 1.0


class DrillTable(Table):
    """[spindle] with backend = "example". ``speed_rpm`` is read by mill as well: the milling speed."""

    port: str
    speed_rpm: float = 30_000.0
    max_speed_rpm: float = 50_000.0


def open_spindle(table: Mapping[str, Any], clock: Clock) -> Spindle:
    """The entry point "spindle.example"."""
    keys = checked(DrillTable, "spindle", table)
    line = open_serial(keys.port, 115_200)
    try:
        return ExampleDrill(line, clock, max_speed_rpm=keys.max_speed_rpm)
    except BaseException:
        line.close()
        raise


class ExampleDrill(Spindle):
    """Open from construction; a constructor that raises leaves nothing open."""

    def __init__(self, line: SerialLine, clock: Clock, *, max_speed_rpm: float) -> None:
        self._wire = Wire(line, clock)
        self._clock = clock
        self._max_speed_rpm = max_speed_rpm
        self._commanded_rpm = 0.0
        self._closed = False
        self._identity = self._wire.ask("who", within_s=self.heartbeat_s)
        self.stop()

    @property
    def identity(self) -> str:
        return self._identity

    @property
    def heartbeat_s(self) -> float:
        return 0.25

    def start(self, speed_rpm: float) -> None:
        if not 0 < speed_rpm <= self._max_speed_rpm:
            raise ConfigError(f"{self._wire.name}: {speed_rpm:g} rpm; allowed: above 0, up to {self._max_speed_rpm:g}")
        if fault := self.status().fault:
            raise DeviceFaultError(f"{self._wire.name}: {fault}; stop(), then switch the drill off and on")
        self._commanded_rpm = speed_rpm
        self._wire.ask(f"spin {speed_rpm:.1f}", within_s=SILENT_AFTER * self.heartbeat_s)

    def stop(self) -> None:
        self._commanded_rpm = 0.0
        self._wire.urgent(STOP)

    def status(self) -> SpindleStatus:
        return self._report()[0]

    def wait_until_at_speed(self, timeout_s: float) -> SpindleStatus:
        deadline_s, commanded_rpm = self._clock.now_s() + timeout_s, self._commanded_rpm
        while True:
            status, target_rpm = self._report()
            if commanded_rpm and status.fault:
                raise DeviceFaultError(f"{self._wire.name}: {status.fault}; stop(), then switch the drill off and on")
            if commanded_rpm and abs(target_rpm - commanded_rpm) > STANDING_RPM:
                raise DeviceFaultError(f"{self._wire.name}: stop() came while it ran up; start() again")
            if abs(status.speed_rpm - commanded_rpm) <= max(STANDING_RPM, AT_SPEED * commanded_rpm):
                return status
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeoutError(
                    f"{self._wire.name}: {status.speed_rpm:g} of {commanded_rpm:g} rpm after {timeout_s:g} s; "
                    "look whether the drill is blocked"
                )
            self._clock.sleep_s(POLL_S)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            with contextlib.suppress(DeviceError):
                self.stop()
                self.wait_until_at_speed(5.0)
        finally:
            self._wire.close()

    def _report(self) -> tuple[SpindleStatus, float]:
        """The newest report, and the speed that the drill goes for."""
        answer = self._wire.ask("say", within_s=SILENT_AFTER * self.heartbeat_s)
        try:
            speed_rpm, target_rpm, torque, *fault = answer.split(" ")
            now_s = self._clock.now_s()
            return SpindleStatus(float(speed_rpm), float(torque), " ".join(fault) or None, now_s), float(target_rpm)
        except ValueError:
            raise ProtocolError(f"{self._wire.name}: {answer!r} is no report; check the cable") from None
