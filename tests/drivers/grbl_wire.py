"""The GRBL driver on the emulated board, with a wire and axes that a test may spoil."""

from collections.abc import Callable, Mapping

from drivers.motion.grbl.driver import GrblController
from drivers.motion.interface import Vector
from firmware_sim.clock import SimClock
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.lines import InProcessLine

ORIGIN_MM: Vector = (-25.0, -10.0, -20.0)
SETTINGS = {
    "$10": 3,
    "$20": 1,
    "$22": 1,
    "$24": 600,
    "$25": 2400,
    "$26": 5,
    "$27": 0.5,
    "$130": 35,
    "$131": 40,
    "$132": 28,
} | {f"${first + axis}": value for first, value in ((100, 1000), (110, 2400), (120, 2000)) for axis in range(3)}


class Axes:
    def __init__(self) -> None:
        self.axes_mm: Vector = (0.0, 0.0, 0.0)
        self.x_switch_is_low = False
        self.unplugged = False

    def move_to(self, time_s: float, axes_mm: Vector) -> None:
        self.axes_mm = axes_mm

    def limit_switches(self) -> tuple[bool, bool, bool]:
        x, y, z = self.axes_mm
        x_pressed = x <= -1.0 if self.x_switch_is_low else x >= 1.0
        return (x_pressed and not self.unplugged, y >= 1.0, z >= 1.0)

    def probe_closed(self) -> bool:
        return False


class BadLine:
    """A wire in which a test may change, line by line, what the controller says, and see what it is told."""

    name = "bad:wire"

    def __init__(self, line: InProcessLine) -> None:
        self._line = line
        self._rest = b""
        self.change: Callable[[bytes], bytes] = lambda line: line
        self.written = b""

    def write(self, data: bytes) -> None:
        self.written += data
        self._line.write(data)

    def read(self, timeout_s: float) -> bytes:
        *lines, self._rest = (self._rest + self._line.read(timeout_s)).split(b"\n")
        return b"".join(self.change(line + b"\n") for line in lines)

    def close(self) -> None:
        self._line.close()

    def once(self, start: bytes, change: Callable[[bytes], bytes]) -> None:
        """Change the next line that starts so."""
        left = [1]

        def one(line: bytes) -> bytes:
            if left and line.startswith(start):
                left.pop()
                return change(line)
            return line

        self.change = one


class Bench:
    def __init__(self, dialect: str, settings: Mapping[str, float]) -> None:
        self.clock = SimClock()
        self.axes = Axes()
        known = {key: value for key, value in settings.items() if dialect == "gnea" or key != "$10"}
        self.board = GrblBoard(self.axes, dialect=dialect, settings=known)  # type: ignore[arg-type]
        self.clock.attach(self.board.advance_to)

    def open(self, expected: Mapping[str, float] | None = None) -> tuple[GrblController, BadLine]:
        line = BadLine(InProcessLine(self.board, self.clock))
        controller = GrblController(
            line, self.clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0, expected_settings=expected or {}
        )
        return controller, line


def homed(dialect: str = "gnea") -> tuple[GrblController, BadLine, Bench]:
    bench = Bench(dialect, SETTINGS)
    controller, line = bench.open()
    controller.home()
    return controller, line, bench


Wired = tuple[GrblController, BadLine, Bench]
