"""An RC8 behind b-CAP, in process and behind a UDP socket; both on a virtual clock.

A datagram to this very machine has arrived when the call that sent it returns, so that a real socket can be served in
virtual time: nothing depends on how soon a process is run.
"""

import contextlib
import select
import threading
from collections.abc import Callable, Iterator
from functools import partial

from motion_benches import MAX_FEED_MM_PER_S, Axes, Language, MotionBench, TappedLine, Wire
from real_time import JOIN_S, in_second_thread, soon

from drivers.clock import SystemClock
from drivers.motion.bcap.driver import BcapController
from drivers.motion.bcap.fed import FedRobot
from drivers.motion.interface import MotionController, Travel
from drivers.motion.transport import DatagramLine
from drivers.motion.udp_line import UdpLine, open_udp
from firmware_sim.bcap_controller import RcController
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine
from firmware_sim.udp_port import UdpPort

ORIGIN_MM = (326.0, -129.0, 221.0)
ORIENTATION_DEG = (180.0, 0.0, 180.0)
TRAVEL = Travel((-10.0, -30.0, -8.0), (24.5, 9.5, 19.5))
_VALUE_OF_A_VARIABLE, _HALT = b"\x65\0\0\0\x01\0", b"\x46\0\0\0\x02\0"
"""Function and number of arguments, as they stand in a packet."""


def without_queries(datagram: bytes) -> bytes:
    is_query = datagram[9:15] == _VALUE_OF_A_VARIABLE or "CurPos".encode("utf-16-le") in datagram
    return b"" if is_query else datagram


BCAP = Language(without_queries, stop=(_HALT,), alarm="error 0x", position="position kept")


class InVirtualTime:
    """A line over a real socket; waiting lets virtual time pass."""

    def __init__(self, line: UdpLine, clock: SimClock) -> None:
        self._line = line
        self._clock = clock
        self.name, self.descriptor = line.name, None
        self.write, self.close = line.write, line.close

    def read(self, timeout_s: float) -> bytes:
        deadline_s = self._clock.now_s() + timeout_s
        while not (data := self._line.read(0.0)) and self._clock.now_s() < deadline_s:
            self._clock.sleep_s(min(0.001, deadline_s - self._clock.now_s()))
        return data


def bcap(line: DatagramLine, clock: SimClock) -> BcapController:
    return BcapController(
        line,
        clock,
        origin_mm=ORIGIN_MM,
        orientation_deg=ORIENTATION_DEG,
        travel=TRAVEL,
        max_feed_mm_per_s=MAX_FEED_MM_PER_S,
    )


@contextlib.contextmanager
def in_process_bcap_bench() -> Iterator[MotionBench]:
    """The controller on a virtual clock."""
    clock, axes = SimClock(), Axes()
    board = RcController(axes)
    clock.attach(board.advance_to)
    wire = Wire(clock.now_s, BCAP)
    with _bench(lambda: TappedLine(InProcessLine(board, clock), wire), board, clock, wire, axes) as bench:
        yield bench


@contextlib.contextmanager
def udp_bcap_bench() -> Iterator[MotionBench]:
    """The controller behind a UDP socket."""
    clock, axes, port = SimClock(), Axes(), UdpPort()
    board = RcController(axes)
    wire = Wire(clock.now_s, BCAP)

    def serve(time_s: float) -> None:
        while not port.closed and (heard := port.read()):
            wire.hear(heard)
            board.receive(heard)
        board.advance_to(time_s)
        while not port.closed and (said := board.transmit()):
            port.write(said)

    clock.attach(serve)
    nobody = Wire(clock.now_s, BCAP)
    with (
        contextlib.closing(port),
        _bench(
            lambda: TappedLine(InVirtualTime(open_udp(port.host, port.port), clock), nobody), board, clock, wire, axes
        ) as bench,
    ):
        bench.cut = port.close
        yield bench


class UdpDevice:
    """The controller behind a UDP port on a thread of its own.

    Its time goes on with the machine's, but never by more than 2 ms between two looks at the wire: how late this
    thread is run says nothing about whoever feeds it.
    """

    def __init__(self, board: RcController, wire: Wire) -> None:
        self.board = board
        self.lock = threading.Lock()
        self.port = UdpPort()
        self._wire = wire
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        if not self._over.is_set():
            self._over.set()
            self._thread.join(JOIN_S)
            self.port.close()

    def _serve(self) -> None:
        clock, time_s = SystemClock(), 0.0
        before_s = clock.now_s()
        while not self._over.is_set():
            select.select([self.port], [], [], 0.001)
            with self.lock:
                while data := self.port.read():
                    self._wire.hear(data)
                    self.board.receive(data)
                now_s = clock.now_s()
                time_s += min(now_s - before_s, 0.002)
                before_s = now_s
                self.board.advance_to(time_s)
                while said := self.board.transmit():
                    self.port.write(said)


@contextlib.contextmanager
def fed_bcap_bench() -> Iterator[MotionBench]:
    """The controller behind a UDP socket in real time, fed by a process of its own."""
    clock, axes = SystemClock(), Axes()
    wire = Wire(clock.now_s, BCAP)
    device = UdpDevice(RcController(axes), wire)

    def reopen() -> FedRobot:
        return fed(device.port, clock)

    def locked(action: Callable[..., None]) -> Callable[..., None]:
        def act(*arguments: object) -> None:
            with device.lock:
                action(*arguments)

        return act

    with contextlib.closing(device), soon(0.1) as during_wait, contextlib.closing(reopen()) as controller:
        inject, reset = locked(device.board.receive), locked(device.board.restart)
        yield MotionBench(controller, clock, reopen, wire, axes, inject, reset, during_wait, device.close)


def fed(port: UdpPort, clock: SystemClock, *, silence_s: float = 0.55) -> FedRobot:
    return FedRobot(
        port.host,
        port.port,
        clock,
        origin_mm=ORIGIN_MM,
        orientation_deg=ORIENTATION_DEG,
        travel=TRAVEL,
        max_feed_mm_per_s=MAX_FEED_MM_PER_S,
        reply_s=0.1,
        silence_s=silence_s,
    )


@contextlib.contextmanager
def _bench(
    line: Callable[[], TappedLine], board: RcController, clock: SimClock, wire: Wire, axes: Axes
) -> Iterator[MotionBench]:
    lines: list[TappedLine] = []

    def reopen() -> MotionController:
        lines.append(line())
        return bcap(lines[-1], clock)

    def during_wait(action: Callable[[], None]) -> None:
        lines[-1].on_read = partial(in_second_thread, action)

    controller = reopen()
    with contextlib.closing(controller):
        yield MotionBench(
            controller, clock, reopen, wire, axes, board.receive, board.restart, during_wait, lines[-1].close
        )
