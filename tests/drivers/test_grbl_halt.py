"""``halt()`` and the thread that reads, in every order (docs/decisions/0004); the board is the emulated one.

Nothing here is left to the scheduler: the one thread stands before a line of the driver while the other does its part.
"""

import contextlib
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from drivers.errors import ConnectionLostError, DeviceError, DeviceFaultError
from drivers.motion.grbl import driver
from drivers.motion.grbl.driver import GrblController
from drivers.motion.interface import MotionState, Vector
from firmware_sim.clock import SimClock
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.lines import InProcessLine

ORIGIN_MM: Vector = (-25.0, -10.0, -20.0)
SETTINGS = {"$10": 3, "$20": 1, "$21": 1, "$22": 1, "$24": 600, "$25": 2400, "$26": 1, "$27": 0.2} | {
    f"${first + axis}": value
    for first, value in ((100, 1000), (110, 2400), (120, 2000), (130, 35))
    for axis in range(3)
}
HALT = b"!\x18"

Call = Callable[[], object]
Place = tuple[str, int]
"""A function of the driver and a line in it."""


class Axes:
    def __init__(self) -> None:
        self.axes_mm: Vector = (0.0, 0.0, 0.0)
        self.pressed = False

    def move_to(self, time_s: float, axes_mm: Vector) -> None:
        self.axes_mm = axes_mm

    def limit_switches(self) -> tuple[bool, bool, bool]:
        x, y, z = self.axes_mm
        return (x >= 1.0 or self.pressed, y >= 1.0, z >= 1.0)

    def probe_closed(self) -> bool:
        return False


class HookedLine(InProcessLine):
    """A line on which a test may act right before and right behind what is written."""

    before: Callable[[bytes], None] = staticmethod(lambda data: None)
    behind: Callable[[bytes], None] = staticmethod(lambda data: None)

    def write(self, data: bytes) -> None:
        self.before(data)
        super().write(data)
        self.behind(data)


class Bench:
    """A homed controller."""

    def __init__(self, dialect: str = "gnea") -> None:
        self.clock = SimClock()
        self.axes = Axes()
        known = {key: value for key, value in SETTINGS.items() if dialect == "gnea" or key != "$10"}
        self.board = GrblBoard(self.axes, dialect=dialect, settings=known)  # type: ignore[arg-type]
        self.clock.attach(self.board.advance_to)
        self.line = HookedLine(self.board, self.clock)
        self.controller = GrblController(self.line, self.clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=40.0)
        self.controller.home()

    def move(self, by_mm: float = -9.0) -> None:
        x, y, z = self.controller.status().position_mm
        self.controller.start_move((x + by_mm, y, z), feed_mm_per_s=10.0)

    def refuses_motion_until_homed(self, *, lost: bool | None = None) -> None:
        """Whatever has happened: nothing moves, nothing is let through, and homing makes all good again."""
        self.clock.sleep_s(0.7)
        before_mm = self.axes.axes_mm
        with pytest.raises(DeviceFaultError, match=r"home\(\) releases") as refusal:
            self.controller.start_move((20.0, 5.0, 10.0), feed_mm_per_s=10.0)
        if lost is not None:
            assert f"position {'lost' if lost else 'kept'}; home" in str(refusal.value)
        assert self.controller.status().state is MotionState.ALARM
        self.clock.sleep_s(0.3)
        assert self.axes.axes_mm == before_mm
        self.controller.home()
        self.controller.start_move((20.0, 5.0, 10.0), feed_mm_per_s=40.0)
        assert self.controller.wait_until_idle(5.0).position_mm == pytest.approx((20.0, 5.0, 10.0), abs=0.0015)


def in_another_thread(action: Call) -> None:
    """To its end; an action that waits for the caller fails."""
    thread = threading.Thread(target=action)
    thread.start()
    thread.join(5.0)
    assert not thread.is_alive()


def before_lines(call: Call, act: Callable[[Place], bool]) -> None:
    """Make the call, and act before each line of the driver that it reaches, the first time, until told enough."""
    room, seen = str(Path(driver.__file__).parents[1]), set[Place]()

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        place = (frame.f_code.co_qualname, frame.f_lineno)
        if not frame.f_code.co_filename.startswith(room):
            return None
        if event == "line" and place not in seen:
            seen.add(place)
            if act(place):
                sys.settrace(previous)
        return trace

    previous = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(previous)


def places_of(call: Call) -> list[Place]:
    """The lines of the driver that a call runs through, in the order they are reached."""
    places: list[Place] = []

    def note(place: Place) -> bool:
        places.append(place)
        return False

    before_lines(call, note)
    return places


def interrupted(call: Call, place: Place, action: Call) -> None:
    """Make the call, with ``action`` done by another thread before ``place``; it may end as it likes."""

    def act(reached: Place) -> bool:
        if reached == place:
            in_another_thread(action)
        return reached == place

    with contextlib.suppress(DeviceError):
        before_lines(call, act)


def starting(bench: Bench) -> Call:
    return lambda: bench.move(-3.0)


def waiting(bench: Bench) -> Call:
    bench.move()
    return lambda: bench.controller.wait_until_idle(8.0)


def flushing(bench: Bench) -> Call:
    bench.move()
    return bench.controller.flush


def resuming(bench: Bench) -> Call:
    bench.move()
    bench.controller.hold()
    return bench.controller.resume


def writing_a_floor(bench: Bench) -> Call:
    return lambda: bench.controller.set_floor(0.0)


def homing(bench: Bench) -> Call:
    return bench.controller.home


def releasing(bench: Bench) -> Call:
    bench.controller.halt()
    return bench.controller.home


CALLS: dict[Callable[[Bench], Call], int] = {
    starting: 0,
    waiting: 0,
    flushing: 0,
    resuming: 0,
    writing_a_floor: 0,
    homing: 3,
    releasing: 3,
}
"""What the reading thread does, and after how many lines of it a halt is one that came meanwhile: ``home()`` releases
those before."""


@pytest.mark.parametrize(("prepare", "passed"), CALLS.items())
def test_a_halt_before_any_line_of_the_reader(prepare: Callable[[Bench], Call], passed: int) -> None:
    places = places_of(prepare(Bench()))
    assert len(places) > 40
    for place in places[passed:]:
        bench = Bench()
        interrupted(prepare(bench), place, bench.controller.halt)
        bench.refuses_motion_until_homed()


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
@pytest.mark.parametrize("prepare", CALLS)
def test_the_reader_does_anything_while_a_halt_is_about_to_write_and_when_it_has_written(
    dialect: str, prepare: Callable[[Bench], Call]
) -> None:
    for hook in ("before", "behind"):
        bench = Bench(dialect)
        call = prepare(bench)

        def once(data: bytes, bench: Bench = bench, call: Call = call) -> None:
            if data == HALT:
                bench.line.before = bench.line.behind = lambda data: None
                with contextlib.suppress(DeviceError):
                    call()

        setattr(bench.line, hook, once)
        in_another_thread(bench.controller.halt)
        bench.refuses_motion_until_homed()


def test_a_hold_before_any_line_of_resume_is_before_it_or_behind_it() -> None:
    """Nothing moves while a hold is believed to stand."""
    for place in places_of(resuming(Bench())):
        bench = Bench()
        interrupted(resuming(bench), place, bench.controller.hold)
        bench.clock.sleep_s(0.3)
        is_held = bench.controller.status().state is MotionState.HELD
        with pytest.raises(DeviceFaultError, match="a hold stands") if is_held else contextlib.nullcontext():
            bench.move(-3.0)
        if not is_held:
            assert bench.controller.wait_until_idle(5.0).state is MotionState.IDLE


def test_an_alarm_before_any_line_of_halt_leaves_the_position_lost() -> None:
    for place in places_of(Bench().controller.halt):
        bench = Bench()
        bench.move()

        def hear_an_alarm(bench: Bench = bench) -> None:
            bench.axes.pressed = True
            bench.clock.sleep_s(0.1)
            assert bench.controller.status().state is MotionState.ALARM
            bench.axes.pressed = False

        interrupted(bench.controller.halt, place, hear_an_alarm)
        bench.refuses_motion_until_homed(lost=True)


def test_a_halt_in_motion_loses_the_position_and_one_at_rest_keeps_it() -> None:
    for is_moving in (True, False):
        bench = Bench()
        if is_moving:
            bench.move()
            bench.clock.sleep_s(0.3)
        in_another_thread(bench.controller.halt)
        bench.clock.sleep_s(1.0)
        bench.controller.status()
        bench.refuses_motion_until_homed(lost=is_moving)


def test_two_halts_at_once_are_both_released_by_the_next_homing() -> None:
    for place in places_of(Bench().controller.halt):
        bench = Bench()
        interrupted(bench.controller.halt, place, bench.controller.halt)
        bench.refuses_motion_until_homed()


def test_a_halt_whose_bytes_do_not_get_out_still_latches() -> None:
    bench = Bench()

    def refuse(data: bytes) -> None:
        raise ConnectionLostError("the wire took no byte")

    bench.line.before = refuse
    with pytest.raises(ConnectionLostError):
        bench.controller.halt()
    bench.line.before = lambda data: None
    bench.refuses_motion_until_homed(lost=False)
