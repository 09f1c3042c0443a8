"""The spindle's drive: a Delta MS300 inverter of the high-speed kind on Modbus RTU, with a permanent magnet motor.

Read from the MS300 user manual: groups 00, 01, 06, 09 and appendix A. A register holds what the keypad shows without
its point: frequency in 0.1 Hz on a high-speed model, current in 0.01 A (211Fh says so), ramps in 0.01 s, the time-out
in 0.1 s.

Left out: V/f curves and slip (the shaft follows the frequency as a servo would), the motor's no-load current (current
is torque), stall prevention, the keypad and its lock, JOG and reverse, parameters that only hold outputs and inputs.
"""

from firmware_sim.mechanics import SpindleLoad
from firmware_sim.modbus_port import FAILURE, ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusError, ModbusPort
from firmware_sim.velocity_servo import VelocityServo

CYCLE_S = 0.002
BAUD = 115_200
POLES = 2
FREQUENCY_UNIT_HZ = 0.1
RATED_CURRENT_A = 3.0
MOST_TORQUE = 1.5
OVERLOAD_S = 0.25
OWN_SPEED_RPM = 5_000
"""Of a drive that turns without being told."""

OVER_CURRENT_AT_SPEED, DRIVE_OVERLOAD, COMMUNICATION_TIME_OUT = 3, 21, 58
_BLOCKED_S = 0.1
_BLOCKED_SHARE = 0.05
_STANDING_RPM = 30.0

_PARAMETERS = {
    0x0000: (1234, 0, -1),
    0x0006: (206, 0, -1),
    0x0014: (1, 0, 8),
    0x0015: (2, 0, 5),
    0x0016: (0, 0, 1),
    0x0100: (10_000, 0, 15_000),
    0x010C: (50, 0, 60_000),
    0x010D: (50, 0, 60_000),
    0x0900: (1, 1, 254),
    0x0902: (3, 0, 3),
    0x0903: (0, 0, 1000),
}
"""Value, least and greatest one; a greatest one below the least is read only."""
_PAST = range(0x0611, 0x0617)


class ModbusDrive:
    """Turns the load; bytes from the line, a cycle of 2 ms at a time from the clock."""

    def __init__(self, load: SpindleLoad, *, station: int = 1, baud: int = BAUD) -> None:
        self._load = load
        self._port = ModbusPort(station, self.read_register, self.write_register, baud=baud)
        self._servo = VelocityServo()
        self._parameters = {address: value for address, (value, _, _) in _PARAMETERS.items()}
        self._parameters[0x0900] = station
        self._parameters |= dict.fromkeys(_PAST, 0)
        self._frequency = 0
        """As told by 2001h."""
        self._runs = False
        self._fault = 0
        self._warning = 0
        self._coasts = False
        self._cycles = 0
        self._overload_s = self._blocked_s = 0.0
        self.speed_factor = 1.0
        """What the shaft does of what it is told; a healthy drive does all."""
        self.runs_by_itself = False
        self.minds_silence = True
        """Whether 09-02 and 09-03 do what they say."""

    @property
    def speed_rpm(self) -> float:
        """The true speed of the shaft."""
        return self._servo.speed_rpm

    @property
    def drives(self) -> bool:
        """Whether a run command stands."""
        return self._runs

    def receive(self, data: bytes) -> None:
        """Bytes of the host."""
        self._port.receive(data)

    def transmit(self) -> bytes:
        """Bytes for the host since the last call."""
        return self._port.transmit()

    def advance_to(self, time_s: float) -> None:
        """Let line, drive and shaft go on."""
        while (cycle_s := (self._cycles + 1) * CYCLE_S) <= time_s:
            self._cycles += 1
            self._port.advance_to(cycle_s)
            self._run_cycle(cycle_s)
        self._port.advance_to(time_s)

    def fail(self, code: int) -> None:
        """An error of the drive's own: it says so and lets the shaft coast."""
        self._fail(code, coasts=True)

    # --- registers

    def read_register(self, address: int) -> int:
        """What function 03 gives.

        Raises:
            ModbusError: no such register, or one that is only written.
        """
        if address in self._parameters:
            return self._parameters[address]
        match address:
            case 0x2001 | 0x2102:
                return self._frequency
            case 0x2100:
                return self._warning << 8 | self._fault
            case 0x2101:
                return self._status()
            case 0x2103:
                return round(abs(self._servo.demand_rpm) / self._rpm_per_unit) if self._powered else 0
            case 0x2104:
                return round(100 * RATED_CURRENT_A * abs(self._servo.torque))
            case 0x211F:
                return 2 << 8
        raise ModbusError(ILLEGAL_ADDRESS)

    def write_register(self, address: int, value: int) -> None:
        """What function 06 does.

        Raises:
            ModbusError: no such register, a value that is not allowed, or not now.
        """
        if address in _PARAMETERS:
            _, least, greatest = _PARAMETERS[address]
            if not least <= value <= greatest:
                raise ModbusError(ILLEGAL_VALUE)
            self._parameters[address] = value
        elif address == 0x2000:
            self.command(value)
        elif address == 0x2001:
            if value > self._parameters[0x0100]:
                raise ModbusError(ILLEGAL_VALUE)
            self._frequency = value
        elif address == 0x2002:
            if value & 0b10:
                self._reset_fault()
        else:
            raise ModbusError(ILLEGAL_ADDRESS)

    def command(self, word: int) -> None:
        """2000h: bits 1 and 0 are 01 to stop, 10 to run, 11 to jog.

        Raises:
            ModbusError: a drive in fault does not run, and this one does not jog.
        """
        match word & 0b11:
            case 0b01:
                self._runs = False
            case 0b10:
                if self._fault:
                    raise ModbusError(FAILURE)
                if not self._runs:
                    self._servo.demand_rpm = self._servo.speed_rpm
                    self._overload_s = self._blocked_s = 0.0
                self._runs, self._coasts = True, False
            case 0b11:
                raise ModbusError(ILLEGAL_VALUE)

    @property
    def _rpm_per_unit(self) -> float:
        return 60.0 * FREQUENCY_UNIT_HZ * 2.0 / POLES

    @property
    def _slowing(self) -> bool:
        return not self._runs and not self._coasts and abs(self._servo.speed_rpm) > _STANDING_RPM

    @property
    def _powered(self) -> bool:
        return self._runs or self._slowing or self.runs_by_itself

    def _status(self) -> int:
        bits = 0b11 if self._runs else 0b01 if self._slowing else 0b00
        by_wire = (self._parameters[0x0014] == 1) << 8 | (self._parameters[0x0015] == 2) << 10
        return bits | by_wire

    # --- the shaft

    def _run_cycle(self, time_s: float) -> None:
        servo = self._servo
        self._watch_host(time_s)
        wanted_rpm = self._frequency * self._rpm_per_unit * self.speed_factor if self._runs else 0.0
        if self.runs_by_itself and not self._runs:
            wanted_rpm = OWN_SPEED_RPM
        powered = self._powered
        if powered:
            top_rpm = self._parameters[0x0100] * self._rpm_per_unit
            up, down = (top_rpm / max(0.01, self._parameters[address] / 100) for address in (0x010C, 0x010D))
            servo.ramp(wanted_rpm, up, down, CYCLE_S)
        load = self._load.torque_fraction(time_s, servo.speed_rpm)
        servo.advance(load, MOST_TORQUE, CYCLE_S, powered=powered)
        self._load.turn(time_s, servo.speed_rpm)
        self._supervise(powered)

    def _supervise(self, powered: bool) -> None:
        servo = self._servo
        driving = powered and servo.saturated and servo.torque * servo.demand_rpm > 0
        self._overload_s = self._overload_s + CYCLE_S if driving else 0.0
        blocked = driving and abs(servo.speed_rpm) < _BLOCKED_SHARE * abs(servo.demand_rpm)
        self._blocked_s = self._blocked_s + CYCLE_S if blocked else 0.0
        if self._blocked_s >= _BLOCKED_S:
            self._fail(OVER_CURRENT_AT_SPEED, coasts=True)
        elif self._overload_s >= OVERLOAD_S:
            self._fail(DRIVE_OVERLOAD, coasts=True)

    def _watch_host(self, time_s: float) -> None:
        limit_s = self._parameters[0x0903] / 10
        spoken_s = self._port.spoken_to_s
        if not limit_s or spoken_s is None or time_s - spoken_s <= limit_s or not self.minds_silence:
            return
        match self._parameters[0x0902]:
            case 0:
                self._warning = COMMUNICATION_TIME_OUT
            case 1:
                self._fail(COMMUNICATION_TIME_OUT, coasts=False)
            case 2:
                self._fail(COMMUNICATION_TIME_OUT, coasts=True)

    def _fail(self, code: int, *, coasts: bool) -> None:
        if self._fault:
            return
        self._fault = code & 0xFF
        self._runs, self._coasts = False, coasts
        history = [self._parameters[address] for address in _PAST]
        self._parameters |= dict(zip(_PAST, [self._fault, *history], strict=False))

    def _reset_fault(self) -> None:
        self._fault = self._warning = 0
