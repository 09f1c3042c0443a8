"""A drill on a frequency inverter of Delta's VFD family, over Modbus RTU: MS300, MH300, C2000, VFD-E, VFD-EL.

The inverter is asked, not listened to. Its own communication time-out (09-02, 09-03) stops the drill when the host
falls silent; every question is a sign of life, and nothing asks but the calls of the control loop. What it tells of
speed is the frequency that it puts out: 60 x Hz x 2 / poles, whatever the slip. What it tells of torque is its current.
"""

import contextlib
import math

from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.motion.transport import SerialLine
from drivers.spindle import delta_registers as delta
from drivers.spindle.interface import SILENT_AFTER, Spindle, SpindleStatus
from drivers.spindle.modbus_wire import ModbusWire, RefusedError, StoppedError

_OPENING_S = 0.5
_STANDSTILL_S = 5.0
_POLL_S = 0.01
_SPEED_TOLERANCE = 0.02


class ModbusSpindle(Spindle):
    """A drill on a VFD. The line is the spindle's own from here on, and closed with it.

    Opening stops a drill that is found turning, checks how the drive is set, and resets no fault. Written are the
    treatment and the time of the communication time-out; the time only while the drill is to turn, so that a standing
    drill may be forgotten.
    """

    def __init__(
        self,
        line: SerialLine,
        clock: Clock,
        *,
        max_speed_rpm: float,
        rated_current_a: float,
        station: int = 1,
        baud: int = 38_400,
        poles: int = 2,
        frequency_unit_hz: float = 0.01,
        heartbeat_s: float = 0.3,
    ) -> None:
        """Find the drive, stop it, and make sure that it is set for this.

        Args:
            line: an open line; closed again when the constructor raises.
            clock: monotonic seconds.
            max_speed_rpm: refused above this, whatever the drive allows.
            rated_current_a: of the motor; what torque is told as a share of.
            station: the drive's address, parameter 09-00.
            baud: of the line, for the silence between frames.
            poles: of the motor, not pairs of poles.
            frequency_unit_hz: 0.01; high-speed models that go beyond 599 Hz count in 0.1.
            heartbeat_s: the drive's time-out, a multiple of 0.1 s.

        Raises:
            DeviceTimeoutError: no drive answers.
            ProtocolError: something answers that does not speak Modbus RTU.
            DeviceFaultError: the drive does not take its settings.
            ConfigError: a parameter of the drive is not as mill needs it.
        """
        ticks = round(heartbeat_s / delta.SILENCE_UNIT_S)
        if not (1 <= ticks <= 1000 and math.isclose(ticks * delta.SILENCE_UNIT_S, heartbeat_s)):
            raise ValueError(f"heartbeat_s is {heartbeat_s}: allowed are multiples of 0.1 s from 0.1 to 100 s")
        for name, value in (("max_speed_rpm", max_speed_rpm), ("rated_current_a", rated_current_a)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: allowed are finite values above 0")
        if poles < 2 or poles % 2:
            raise ValueError(f"poles is {poles}: allowed are even numbers from 2 on")
        self._clock = clock
        self._wire = ModbusWire(line, clock, station=station, baud=baud)
        self._heartbeat_s = heartbeat_s
        self._heartbeat_ticks = ticks
        self._rated_current_a = rated_current_a
        self._rpm_per_unit = 60.0 * frequency_unit_hz * 2.0 / poles
        self._commanded = 0
        """The frequency that was told, in the drive's units."""
        self._ran = False
        """Whether the drive was seen running since ``start()``."""
        self._broken: str | None = None
        self._run_bits = delta.STANDING
        self._closed = False
        try:
            self._wire.stop()
            self._identity = self._wire.who(_OPENING_S)
            self._max_speed_rpm = min(max_speed_rpm, self._greatest_rpm())
            self._current_unit_a = 10.0 ** -self._current_digits()
            self._check_set_up()
            self._write_checked(delta.SILENCE_TREATMENT, delta.FAULT_AND_RAMP_TO_STOP)
            self.wait_until_at_speed(_STANDSTILL_S)
        except BaseException:
            self._wire.close()
            raise

    @property
    def identity(self) -> str:
        """What the drive tells of itself, which is no serial number."""
        return self._identity

    @property
    def heartbeat_s(self) -> float:
        """The longest silence of the host that leaves the drill turning."""
        return self._heartbeat_s

    @property
    def answers(self) -> tuple[int, int]:
        """Questions asked and answered."""
        return self._wire.asked, self._wire.answered

    def past_faults(self) -> list[str]:
        """Parameters 06-17 to 06-22; empty for a drive that keeps them elsewhere."""
        codes = [self._read_if_present(address) for address in delta.PAST_FAULTS]
        return [delta.fault_words(code) for code in codes if code]

    def start(self, speed_rpm: float) -> None:
        """Let the drive watch the host, and the drill run up; a turning drill changes its speed.

        Raises:
            ConfigError: (also ValueError) a speed outside the limits; nothing was sent.
            DeviceFaultError: the drive is in fault or refuses, or ``stop()`` came meanwhile.
        """
        wanted = round(speed_rpm / self._rpm_per_unit) if math.isfinite(speed_rpm) else 0
        if wanted < 1 or speed_rpm > self._max_speed_rpm:
            raise ConfigError(
                f"{self._wire.name}: speed {speed_rpm:g} rpm is outside the limits, allowed {self._rpm_per_unit:g} to "
                f"{self._max_speed_rpm:g} rpm; nothing was sent"
            )
        seen_stops = self._wire.stops
        status = self.status()
        if status.fault is not None:
            raise DeviceFaultError(f"{self._wire.name}: {status.fault}; remove the cause, then reset the fault")
        self._watch_host(self._heartbeat_ticks)
        self._write(delta.FREQUENCY_COMMAND, wanted, seen_stops)
        try:
            self._write(delta.COMMAND, delta.RUN_FORWARD, seen_stops)
        except DeviceError:
            # It may run all the same: only the answer may have been lost.
            self.stop()
            raise
        self._ran = False
        self._commanded = wanted
        if self._wire.stops != seen_stops:
            self.stop()
            raise self._stopped_meanwhile()

    def stop(self) -> None:
        """Stop by the drive's ramp; written at once, and confirmed or repeated by whoever speaks to the drive next.

        Raises:
            ConnectionLostError: the frame did not get out; the drive stops when the host stays silent.
        """
        self._commanded = 0
        self._wire.stop()

    def status(self) -> SpindleStatus:
        """The drive's answer to a question asked now, which is a sign of life to it."""
        try:
            report = self._wire.read(delta.REPORT, delta.REPORT_LENGTH, SILENT_AFTER * self._heartbeat_s)
        except (DeviceTimeoutError, ProtocolError) as error:
            self._broken = self._broken or str(error)
            raise
        fault, word, _, frequency, current = report
        self._run_bits = word & delta.RUN_BITS
        self._ran = self._ran or self._run_bits == delta.RUNNING
        if self._commanded == 0 and self._run_bits == delta.RUNNING:
            self._wire.stop()  # somebody else has started it
        backward = word & delta.BACKWARD == delta.BACKWARD
        return SpindleStatus(
            speed_rpm=(-1.0 if backward else 1.0) * frequency * self._rpm_per_unit,
            torque_fraction=current * self._current_unit_a / self._rated_current_a,
            fault=self._fault(fault & 0xFF),
            time_s=self._clock.now_s(),
        )

    def wait_until_at_speed(self, timeout_s: float) -> SpindleStatus:
        """Wait for the commanded speed. After ``stop()`` wait for standstill, through a fault as well.

        Raises:
            DeviceTimeoutError: not at speed in time.
            DeviceFaultError: a fault, or ``stop()`` from another thread, while running up.
        """
        commanded, seen_stops = self._commanded, self._wire.stops
        commanded_rpm = commanded * self._rpm_per_unit
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            status = self.status()
            if commanded == 0:
                if status.speed_rpm == 0 and self._run_bits == delta.STANDING:
                    self._watch_host(0)
                    return status
            elif self._wire.stops != seen_stops:
                raise self._stopped_meanwhile()
            elif status.fault is not None:
                raise DeviceFaultError(f"{self._wire.name}: {status.fault}")
            elif abs(status.speed_rpm - commanded_rpm) <= _SPEED_TOLERANCE * commanded_rpm:
                return status
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._wire.name}: {status.speed_rpm:g} rpm after {timeout_s:g} s, commanded {commanded_rpm:g} "
                    "rpm; check the ramps of the drive (parameters 01-12 and 01-13) and its current limit"
                )
            self._clock.sleep_s(_POLL_S)

    def reset_fault(self) -> None:
        """Acknowledge the drive's fault, and bad answers; the drill stays off until ``start()``.

        Raises:
            DeviceFaultError: the cause is still there.
        """
        self._commanded = 0
        self._wire.stop()
        # A drive that heard nothing for its time-out would fail again at once.
        self._watch_host(0)
        self._write(delta.CONTROL, delta.RESET_FAULT)
        self._broken = None
        fault = self.status().fault
        if fault is not None:
            raise DeviceFaultError(f"{self._wire.name}: {fault}; remove the cause, then reset the fault")

    def close(self) -> None:
        """Stop, wait for standstill, give the line back.

        Raises:
            DeviceError: standstill could not be confirmed; the line is closed all the same.
        """
        if self._closed:
            return
        self._closed = True
        lost_before = self._wire.lost
        try:
            self.stop()
            self.wait_until_at_speed(_STANDSTILL_S)
        except DeviceError:
            if not lost_before:
                raise
        finally:
            self._wire.close()

    def _greatest_rpm(self) -> float:
        return self._read(delta.GREATEST_FREQUENCY) * self._rpm_per_unit

    def _current_digits(self) -> int:
        digits = self._read_if_present(delta.CURRENT_DIGITS)
        return 1 if digits is None else digits >> 8

    def _check_set_up(self) -> None:
        word = self._wire.read(delta.REPORT, delta.REPORT_LENGTH, _OPENING_S)[1]
        name = self._wire.name
        for bit, words, parameter in (
            (delta.FREQUENCY_BY_WIRE, "takes its frequency", "00-20 to 1"),
            (delta.COMMAND_BY_WIRE, "takes its commands", "00-21 to 2"),
        ):
            if not word & bit:
                raise ConfigError(f"{name}: the drive {words} not from this wire; set parameter {parameter}")
        if (found := self._read(delta.STOP_METHOD)) != delta.RAMP_TO_STOP:
            raise ConfigError(
                f"{name}: parameter 00-22 (stop method) is {found}, allowed is 0, a ramp: a drill that coasts is told "
                "as standing; set it to 0, and 01-13 to the time of the ramp"
            )

    def _watch_host(self, ticks: int) -> None:
        self._write_checked(delta.SILENCE_TIME, ticks)

    def _write_checked(self, address: int, value: int) -> None:
        # Parameters wear: what is there already is not written again.
        if self._read(address) == value:
            return
        self._write(address, value)
        if (found := self._read(address)) != value:
            group, number = divmod(address, 0x100)
            raise DeviceFaultError(
                f"{self._wire.name}: parameter {group:02d}-{number:02d} was written as {value} and reads back as "
                f"{found}; is the drive's parameter lock on?"
            )

    def _read(self, address: int) -> int:
        return self._wire.read(address, 1, _OPENING_S)[0]

    def _read_if_present(self, address: int) -> int | None:
        with contextlib.suppress(RefusedError):
            return self._read(address)
        return None

    def _write(self, address: int, value: int, seen_stops: int | None = None) -> None:
        self._wire.write(address, value, SILENT_AFTER * self._heartbeat_s, seen_stops=seen_stops)

    def _fault(self, code: int) -> str | None:
        texts = [f"drive fault {delta.fault_words(code)}"] if code else []
        if self._broken is not None:
            texts.append(self._broken)
        if self._commanded and self._ran and self._run_bits != delta.RUNNING and not texts:
            texts.append("the drive stopped by itself")
        return "; ".join(texts) or None

    def _stopped_meanwhile(self) -> StoppedError:
        return StoppedError(f"{self._wire.name}: stop() came while the drill was to run up")
