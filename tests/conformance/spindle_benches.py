"""Spindles with what hangs on their wires, for the conformance tests."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import can
from real_time import PtyDevice, in_second_thread, soon

from drivers.clock import Clock, SystemClock
from drivers.spindle.canbus import SlcanBus, open_bus
from drivers.spindle.cia402 import Cia402Spindle
from drivers.spindle.interface import Spindle
from firmware_sim.can_wire import Frame
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessBus, InProcessLine
from firmware_sim.slcan_adapter import SlcanAdapter

MAX_SPEED_RPM = 60_000.0


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


@dataclass
class SpindleBench:
    """A spindle fresh from its constructor. ``reopen`` makes another one on the same drive."""

    spindle: Spindle
    clock: Clock
    reopen: Callable[[], Spindle]
    load: Load
    plug: Plug
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
