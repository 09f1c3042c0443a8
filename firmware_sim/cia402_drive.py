"""The spindle's drive: a CiA 402 servo in profile velocity mode on CANopen.

Speeds are in rpm and ramps in rpm/s, torque in per mille of the rated torque, as small spindle drives have them. Left
out: every other mode of operation, polarity and gearing, storing of parameters, and drives that process no controlword
before the network is operational (this one takes it by SDO in pre-operational as well).
"""

from enum import Enum

from firmware_sim.canopen_dictionary import I8, I16, I32, U16, U32, Entry, Key
from firmware_sim.canopen_slave import CYCLE_S, GENERIC_ERROR, CanopenSlave
from firmware_sim.mechanics import SpindleLoad
from firmware_sim.velocity_servo import VelocityServo

DEVICE_TYPE = 0x0002_0192
"""Profile 402, servo drive."""
PROFILE_VELOCITY = 3

BLOCKED_S = 0.1
OVERLOAD_S = 0.25
_BLOCKED_SHARE = 0.05
"""Below this share of the demanded speed the shaft counts as blocked."""

MOTOR_BLOCKED = 0x7121
CONTINUOUS_OVER_CURRENT = 0x2310
HEARTBEAT_LOST = 0x8130
_ERROR_BITS = {MOTOR_BLOCKED: 0x20, CONTINUOUS_OVER_CURRENT: 0x02, HEARTBEAT_LOST: 0x10}

OWN_SPEED_RPM = 5_000
"""Of a drive that turns without being told."""

_TARGET_REACHED, _INTERNAL_LIMIT, _SPEED_ZERO = 1 << 10, 1 << 11, 1 << 12
_VOLTAGE_ENABLED, _REMOTE = 1 << 4, 1 << 9
_HALT = 1 << 8


class State(Enum):
    """States of the power drive system with the bits 0-3, 5 and 6 of their statusword."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


_POWERED = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)


class Cia402Drive(CanopenSlave):
    """Turns the load; a frame at a time from the bus, a cycle of 2 ms at a time from the clock."""

    def __init__(
        self, load: SpindleLoad, *, node_id: int = 1, max_speed_rpm: int = 60_000, serial_number: int = 402_001
    ) -> None:
        super().__init__(
            node_id=node_id,
            device_type=DEVICE_TYPE,
            name="Emulated spindle drive",
            hardware="virtual bench",
            software="1.0",
            serial=serial_number,
        )
        self._load = load
        self._servo = VelocityServo()
        self._state = State.NOT_READY
        self._leave_for: State | None = None
        """Where a ramp down ends, while one runs that ends operation."""
        self._blocked_s = 0.0
        self._overload_s = 0.0
        self._reached_s = 0.0
        self._controlword = 0
        self.speed_factor = 1.0
        """What the shaft does of what it is told; a healthy drive does all."""
        self.runs_by_itself = False
        self._add_drive_objects(max_speed_rpm)
        # What every cycle asks for.
        entry = self.dictionary.entry
        self._mode, self._target_rpm = entry((0x6060, 0)), entry((0x60FF, 0))
        self._highest_rpm, self._motor_rpm = entry((0x607F, 0)), entry((0x6080, 0))
        self._up_rpm_per_s, self._down_rpm_per_s = entry((0x6083, 0)), entry((0x6084, 0))
        self._max_torque, self._standing_rpm = entry((0x6072, 0)), entry((0x606F, 0))
        self._window_rpm, self._window_ms = entry((0x606D, 0)), entry((0x606E, 0))
        self._told_demand, self._told_speed = entry((0x606B, 0)), entry((0x606C, 0))
        self._told_torque, self._told_status = entry((0x6077, 0)), entry((0x6041, 0))
        self._publish()

    @property
    def state(self) -> State:
        """The state of the power drive system."""
        return self._state

    @property
    def speed_rpm(self) -> float:
        """The true speed of the shaft."""
        return self._servo.speed_rpm

    def fail(self, code: int) -> None:
        """An error of the drive's own: it says so and stops."""
        self._fail(code)

    # --- hooks of the node

    def on_boot(self) -> None:
        """Power-up is over: transition 1."""
        self._go(State.SWITCH_ON_DISABLED)

    def on_reset(self) -> None:
        """Current off; the shaft coasts."""
        self._controlword = 0
        self._go(State.NOT_READY)

    def on_connection_lost(self) -> None:
        """React by the abort connection option code, 6007."""
        match self.dictionary[0x6007, 0]:
            case 1:
                self._fail(HEARTBEAT_LOST)
            case 2:
                self._command(0x0000)
            case 3:
                self._command(0x0002)

    def on_written(self, key: Key) -> None:
        """Controlwords count at once."""
        if key == (0x6040, 0):
            word = self.dictionary[key]
            rising = word & ~self._controlword
            self._controlword = word
            if rising & 0x80:
                self._reset_fault()
            elif not word & 0x80:
                self._command(word)
            self._publish()
        elif key == (0x6060, 0):
            self.dictionary[0x6061, 0] = self.dictionary[0x6060, 0]

    def run_cycle(self, time_s: float) -> None:
        """One step of ramp, controller, shaft and supervision."""
        servo = self._servo
        powered = self._state in _POWERED
        if powered:
            self._ramp()
        elif self.runs_by_itself:
            powered = True
            servo.ramp(OWN_SPEED_RPM, self._up_rpm_per_s.value, self._down_rpm_per_s.value, CYCLE_S)
        load = self._load.torque_fraction(time_s, servo.speed_rpm)
        servo.advance(load, self._max_torque.value / 1000, CYCLE_S, powered=powered)
        self._load.turn(time_s, servo.speed_rpm)
        within = abs(servo.speed_rpm - self._wanted_rpm) <= self._window_rpm.value
        self._reached_s = self._reached_s + CYCLE_S if within else 0.0
        self._supervise()
        self._finish_stops()
        self._publish()

    def raise_error(self, code: int, register_bits: int) -> None:
        """Every error is also the drive's last error code."""
        self.dictionary[0x603F, 0] = code
        super().raise_error(code, register_bits)

    # --- the state machine

    def _command(self, word: int) -> None:
        """The commands of the controlword (CiA 402-2, table 27) on the state machine's transitions."""
        state = self._state
        if state in (State.NOT_READY, State.FAULT_REACTION_ACTIVE, State.FAULT):
            return
        if not word & 0x02:
            self._go(State.SWITCH_ON_DISABLED)
        elif not word & 0x04:
            if state is State.OPERATION_ENABLED:
                self._go(State.QUICK_STOP_ACTIVE if self.dictionary[0x605A, 0] else State.SWITCH_ON_DISABLED)
            elif state is not State.QUICK_STOP_ACTIVE:
                self._go(State.SWITCH_ON_DISABLED)
        elif not word & 0x01:
            if state is State.OPERATION_ENABLED:
                self._leave(State.READY, 0x605B)
            elif state is not State.QUICK_STOP_ACTIVE:
                self._go(State.READY)
        elif not word & 0x08:
            if state is State.READY:
                self._go(State.SWITCHED_ON)
            elif state is State.OPERATION_ENABLED:
                self._leave(State.SWITCHED_ON, 0x605C)
        elif state is State.QUICK_STOP_ACTIVE:
            if self.dictionary[0x605A, 0] >= 5:
                self._go(State.OPERATION_ENABLED)
        elif state is not State.SWITCH_ON_DISABLED:
            self._go(State.OPERATION_ENABLED)

    def _go(self, state: State) -> None:
        if state is State.OPERATION_ENABLED and self._state is not state:
            self._servo.demand_rpm = self._servo.speed_rpm
            self._blocked_s = self._overload_s = 0.0
        self._state = state
        self._leave_for = None

    def _leave(self, state: State, option_index: int) -> None:
        """Operation ends: at once with the shaft coasting (option 0), or after the ramp down (option 1)."""
        if self.dictionary[option_index, 0] == 0:
            self._go(state)
        else:
            self._leave_for = state

    def _fail(self, code: int) -> None:
        if self._state in (State.NOT_READY, State.FAULT):
            return
        self.raise_error(code, _ERROR_BITS.get(code, GENERIC_ERROR))
        self._go(State.FAULT_REACTION_ACTIVE if self._state in _POWERED and self.dictionary[0x605E, 0] else State.FAULT)

    def _reset_fault(self) -> None:
        if self._state is State.FAULT:
            for code in self.errors:
                self.clear_error(code)
            self._go(State.SWITCH_ON_DISABLED)

    def _finish_stops(self) -> None:
        if abs(self._servo.speed_rpm) > self._standing_rpm.value:
            return
        if self._state is State.FAULT_REACTION_ACTIVE:
            # A blocked shaft is not pushed on until the ramp is over.
            self._go(State.FAULT)
        elif self._servo.demand_rpm:
            return
        elif self._state is State.QUICK_STOP_ACTIVE and self.dictionary[0x605A, 0] < 5:
            self._go(State.SWITCH_ON_DISABLED)
        elif self._leave_for is not None:
            self._go(self._leave_for)

    # --- speed

    @property
    def _limit_rpm(self) -> int:
        return min(self._highest_rpm.value, self._motor_rpm.value)

    @property
    def _wanted_rpm(self) -> int:
        """The target within the limits, or standstill."""
        if self._state is not State.OPERATION_ENABLED or self._leave_for is not None:
            return 0
        if self._controlword & _HALT or self._mode.value != PROFILE_VELOCITY:
            return 0
        limit_rpm = self._limit_rpm
        return max(-limit_rpm, min(limit_rpm, self._target_rpm.value))

    def _ramp(self) -> None:
        objects = self.dictionary
        quick = (
            (self._state is State.QUICK_STOP_ACTIVE and objects[0x605A, 0] in (2, 6))
            or (self._state is State.FAULT_REACTION_ACTIVE and objects[0x605E, 0] == 2)
            or (self._state is State.OPERATION_ENABLED and self._controlword & _HALT and objects[0x605D, 0] == 2)
        )
        deceleration = objects[0x6085, 0] if quick else self._down_rpm_per_s.value
        self._servo.ramp(self._wanted_rpm * self.speed_factor, self._up_rpm_per_s.value, deceleration, CYCLE_S)

    def _supervise(self) -> None:
        servo = self._servo
        if self._state not in _POWERED:
            return
        driving = servo.saturated and servo.torque * servo.demand_rpm > 0
        self._overload_s = self._overload_s + CYCLE_S if driving else 0.0
        blocked = driving and abs(servo.speed_rpm) < _BLOCKED_SHARE * abs(servo.demand_rpm)
        self._blocked_s = self._blocked_s + CYCLE_S if blocked else 0.0
        if self._blocked_s >= BLOCKED_S:
            self._fail(MOTOR_BLOCKED)
        elif self._overload_s >= OVERLOAD_S:
            self._fail(CONTINUOUS_OVER_CURRENT)

    # --- what the host sees

    def _publish(self) -> None:
        servo, state = self._servo, self._state
        self._told_demand.value = round(servo.demand_rpm)
        self._told_speed.value = round(servo.speed_rpm)
        self._told_torque.value = max(-32768, min(32767, round(1000 * servo.torque)))
        word = state.value | (0 if state is State.NOT_READY else _VOLTAGE_ENABLED | _REMOTE)
        if abs(servo.speed_rpm) <= self._standing_rpm.value:
            word |= _SPEED_ZERO
        if state is State.OPERATION_ENABLED and abs(self._target_rpm.value) > self._limit_rpm:
            word |= _INTERNAL_LIMIT
        # Within the window (606D) for longer than the window time (606E); with halt, at standstill.
        if state in _POWERED and self._reached_s * 1000 > self._window_ms.value:
            word |= _TARGET_REACHED
        self._told_status.value = word

    def _add_drive_objects(self, max_speed_rpm: int) -> None:
        add = self.dictionary.add
        add(0x6007, 0, Entry(I16, 1, True, allowed=(0, 1, 2, 3)))
        add(0x603F, 0, Entry(U16, mappable=True))
        add(0x6040, 0, Entry(U16, 0, True, mappable=True))
        add(0x6041, 0, Entry(U16, mappable=True))
        add(0x605A, 0, Entry(I16, 2, True, allowed=(0, 1, 2, 5, 6)))
        add(0x605B, 0, Entry(I16, 0, True, allowed=(0, 1)))
        add(0x605C, 0, Entry(I16, 1, True, allowed=(0, 1)))
        add(0x605D, 0, Entry(I16, 1, True, allowed=(1, 2)))
        add(0x605E, 0, Entry(I16, 2, True, allowed=(0, 1, 2)))
        add(0x6060, 0, Entry(I8, 0, True, allowed=(0, PROFILE_VELOCITY), mappable=True))
        add(0x6061, 0, Entry(I8, mappable=True))
        add(0x606B, 0, Entry(I32, mappable=True))
        add(0x606C, 0, Entry(I32, mappable=True))
        add(0x606D, 0, Entry(U16, max_speed_rpm // 100, True))
        add(0x606E, 0, Entry(U16, 20, True))
        add(0x606F, 0, Entry(U16, 60, True))
        add(0x6071, 0, Entry(I16, 0, True, mappable=True))
        add(0x6072, 0, Entry(U16, 1000, True, high=2000, mappable=True))
        add(0x6073, 0, Entry(U16, 1000, True, high=2000))
        add(0x6075, 0, Entry(U32, 2500))
        add(0x6076, 0, Entry(U32, 12))
        add(0x6077, 0, Entry(I16, mappable=True))
        add(0x607F, 0, Entry(U32, max_speed_rpm, True, low=1, mappable=True))
        add(0x6080, 0, Entry(U32, max_speed_rpm, True, low=1, high=max_speed_rpm))
        add(0x6083, 0, Entry(U32, 60_000, True, low=1, mappable=True))
        add(0x6084, 0, Entry(U32, 60_000, True, low=1, mappable=True))
        add(0x6085, 0, Entry(U32, 120_000, True, low=1, mappable=True))
        add(0x60FF, 0, Entry(I32, 0, True, mappable=True))
        add(0x6502, 0, Entry(U32, 1 << (PROFILE_VELOCITY - 1)))
        self.pdos.set_default(0x1400, 0, (0x6040, 0, 16))
        self.pdos.set_default(0x1400, 1, (0x6040, 0, 16), (0x6060, 0, 8))
        self.pdos.set_default(0x1400, 3, (0x6040, 0, 16), (0x60FF, 0, 32))
        self.pdos.set_default(0x1800, 0, (0x6041, 0, 16))
        self.pdos.set_default(0x1800, 1, (0x6041, 0, 16), (0x6061, 0, 8))
        self.pdos.set_default(0x1800, 3, (0x6041, 0, 16), (0x606C, 0, 32))
