"""Spindles with what hangs on their wires, for the conformance tests."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import can
from motion_benches import ORIGIN_MM, Axes, Dialect, settings_for
from real_time import PtyDevice, in_second_thread, soon

from drivers.clock import Clock, SystemClock
from drivers.motion.grbl.driver import GrblController
from drivers.motion.serial_line import open_serial
from drivers.motion.transport import SerialLine
from drivers.spindle.canbus import SlcanBus, open_bus
from drivers.spindle.cia402 import Cia402Spindle
from drivers.spindle.grbl import GrblSpindle
from drivers.spindle.interface import Spindle
from drivers.spindle.modbus import ModbusSpindle
from firmware_sim.can_wire import Frame
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.clock import SimClock
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.lines import InProcessBus, InProcessLine
from firmware_sim.modbus_drive import ModbusDrive
from firmware_sim.slcan_adapter import SlcanAdapter
from firmware_sim.spindle_motor import SpindleMotor

MAX_SPEED_RPM = 60_000.0
QUICK_STOP = (0x201, bytes.fromhex("020000000000"))


class Load:
    """A shaft, and a hand to hold it."""

    def __init__(self) -> None:
        self.torque = 0.05
        self.speed_rpm = 0.0

    def turn(self, time_s: float, speed_rpm: float) -> None:
        self.speed_rpm = speed_rpm

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        return self.torque


class Plug:
    """The drive on the bus: what reaches it and when, and a plug to pull."""

    def __init__(self, drive: Cia402Drive, now_s: Callable[[], float]) -> None:
        self._drive = drive
        self._now_s = now_s
        self.heard: list[tuple[float, Frame]] = []
        self.pulled = False

    def receive(self, can_id: int, data: bytes) -> None:
        if not self.pulled:
            self.heard.append((self._now_s(), (can_id, data)))
            self._drive.receive(can_id, data)

    def transmit(self) -> list[Frame]:
        frames = self._drive.transmit()
        return [] if self.pulled else frames

    def advance_to(self, time_s: float) -> None:
        self._drive.advance_to(time_s)

    @property
    def stops_s(self) -> list[float]:
        return [time_s for time_s, frame in self.heard if frame == QUICK_STOP]


class ListeningDrive(ModbusDrive):
    """An inverter that tells when it takes a stop."""

    def __init__(self, load: Load, now_s: Callable[[], float]) -> None:
        super().__init__(load)
        self._now_s = now_s
        self.stops_s: list[float] = []

    def command(self, word: int) -> None:
        if word & 0b11 == 0b01:
            self.stops_s.append(self._now_s())
        super().command(word)


class SerialPlug:
    """A drive on a serial line, and a plug to pull."""

    def __init__(self, drive: "ListeningDrive | BoardWithDrill") -> None:
        self._drive = drive
        self.stops_s = drive.stops_s
        self.pulled = False

    def receive(self, data: bytes) -> None:
        if not self.pulled:
            self._drive.receive(data)

    def transmit(self) -> bytes:
        data = self._drive.transmit()
        return b"" if self.pulled else data

    def advance_to(self, time_s: float) -> None:
        self._drive.advance_to(time_s)


class BoardWithDrill:
    """A motion board with a drill on its spindle output; it tells when it is told to stop."""

    def __init__(self, load: Load, now_s: Callable[[], float], dialect: Dialect) -> None:
        settings = settings_for(dialect) | {"$30": MAX_SPEED_RPM, "$31": 0, "$32": 0}
        self._board = GrblBoard(Axes(), dialect=dialect, settings=settings)
        self._motor = SpindleMotor(load)
        self._now_s = now_s
        self.stops_s: list[float] = []

    def receive(self, data: bytes) -> None:
        if b"!" in data:
            self.stops_s.append(self._now_s())
        self._board.receive(data)

    def transmit(self) -> bytes:
        return self._board.transmit()

    def advance_to(self, time_s: float) -> None:
        self._board.advance_to(time_s)
        self._motor.advance_to(time_s, self._board.spindle_rpm)


class OnRead:
    """A line on which something can be done while somebody reads."""

    def __init__(self, line: SerialLine) -> None:
        self._line = line
        self.action: Callable[[], None] | None = None

    @property
    def name(self) -> str:
        return self._line.name

    @property
    def descriptor(self) -> int | None:
        return self._line.descriptor

    def write(self, data: bytes) -> None:
        self._line.write(data)

    def read(self, timeout_s: float) -> bytes:
        if timeout_s > 0 and self.action is not None:
            action, self.action = self.action, None
            in_second_thread(action)
        return self._line.read(timeout_s)

    def close(self) -> None:
        self._line.close()


@dataclass
class SpindleBench:
    """A spindle fresh from its constructor. ``reopen`` makes another one on the same drive."""

    spindle: Spindle
    clock: Clock
    reopen: Callable[[], Spindle]
    load: Load
    plug: Plug | SerialPlug
    during_wait: Callable[[Callable[[], None]], None]
    """Has a second thread call something while the first one waits for the spindle."""


def cia402(bus: can.BusABC, clock: Clock) -> Cia402Spindle:
    return Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=MAX_SPEED_RPM)


@contextlib.contextmanager
def in_process_bench(*, lawicel: bool) -> Iterator[SpindleBench]:
    """The drive on a virtual clock, on a bus or behind an adapter."""
    clock, load = SimClock(), Load()
    plug = Plug(Cia402Drive(load), clock.now_s)
    buses: list[can.BusABC] = []
    adapter = SlcanAdapter([plug]) if lawicel else None
    if adapter is not None:
        clock.attach(adapter.advance_to)

    def reopen() -> Spindle:
        if adapter is None:
            buses.append(InProcessBus(plug, clock))
        else:
            buses.append(SlcanBus(InProcessLine(adapter, clock, name="in-process:slcan"), 1_000_000))
        return cia402(buses[-1], clock)

    def during_wait(action: Callable[[], None]) -> None:
        bus = buses[-1]
        recv = bus.recv

        def once(timeout: float | None = None) -> can.Message | None:
            bus.recv = recv  # type: ignore[method-assign]
            in_second_thread(action)
            return recv(timeout)

        bus.recv = once  # type: ignore[method-assign]

    spindle = reopen()
    with contextlib.closing(spindle):
        yield SpindleBench(spindle, clock, reopen, load, plug, during_wait)


@contextlib.contextmanager
def pty_bench() -> Iterator[SpindleBench]:
    """The adapter behind a pty and pyserial, in real time."""
    clock, load = SystemClock(), Load()
    plug = Plug(Cia402Drive(load), clock.now_s)
    with contextlib.closing(PtyDevice(SlcanAdapter([plug]))) as adapter, soon(0.05) as during_wait:

        def reopen() -> Spindle:
            return cia402(open_bus("slcan", adapter.path, 1_000_000), clock)

        spindle = reopen()
        with contextlib.closing(spindle):
            yield SpindleBench(spindle, clock, reopen, load, plug, during_wait)


def modbus(line: SerialLine, clock: Clock, heartbeat_s: float = 0.3) -> ModbusSpindle:
    return ModbusSpindle(
        line,
        clock,
        max_speed_rpm=MAX_SPEED_RPM,
        rated_current_a=3.0,
        baud=115_200,
        frequency_unit_hz=0.1,
        heartbeat_s=heartbeat_s,
    )


@contextlib.contextmanager
def in_process_modbus_bench() -> Iterator[SpindleBench]:
    """An inverter on a virtual clock."""
    clock, load = SimClock(), Load()
    plug = SerialPlug(ListeningDrive(load, clock.now_s))
    clock.attach(plug.advance_to)
    lines: list[OnRead] = []

    def reopen() -> Spindle:
        lines.append(OnRead(InProcessLine(plug, clock, name="in-process:spindle")))
        return modbus(lines[-1], clock)

    def during_wait(action: Callable[[], None]) -> None:
        lines[-1].action = action

    spindle = reopen()
    with contextlib.closing(spindle):
        yield SpindleBench(spindle, clock, reopen, load, plug, during_wait)


@contextlib.contextmanager
def pty_modbus_bench() -> Iterator[SpindleBench]:
    """The inverter behind a pty and pyserial, in real time."""
    clock, load = SystemClock(), Load()
    plug = SerialPlug(ListeningDrive(load, clock.now_s))
    with contextlib.closing(PtyDevice(plug)) as port, soon(0.05) as during_wait:

        def reopen() -> Spindle:
            return modbus(open_serial(port.path, 115_200), clock, heartbeat_s=0.8)

        spindle = reopen()
        with contextlib.closing(spindle):
            yield SpindleBench(spindle, clock, reopen, load, plug, during_wait)


def grbl(line: SerialLine, clock: Clock, reply_s: float = 0.1) -> GrblSpindle:
    controller = GrblController(line, clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0, reply_s=reply_s)
    return GrblSpindle(controller, clock, max_speed_rpm=MAX_SPEED_RPM, run_up_s=0.6, on_close=controller.close)


@contextlib.contextmanager
def in_process_grbl_bench(dialect: Dialect) -> Iterator[SpindleBench]:
    """A motion board with a drill, on a virtual clock."""
    clock, load = SimClock(), Load()
    plug = SerialPlug(BoardWithDrill(load, clock.now_s, dialect))
    clock.attach(plug.advance_to)
    lines: list[OnRead] = []

    def reopen() -> Spindle:
        lines.append(OnRead(InProcessLine(plug, clock)))
        return grbl(lines[-1], clock)

    def during_wait(action: Callable[[], None]) -> None:
        lines[-1].action = action

    spindle = reopen()
    with contextlib.closing(spindle):
        yield SpindleBench(spindle, clock, reopen, load, plug, during_wait)


@contextlib.contextmanager
def pty_grbl_bench(dialect: Dialect) -> Iterator[SpindleBench]:
    """The board behind a pty and pyserial, in real time."""
    clock, load = SystemClock(), Load()
    plug = SerialPlug(BoardWithDrill(load, clock.now_s, dialect))
    with contextlib.closing(PtyDevice(plug)) as port, soon(0.05) as during_wait:

        def reopen() -> Spindle:
            return grbl(open_serial(port.path, 115_200), clock, reply_s=0.3)

        spindle = reopen()
        with contextlib.closing(spindle):
            yield SpindleBench(spindle, clock, reopen, load, plug, during_wait)


@contextlib.contextmanager
def rig_file_bench(rig_file: Path) -> Iterator[SpindleBench]:
    """The spindle of a rig file; its wire cannot be looked at."""
    from cli.config import load_rig
    from cli.rig import WiredRig

    clock = SystemClock()
    rig = WiredRig(load_rig(rig_file), clock)
    spindle = rig.open_spindle()
    plug = Plug(Cia402Drive(Load()), clock.now_s)
    with contextlib.closing(spindle), soon(0.05) as during_wait:
        yield SpindleBench(spindle, clock, rig.open_spindle, Load(), plug, during_wait)
