"""Motion controllers with what hangs on their wires, for the conformance tests."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

from real_time import PtyDevice, in_second_thread, soon

from drivers.clock import Clock, SystemClock
from drivers.motion.grbl.driver import GrblController
from drivers.motion.interface import MotionController, Vector
from drivers.motion.serial_line import open_serial
from drivers.motion.tinyg.driver import TinyGController
from drivers.motion.transport import SerialLine
from firmware_sim.clock import SimClock
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.lines import InProcessLine
from firmware_sim.tinyg_board import TinyGBoard

Dialect = Literal["gnea", "grblhal", "tinyg"]
"""TinyG is another make, and not a dialect of GRBL's."""

ORIGIN_MM: Vector = (-25.0, -10.0, -20.0)
MAX_FEED_MM_PER_S = 40.0
SETTINGS = {
    "$10": 3,
    "$20": 1,
    "$21": 1,
    "$22": 1,
    "$23": 0,
    "$24": 600,
    "$25": 2400,
    "$26": 5,
    "$27": 0.5,
    "$130": 35,
    "$131": 40,
    "$132": 28,
} | {f"${first + axis}": value for first, value in ((100, 1000), (110, 2400), (120, 2000)) for axis in range(3)}

TINYG_SETTINGS = {"sl": 1.0, "lim": 1.0, "xtn": -35, "xtm": -0.5, "ytn": -40, "ytm": -0.5, "ztn": -28, "ztm": -0.5} | {
    f"{axis}{name}": value
    for name, value in {"vm": 2400, "fr": 2400, "jm": 86_400, "sv": 2400, "lv": 600, "lb": 1, "zb": 0.5}.items()
    for axis in "xyz"
}


def settings_for(dialect: Dialect) -> dict[str, float]:
    return {key: value for key, value in SETTINGS.items() if dialect == "gnea" or key != "$10"}


class Axes:
    """Three axes whose home switches are 1 mm up from where they stood at power-up, and a hand to press one."""

    def __init__(self) -> None:
        self.axes_mm: Vector = (0.0, 0.0, 0.0)
        self.pressed = False

    def move_to(self, time_s: float, axes_mm: Vector) -> None:
        self.axes_mm = axes_mm

    def limit_switches(self) -> tuple[bool, bool, bool]:
        x, y, z = (value >= 1.0 for value in self.axes_mm)
        return (x or self.pressed, y, z)

    def probe_closed(self) -> bool:
        return False


@dataclass(frozen=True)
class Language:
    """What the bytes of one make mean, and how it says what every make says."""

    without_queries: Callable[[bytes], bytes]
    """What was written at once, without questions that change nothing."""
    stop: tuple[bytes, ...]
    """What is all heard when the motion is stopped."""
    alarm: str
    """How a fault of the controller's own begins."""
    position: str
    """What a stop in motion makes of the position."""


GRBL = Language(
    without_queries=lambda data: data.replace(b"?", b""),
    stop=(b"!", b"\x18"),
    alarm="ALARM",
    position="position lost",
)

G2CORE = Language(
    without_queries=lambda data: data.replace(b'{"sr":null}\n', b""),
    stop=(b"!", b"\x04"),
    alarm="ALARM",
    position="position lost",
)


@dataclass
class Wire:
    """What reached the other end of the wire, and when, on the clock of the controller."""

    now_s: Callable[[], float]
    language: Language = GRBL
    heard: list[tuple[float, bytes]] = field(default_factory=list)

    def hear(self, data: bytes) -> None:
        self.heard.append((self.now_s(), data))

    @property
    def lines(self) -> bytes:
        """Everything but questions."""
        return b"".join(self.language.without_queries(data) for _, data in self.heard)

    def stopped_s(self, after_s: float) -> float | None:
        """When the first word of a stop was heard, at ``after_s`` or later; None before all of it was."""
        later = [(at_s, data) for at_s, data in self.heard if at_s >= after_s]
        whole = b"".join(data for _, data in later)
        if not all(word in whole for word in self.language.stop):
            return None
        return next(at_s for at_s, data in later if self.language.stop[0] in data)


@dataclass
class MotionBench:
    """A controller fresh from its constructor. ``reopen`` makes another one on the same board."""

    controller: MotionController
    clock: Clock
    reopen: Callable[[], MotionController]
    wire: Wire
    axes: Axes
    inject: Callable[[bytes], None]
    """Puts bytes on the wire that are not the driver's."""
    reset: Callable[[], None]
    """Somebody else resets the controller."""
    during_wait: Callable[[Callable[[], None]], None]
    """Has a second thread call something while the first one waits for the controller."""
    cut: Callable[[], None]
    """Takes the other side of the wire away."""


class TappedLine:
    """A line that tells the bench what is written, and lets it act while somebody reads."""

    def __init__(self, line: SerialLine, wire: Wire) -> None:
        self._line = line
        self._wire = wire
        self.on_read: Callable[[], None] | None = None

    @property
    def name(self) -> str:
        return self._line.name

    @property
    def descriptor(self) -> int | None:
        return self._line.descriptor

    def write(self, data: bytes) -> None:
        self._wire.hear(data)
        self._line.write(data)

    def read(self, timeout_s: float) -> bytes:
        if timeout_s > 0 and self.on_read is not None:
            action, self.on_read = self.on_read, None
            action()
        return self._line.read(timeout_s)

    def close(self) -> None:
        self._line.close()


def grbl(line: SerialLine, clock: Clock) -> GrblController:
    return GrblController(
        line,
        clock,
        origin_mm=ORIGIN_MM,
        max_feed_mm_per_s=MAX_FEED_MM_PER_S,
        expected_settings={"$130": 35, "$131": 40, "$132": 28},
    )


def tinyg(line: SerialLine, clock: Clock) -> TinyGController:
    return TinyGController(
        line,
        clock,
        origin_mm=ORIGIN_MM,
        max_feed_mm_per_s=MAX_FEED_MM_PER_S,
        expected_settings={"xtn": -35, "ytn": -40, "ztn": -28},
    )


def open_controller(dialect: Dialect, line: SerialLine, clock: Clock) -> MotionController:
    return tinyg(line, clock) if dialect == "tinyg" else grbl(line, clock)


def new_board(dialect: Dialect, axes: Axes) -> GrblBoard | TinyGBoard:
    if dialect == "tinyg":
        return TinyGBoard(axes, settings=TINYG_SETTINGS)
    return GrblBoard(axes, dialect=dialect, settings=settings_for(dialect))


def language_of(dialect: Dialect) -> Language:
    return G2CORE if dialect == "tinyg" else GRBL


@contextlib.contextmanager
def in_process_bench(dialect: Dialect) -> Iterator[MotionBench]:
    """The board on a virtual clock."""
    clock = SimClock()
    axes = Axes()
    board = new_board(dialect, axes)
    clock.attach(board.advance_to)
    wire = Wire(clock.now_s, language_of(dialect))
    lines: list[TappedLine] = []

    def reopen() -> MotionController:
        lines.append(TappedLine(InProcessLine(board, clock), wire))
        return open_controller(dialect, lines[-1], clock)

    def during_wait(action: Callable[[], None]) -> None:
        lines[-1].on_read = partial(in_second_thread, action)

    controller = reopen()

    def reset() -> None:
        board.receive(b"\x18")

    bench = MotionBench(controller, clock, reopen, wire, axes, board.receive, reset, during_wait, lines[-1].close)
    with contextlib.closing(controller):
        yield bench


@contextlib.contextmanager
def pty_bench(dialect: Dialect) -> Iterator[MotionBench]:
    """The board behind a pty and pyserial, in real time."""
    axes = Axes()
    clock = SystemClock()
    wire = Wire(clock.now_s, language_of(dialect))
    board = PtyDevice(new_board(dialect, axes), wire.hear)
    with contextlib.closing(board), soon(0.1) as during_wait:

        def reopen() -> MotionController:
            return open_controller(dialect, open_serial(board.path, 115_200), clock)

        controller = reopen()
        with contextlib.closing(controller):
            reset = partial(board.inject, b"\x18")
            yield MotionBench(controller, clock, reopen, wire, axes, board.inject, reset, during_wait, cut=board.close)


@contextlib.contextmanager
def rig_file_bench(rig_file: Path) -> Iterator[MotionBench]:
    """The controller of a rig file; its wire cannot be looked at."""
    from cli.config import load_rig
    from cli.rig import WiredRig

    clock = SystemClock()
    rig = WiredRig(load_rig(rig_file), clock)

    def not_here(*_: object) -> None:
        raise AssertionError("a test that looks at the wire asks for motion_wire_bench")

    controller = rig.open_motion()
    with contextlib.closing(controller), soon(0.1) as during_wait:
        yield MotionBench(
            controller, clock, rig.open_motion, Wire(clock.now_s), Axes(), not_here, not_here, during_wait, not_here
        )
