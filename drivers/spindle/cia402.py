"""A CiA 402 drive in profile velocity mode: maxon EPOS4, Nanotec, Faulhaber, Technosoft and their like.

The drive is asked, not listened to: ``status()`` sends SYNC and the drive answers with its TPDO, so that a report is
never older than the call, and a host that looks away for a minute finds no minute of old frames in its buffers. The
drive stops the drill by itself when the host's heartbeat stays away (1016h, 6007h); that heartbeat is sent from within
``start()``, ``status()`` and ``wait_until_at_speed()``, from no timer, and only from ``start()`` to standstill.
"""

import math

import can

from drivers.clock import Clock
from drivers.errors import (
    ConfigError,
    DeviceError,
    DeviceFaultError,
    DeviceTimeoutError,
)
from drivers.spindle import emergency
from drivers.spindle.canbus import AlarmedBus
from drivers.spindle.canopen_node import (
    HEARTBEAT_ID,
    HOST_NODE_ID,
    NMT_ENTER_PRE_OPERATIONAL,
    NMT_START,
    OPERATIONAL,
    RPDO1_ID,
    SYNC_ID,
    CanOpenNode,
    Entry,
)
from drivers.spindle.cia402_profile import (
    DISABLE_VOLTAGE,
    ENABLE,
    ERROR_CODE,
    ERROR_COUNT,
    FAULT_RESET,
    FAULTY,
    QUICK_STOP,
    TARGET_REACHED,
    TOWARDS_ENABLED,
    DriveState,
)
from drivers.spindle.cia402_setup import COMMAND_LAYOUT, REPORT_LAYOUT, set_up_drive, watch_host
from drivers.spindle.interface import SILENT_AFTER, AlarmPath, Spindle, SpindleStatus

_TRANSITION_S = 1.0
_STANDSTILL_S = 3.0
_POLL_S = 0.01
_STEP_S = 0.001
_HISTORY = 8
_ASK_AGAIN_S = 0.02
_SPEED_TOLERANCE = 0.02
_STANDSTILL_SHARE = 0.001
"""Of the greatest speed: below it the drill counts as standing."""

_RESTARTED = "the drive restarted and lost its settings; open the drill again"


class Cia402Spindle(Spindle):
    """A drill on a CiA 402 drive. The bus is the spindle's own from here on, and closed with it.

    Opening stops a drill that is found turning, sets the drive up and reads it back; it resets no fault.
    """

    def __init__(
        self, bus: can.BusABC, clock: Clock, *, node_id: int, max_speed_rpm: float, heartbeat_s: float = 0.25
    ) -> None:
        """Find the drive, make sure that it is one, and set it up.

        Raises:
            DeviceTimeoutError: no drive answers.
            DeviceFaultError: it is no drive for this, or does not take its settings.
            ConnectionLostError: the wire is gone.
        """
        if not (math.isfinite(max_speed_rpm) and max_speed_rpm > 0):
            raise ValueError(f"max_speed_rpm is {max_speed_rpm}: allowed are finite speeds above 0")
        if not 0.02 <= heartbeat_s <= 60:
            raise ValueError(f"heartbeat_s is {heartbeat_s}: allowed 0.02 to 60 s")
        self._clock = clock
        self._node = CanOpenNode(bus, clock, node_id)
        self._rpdo_id = RPDO1_ID + node_id
        self._bus = bus
        self._heartbeat_s = heartbeat_s
        self._max_speed_rpm = max_speed_rpm
        self._commanded_rpm = 0
        self._stops = 0
        self._beating = False
        self._next_beat_s = -math.inf
        self._faults: list[str] = []
        self._state: DriveState | None = None
        self._target_reached = False
        self._closed = False
        self._asked = 0
        self._node.on_wait = self._beat
        try:
            self._identity, self._max_speed_rpm = set_up_drive(self._node, max_speed_rpm, heartbeat_s)
            self._node.command(NMT_START)
            self.stop()
            self.wait_until_at_speed(_STANDSTILL_S)
            if self._node.boot_ups:
                raise DeviceFaultError(f"{self._node.name}: {_RESTARTED}")
        except BaseException:
            bus.shutdown()
            raise

    @property
    def identity(self) -> str:
        """Device name, vendor, product, revision and serial number, as the drive tells them."""
        return self._identity

    @property
    def heartbeat_s(self) -> float:
        """The longest silence of the host that leaves the drill turning."""
        return self._heartbeat_s

    @property
    def alarm_path(self) -> AlarmPath | None:
        """Its EMCY frames, where the adapter is on a serial port."""
        return self._bus.alarm_path(self._node.node_id) if isinstance(self._bus, AlarmedBus) else None

    @property
    def answers(self) -> tuple[int, int]:
        """SYNCs sent and TPDOs received."""
        self._node.pump()
        return self._asked, self._node.reports

    @property
    def errors_on_wire(self) -> int:
        """Frames that the adapter refused, error frames, and frames of a wrong length."""
        return self._node.errors

    def heartbeats_s(self, duration_s: float) -> list[float]:
        """The drive's heartbeats as they come."""
        self._node.pump()
        self._node.beats_s.clear()
        self._node.wait(lambda: False, duration_s)
        return list(self._node.beats_s)

    def speed_unheard_rpm(self) -> float:
        """SYNC is no sign of life: only the host's heartbeat is."""
        self._beating = False
        return float(self._ask()[0])

    def past_faults(self) -> list[str]:
        """Object 1003h, the pre-defined error field (CiA 301)."""
        count = self._node.read_if_present(ERROR_COUNT) or 0
        fields = [Entry(ERROR_COUNT.index, place, "I", "past error") for place in range(1, min(count, _HISTORY) + 1)]
        codes = [self._node.read_if_present(field) for field in fields]
        return [emergency.words(code & 0xFFFF) for code in codes if code is not None]

    def start(self, speed_rpm: float) -> None:
        """Enable the drive and let the drill run up; a turning drill changes its speed.

        Raises:
            ConfigError: (also ValueError) a speed outside the limits; nothing was sent.
            DeviceFaultError: the drive is in fault, does not come up, or ``stop()`` came meanwhile.
        """
        if not (math.isfinite(speed_rpm) and 1 <= speed_rpm <= self._max_speed_rpm):
            raise ConfigError(
                f"{self._node.name}: speed {speed_rpm:g} rpm is outside the limits, allowed 1 to "
                f"{self._max_speed_rpm:g} rpm; nothing was sent"
            )
        target_rpm = round(speed_rpm)
        seen_stops = self._stops
        self._node.pump()
        if self._node.boot_ups:
            raise DeviceFaultError(f"{self._node.name}: {_RESTARTED}")
        self._node.command(NMT_START)
        self._ask()
        self._refuse_fault()
        self._forget_faults()
        watch_host(self._node, self._heartbeat_s)
        self._beating, self._next_beat_s = True, -math.inf
        self._beat()
        self._enable(target_rpm, seen_stops)
        self._commanded_rpm = target_rpm
        if self._stops != seen_stops:
            self.stop()
            raise self._stopped_meanwhile()

    def stop(self) -> None:
        """Quick stop, by one frame that waits for nothing.

        Raises:
            ConnectionLostError: the frame did not get out; the drive stops when the host's heartbeat stays away.
        """
        self._stops += 1
        self._commanded_rpm = 0
        self._command(QUICK_STOP, 0)

    def status(self) -> SpindleStatus:
        """The drive's answer to a SYNC sent now, and a sign of life to it."""
        self._beat()
        deadline_s = self._clock.now_s() + SILENT_AFTER * self._heartbeat_s
        speed_rpm, torque_per_mille = self._ask()
        if self._commanded_rpm == 0 and self._state is DriveState.OPERATION_ENABLED:
            self._command(QUICK_STOP, 0)  # the frame of stop() got lost
        fault = self._fault(deadline_s - self._clock.now_s())
        return SpindleStatus(float(speed_rpm), torque_per_mille / 1000, fault, self._clock.now_s())

    def wait_until_at_speed(self, timeout_s: float) -> SpindleStatus:
        """Wait for the commanded speed. After ``stop()`` wait for standstill, through a fault as well.

        Raises:
            DeviceTimeoutError: not at speed in time.
            DeviceFaultError: a fault, or ``stop()`` from another thread, while running up.
        """
        commanded_rpm, seen_stops = self._commanded_rpm, self._stops
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            status = self.status()
            if commanded_rpm == 0:
                if self._stands(status.speed_rpm):
                    self._beating = False
                    watch_host(self._node, None)
                    return status
            elif status.fault is not None:
                raise DeviceFaultError(f"{self._node.name}: {status.fault}")
            elif self._stops != seen_stops:
                raise self._stopped_meanwhile()
            elif self._target_reached and abs(status.speed_rpm - commanded_rpm) <= _SPEED_TOLERANCE * commanded_rpm:
                return status
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._node.name}: {status.speed_rpm:g} rpm after {timeout_s:g} s, "
                    f"commanded {commanded_rpm} rpm; check load and current limit of the drive"
                )
            self._clock.sleep_s(_POLL_S)

    def reset_fault(self) -> None:
        """Acknowledge the drive's fault; the drill stays off until ``start()``. An operator's act.

        Raises:
            DeviceFaultError: the cause is still there.
        """
        self._commanded_rpm = 0
        self._node.command(NMT_START)
        for control in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):
            self._command(control, 0)
            self._clock.sleep_s(_POLL_S)
        self._ask()
        self._refuse_fault()
        self._forget_faults()

    def close(self) -> None:
        """Stop, wait for standstill, give the bus back.

        Raises:
            DeviceError: standstill could not be confirmed; the bus is closed all the same.
        """
        if self._closed:
            return
        self._closed = True
        lost_before = self._node.lost
        try:
            self.stop()
            self.wait_until_at_speed(_STANDSTILL_S)
            self._node.command(NMT_ENTER_PRE_OPERATIONAL)
        except DeviceError:
            if not lost_before:
                raise
        finally:
            self._bus.shutdown()

    def _enable(self, target_rpm: int, seen_stops: int) -> None:
        deadline_s = self._clock.now_s() + _TRANSITION_S
        while True:
            self._ask()
            self._refuse_fault()
            state = self._state
            if state in TOWARDS_ENABLED or state is DriveState.OPERATION_ENABLED:
                control = TOWARDS_ENABLED.get(state, ENABLE)
                frame = COMMAND_LAYOUT.pack(control, target_rpm if control == ENABLE else 0)
                if not self._node.send(self._rpdo_id, frame, unless=lambda: self._stops != seen_stops):
                    raise self._stopped_meanwhile()
            if state is DriveState.OPERATION_ENABLED:
                return
            if self._clock.now_s() > deadline_s:
                self.stop()
                raise DeviceFaultError(
                    f"{self._node.name}: stays in state {state or 'unknown'} for {_TRANSITION_S:g} s; "
                    "check the supply of the drive's power stage and its enable input"
                )
            self._clock.sleep_s(_STEP_S)

    def _command(self, control: int, target_rpm: int) -> None:
        self._node.send(self._rpdo_id, COMMAND_LAYOUT.pack(control, target_rpm))

    def _beat(self) -> None:
        now_s = self._clock.now_s()
        if self._beating and now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self._heartbeat_s / 8
            self._node.send(HEARTBEAT_ID + HOST_NODE_ID, bytes((OPERATIONAL,)))

    def _ask(self) -> tuple[int, int]:
        """Speed and torque in per mille, as the drive answers a SYNC; its state is kept.

        Raises:
            DeviceTimeoutError: no answer within ``SILENT_AFTER`` heartbeats.
        """
        node = self._node
        node.pump()
        before = node.reports

        def answered(limit_s: float) -> bool:
            self._asked += 1
            node.send(SYNC_ID, b"")
            return node.wait(lambda: node.reports > before, limit_s)

        deadline_s = self._clock.now_s() + SILENT_AFTER * self._heartbeat_s
        is_heard = False
        while not is_heard and (remaining_s := deadline_s - self._clock.now_s()) > 0:
            is_heard = answered(min(_ASK_AGAIN_S, remaining_s))
        if not is_heard and self._clock.now_s() - deadline_s > _ASK_AGAIN_S:
            # This process was kept from running, and says nothing of the drive before it has asked once more.
            is_heard = answered(_ASK_AGAIN_S)
        if not is_heard:
            raise DeviceTimeoutError(
                f"{node.name}: silent, no answer to SYNC within {SILENT_AFTER * self._heartbeat_s:g} s; check the "
                "drive's power and the CAN cable, then open the drill again"
            )
        statusword, speed_rpm, torque_per_mille = REPORT_LAYOUT.unpack(node.report)
        self._state = DriveState.of(statusword)
        self._target_reached = bool(statusword & TARGET_REACHED)
        return speed_rpm, torque_per_mille

    def _stands(self, speed_rpm: float) -> bool:
        if self._state is DriveState.OPERATION_ENABLED or abs(speed_rpm) > _STANDSTILL_SHARE * self._max_speed_rpm:
            return False
        if self._state is DriveState.QUICK_STOP_ACTIVE:
            # A drive whose quick stop option cannot be set holds the standing drill; that power is not wanted.
            self._command(DISABLE_VOLTAGE, 0)
        return True

    def _fault(self, limit_s: float) -> str | None:
        """What is wrong, in words; a fault that the drive never announced is looked up within ``limit_s``."""
        for code in self._node.emergencies:
            expected = code == emergency.HOST_SILENT and self._commanded_rpm == 0
            if not emergency.is_reset(code) and not expected and emergency.words(code) not in self._faults:
                self._faults.append(emergency.words(code))
        self._node.emergencies.clear()
        texts = [f"drive fault {words}" for words in self._faults]
        if self._node.boot_ups:
            texts.append(_RESTARTED)
        elif self._state in FAULTY and not texts:
            self._faults.append(emergency.words(self._node.read(ERROR_CODE, limit_s=max(limit_s, _STEP_S))))
            texts.append(f"drive fault {self._faults[0]}")
        elif self._commanded_rpm and self._state is not DriveState.OPERATION_ENABLED and not texts:
            texts.append(f"the drive went to state {self._state or 'unknown'} by itself")
        return "; ".join(texts) or None

    def _refuse_fault(self) -> None:
        if self._state in FAULTY:
            fault = self._fault(self._heartbeat_s)
            raise DeviceFaultError(f"{self._node.name}: {fault}; remove the cause, then reset the fault")

    def _forget_faults(self) -> None:
        self._node.emergencies.clear()
        self._faults.clear()

    def _stopped_meanwhile(self) -> DeviceFaultError:
        return DeviceFaultError(f"{self._node.name}: stop() came while the drill was to run up")
