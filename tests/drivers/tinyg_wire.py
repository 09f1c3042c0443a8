"""The g2core driver on the emulated board, with a wire that a test may spoil."""

from collections.abc import Callable

from drivers.motion.interface import Vector
from drivers.motion.tinyg.driver import TinyGController
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine
from firmware_sim.tinyg_board import TinyGBoard

ORIGIN_MM: Vector = (-25.0, -10.0, -20.0)
SETTINGS = {"sl": 1.0, "lim": 1.0, "xtn": -35, "xtm": -0.5, "ytn": -40, "ytm": -0.5, "ztn": -28, "ztm": -0.5} | {
    f"{axis}{name}": value
    for name, value in {"vm": 2400, "fr": 2400, "jm": 86_400, "sv": 2400, "lv": 600, "lb": 1, "zb": 0.5}.items()
    for axis in "xyz"
}


class Axes:
    """Their switches are 1 mm up from where they stood at power-up."""

    def __init__(self) -> None:
        self.axes_mm: Vector = (0.0, 0.0, 0.0)
        self.lowest_mm = 0.0

    def move_to(self, time_s: float, axes_mm: Vector) -> None:
        self.axes_mm = axes_mm
        self.lowest_mm = min(self.lowest_mm, axes_mm[2])

    def limit_switches(self) -> tuple[bool, bool, bool]:
        x, y, z = self.axes_mm
        return x >= 1.0, y >= 1.0, z >= 1.0

    def probe_closed(self) -> bool:
        return False


class Wire(InProcessLine):
    """A wire that may change what either side writes."""

    to_board: Callable[[bytes], bytes] = staticmethod(lambda data: data)
    to_host: Callable[[bytes], bytes] = staticmethod(lambda data: data)

    def write(self, data: bytes) -> None:
        super().write(self.to_board(data))

    def read(self, timeout_s: float) -> bytes:
        return self.to_host(super().read(timeout_s))


class Bench:
    """A board that was just switched on."""

    def __init__(self, **settings: float) -> None:
        self.clock = SimClock()
        self.axes = Axes()
        self.board = TinyGBoard(self.axes, settings={**SETTINGS, **settings})
        self.clock.attach(self.board.advance_to)
        self.line = Wire(self.board, self.clock)

    def open(self, **options: object) -> TinyGController:
        return TinyGController(  # type: ignore[arg-type]
            self.line, self.clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0, **options
        )

    def homed(self) -> TinyGController:
        controller = self.open()
        controller.home()
        return controller
