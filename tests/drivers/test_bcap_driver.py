"""What is b-CAP's own: set-points every 8 ms, a buffer that must not run empty, an arm that knows where it is."""

import math
import random
import struct
from collections.abc import Callable, Iterator
from itertools import groupby

import numpy as np
import numpy.typing as npt
import pytest

from drivers.errors import ConfigError, DeviceError, DeviceFaultError
from drivers.motion.bcap.driver import BcapController
from drivers.motion.interface import MotionState, Travel, Vector
from firmware_sim.bcap_controller import RcController
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine

Floats = npt.NDArray[np.float64]

PERIOD_S = 0.008
GREATEST_CHANGE_MM_S = 500.0 * PERIOD_S
START_MM = (24.0, 9.0, 19.0)
TRAVEL = Travel((-10.0, -30.0, -8.0), (24.5, 9.5, 19.5))


class Arm:
    """What the controller moves, and a hand on its emergency stop."""

    def __init__(self) -> None:
        self.axes_mm: Vector = (0.0, 0.0, 0.0)
        self.pressed = False
        self.past: list[tuple[float, Vector]] = [(0.0, self.axes_mm)]

    def move_to(self, time_s: float, axes_mm: Vector) -> None:
        self.axes_mm = axes_mm
        self.past.append((time_s, axes_mm))

    def velocities(self, since_s: float, until_s: float) -> Floats:
        """(n, 3) mm/s, of each period of the controller."""
        times_s = np.array([at_s for at_s, _ in self.past])
        axes_mm = np.array([axes for _, axes in self.past])
        grid_s = np.arange(round(since_s / PERIOD_S), round(until_s / PERIOD_S) + 1) * PERIOD_S
        places_mm = np.stack([np.interp(grid_s, times_s, axes_mm[:, axis]) for axis in range(3)], axis=1)
        return np.asarray(np.diff(places_mm, axis=0) / PERIOD_S)

    def limit_switches(self) -> tuple[bool, bool, bool]:
        return (self.pressed, False, False)

    def probe_closed(self) -> bool:
        return False


class Network:
    """The way between both, on which datagrams may come to harm."""

    def __init__(self, board: RcController) -> None:
        self._board = board
        self.asked: list[bytes] = []
        self.there: Callable[[bytes], list[bytes]] = lambda datagram: [datagram]
        self.back: Callable[[bytes], bytes] = lambda datagram: datagram

    def receive(self, data: bytes) -> None:
        self.asked.append(data)
        for each in self.there(data):
            self._board.receive(each)

    def transmit(self) -> bytes:
        while data := self._board.transmit():
            if kept := self.back(data):
                return kept
        return b""


class Cell:
    """A robot that was just switched on, and a controller that has just opened it."""

    def __init__(self, **other: object) -> None:
        self.clock = SimClock()
        self.arm = Arm()
        self.board = RcController(self.arm)
        self.began_s = 0.0
        self.clock.attach(self.board.advance_to)
        self.network = Network(self.board)
        self.robot = self.open(**other)

    def open(self, **other: object) -> BcapController:
        known = {
            "origin_mm": (326.0, -129.0, 221.0),
            "orientation_deg": (180.0, 0.0, 180.0),
            "travel": TRAVEL,
            "max_feed_mm_per_s": 40.0,
        }
        return BcapController(InProcessLine(self.network, self.clock), self.clock, **known | other)  # type: ignore[arg-type]

    def watch(self) -> None:
        """Look at velocities from now on."""
        self.began_s = self.clock.now_s()

    def velocities(self) -> Floats:
        return self.arm.velocities(self.began_s, self.clock.now_s())

    def speeds(self) -> Floats:
        return np.asarray(np.linalg.norm(self.velocities(), axis=1))


@pytest.fixture
def cell() -> Iterator[Cell]:
    made = Cell()
    yield made
    made.robot.close()


def spoken(datagrams: list[bytes]) -> Iterator[str]:
    """What was asked for: the command of the arm or of the controller, or else the function."""
    names = {1: "start", 2: "stop", 3: "connect", 4: "disconnect", 7: "arm", 9: "variable", 84: "release the arm"}
    names |= {101: "value", 111: "release a variable"}
    for data in datagrams:
        function, first = data[9], 15 + 4 + 10
        (size,) = struct.unpack_from("<I", data, first + 10) if function in (17, 64) else (0,)
        yield names.get(function) or data[first + 14 : first + 14 + size].decode("utf-16-le")


def test_the_order_of_start_up_and_shut_down(cell: Cell) -> None:
    cell.robot.home()
    cell.robot.start_move((23.0, 9.0, 19.0), feed_mm_per_s=10.0)
    cell.robot.wait_until_idle(2.0)
    cell.robot.close()
    read = ("value", "CurPos")
    assert [word for word, _ in groupby(word for word in spoken(cell.network.asked) if word not in read)] == [
        *("start", "connect", "variable", "arm"),
        *("slvChangeMode", "ClearError", "TakeArm", "Motor", "ExtSpeed"),
        *("slvChangeMode", "slvMove", "slvChangeMode"),
        *("Motor", "GiveArm", "release the arm", "release a variable", "disconnect", "stop"),
    ]
    assert not cell.board.motor_on
    assert cell.board.state == "Idle"


def test_set_points_keep_to_feed_and_acceleration_round_corners(cell: Cell) -> None:
    cell.robot.home()
    cell.watch()
    for target_mm in ((14.0, 9.0, 19.0), (14.0, -1.0, 19.0), (13.9, -1.0, 19.0), (14.0, -1.0, 12.0), (18.0, 3.0, 12.0)):
        cell.robot.start_move(target_mm, feed_mm_per_s=20.0)
    assert math.dist(cell.robot.wait_until_idle(10.0).position_mm, (18.0, 3.0, 12.0)) < 1e-6
    assert cell.speeds().max() == pytest.approx(20.0, abs=1e-3)
    changes = np.linalg.norm(np.diff(cell.velocities(), axis=0), axis=1)
    # A step that holds a corner is two directions in one: its mean velocity is on the chord.
    assert changes.max() < 2.2 * GREATEST_CHANGE_MM_S


def test_a_closed_lap_of_short_segments_does_not_slow_down(cell: Cell) -> None:
    """Segments of 40 ms, three ahead, as the milling loop writes them."""
    cell.robot.home()
    cell.robot.start_move((12.0, 0.0, 10.0), feed_mm_per_s=20.0)
    cell.robot.wait_until_idle(5.0)
    cell.watch()
    for index in range(1, 63):
        angle = index / 10
        target_mm = (10.0 + 2.0 * math.cos(angle), 2.0 * math.sin(angle), 10.0)
        cell.robot.start_move(target_mm, feed_mm_per_s=5.0)
        while cell.robot.status().queued_s > 0.12:
            pass
    cell.robot.wait_until_idle(5.0)
    cruising = cell.speeds()[10:-10]
    assert cruising.min() > 4.95
    assert cruising.max() < 5.001


def test_a_hold_slows_down_on_the_path_and_the_rest_stays(cell: Cell) -> None:
    cell.robot.home()
    cell.robot.start_move((4.0, 9.0, 19.0), feed_mm_per_s=40.0)
    while cell.robot.status().position_mm[0] > 18.0:
        pass
    asked_s = cell.clock.now_s()
    cell.watch()
    cell.robot.hold()
    while cell.robot.status().state is not MotionState.HELD:
        pass
    assert cell.clock.now_s() - asked_s < 0.25
    assert np.abs(cell.velocities()[:, 1:]).max() < 1e-6
    assert np.abs(np.diff(cell.velocities()[:, 0])).max() < 1.01 * GREATEST_CHANGE_MM_S
    cell.robot.resume()
    assert cell.robot.wait_until_idle(3.0).position_mm == (4.0, 9.0, 19.0)


def test_a_host_that_is_away_for_too_long_finds_the_arm_stopped(cell: Cell) -> None:
    cell.robot.home()
    cell.robot.start_move((4.0, 9.0, 19.0), feed_mm_per_s=10.0)
    cell.robot.status()
    cell.clock.sleep_s(0.5)
    stopped_mm = cell.arm.axes_mm
    status = cell.robot.status()
    while status.state is MotionState.MOVING:
        status = cell.robot.status()
    assert status.state is MotionState.ALARM
    with pytest.raises(DeviceFaultError, match=r"slave mode.*position kept.*home\(\)"):
        cell.robot.start_move((4.0, 9.0, 19.0), feed_mm_per_s=10.0)
    assert cell.arm.axes_mm == stopped_mm
    cell.robot.home()
    cell.robot.start_move((20.0, 9.0, 19.0), feed_mm_per_s=10.0)
    assert cell.robot.wait_until_idle(3.0).position_mm == (20.0, 9.0, 19.0)


def test_feed_is_enough_to_keep_it_going(cell: Cell) -> None:
    cell.robot.home()
    cell.robot.start_move((14.0, 9.0, 19.0), feed_mm_per_s=10.0)
    for _ in range(300):
        cell.clock.sleep_s(0.005)
        cell.robot.feed()
    assert cell.robot.status().state is MotionState.IDLE
    assert cell.robot.status().position_mm == (14.0, 9.0, 19.0)


@pytest.mark.parametrize("seed", range(2, 7))
def test_lost_and_doubled_datagrams_change_nothing(cell: Cell, seed: int) -> None:
    """Two of a hundred each way, which is much for a cable; of more, some come later than the buffer is deep."""
    rng = random.Random(seed)
    cell.network.there = lambda data: [data] * rng.choice([0, *[1] * 48, 2])
    cell.network.back = lambda data: data if rng.random() > 0.02 else b""
    cell.robot.home()
    for target_mm in ((20.0, 9.0, 19.0), (20.0, 5.0, 15.0), START_MM):
        cell.robot.start_move(target_mm, feed_mm_per_s=10.0)
        assert cell.robot.wait_until_idle(5.0).position_mm == target_mm
        assert cell.speeds().max() < 10.001, "no set-point was executed twice, or in the wrong order"


def test_any_reply_without_one_of_its_bytes_is_asked_for_again(cell: Cell) -> None:
    cell.robot.home()
    for missing in range(80):
        torn = [missing]

        def back(data: bytes, torn: list[int] = torn) -> bytes:
            index = torn.pop() if torn else len(data)
            return data[:index] + data[index + 1 :]

        cell.network.back = back
        assert cell.robot.status().position_mm == START_MM


def test_slave_mode_whose_reply_was_lost_is_left_by_homing(cell: Cell) -> None:
    cell.robot.home()
    asked = len(cell.network.asked)
    cell.network.back = lambda data: b"" if len(cell.network.asked) > asked + 1 else data
    with pytest.raises(DeviceError, match="no reply to 3 tries"):
        cell.robot.start_move((20.0, 9.0, 19.0), feed_mm_per_s=10.0)
    assert cell.board.state == "Run"
    cell.network.back = lambda data: data
    cell.robot.home()
    cell.robot.start_move((20.0, 9.0, 19.0), feed_mm_per_s=10.0)
    assert cell.robot.wait_until_idle(3.0).position_mm == (20.0, 9.0, 19.0)


def test_a_position_that_is_no_number_is_refused(cell: Cell) -> None:
    cell.robot.home()
    nan = b"\0\0\0\0\0\0\xf8\x7f"
    cell.network.back = lambda data: data[:25] + nan + data[33:] if len(data) > 60 else data
    with pytest.raises(DeviceError, match="CurPos answered"):
        cell.robot.status()
    cell.network.back = lambda data: data


def test_a_tool_that_is_turned_otherwise_is_refused() -> None:
    cell = Cell(orientation_deg=(180.0, 5.0, 180.0))
    with pytest.raises(DeviceFaultError, match="teach pendant"):
        cell.robot.home()
    cell.robot.close()
    same = Cell(orientation_deg=(-180.0, 360.0, 180.01))
    same.robot.home()
    same.robot.close()


def test_an_emergency_stop_and_a_mode_switch_are_told_at_homing(cell: Cell) -> None:
    cell.arm.pressed = True
    cell.clock.sleep_s(0.01)
    with pytest.raises(DeviceFaultError, match="emergency stop is pressed"):
        cell.robot.home()
    cell.arm.pressed = False
    cell.board.mode = 1
    cell.clock.sleep_s(0.01)
    with pytest.raises(DeviceFaultError, match="mode switch is at manual"):
        cell.robot.home()
    cell.board.mode = 3
    cell.robot.home()
    assert cell.robot.status().state is MotionState.IDLE


def test_an_error_at_rest_is_seen_by_the_next_report(cell: Cell) -> None:
    cell.robot.home()
    cell.board.raise_alarm(0x84204043)
    status = cell.robot.status()
    assert status.state is MotionState.ALARM
    assert "axis 3" in (status.alarm or "")


def test_after_a_halt_nothing_moves(cell: Cell) -> None:
    cell.robot.home()
    cell.robot.start_move((4.0, 9.0, 19.0), feed_mm_per_s=40.0)
    while cell.robot.status().position_mm[0] > 18.0:
        pass
    cell.robot.halt()
    stopped_mm = cell.arm.axes_mm
    for _ in range(20):
        assert cell.robot.status().state is MotionState.ALARM
        cell.clock.sleep_s(0.01)
    assert cell.arm.axes_mm == stopped_mm


def test_one_that_has_lost_its_way_to_the_controller_has_stopped_it(cell: Cell) -> None:
    cell.robot.home()
    cell.robot.start_move((4.0, 9.0, 19.0), feed_mm_per_s=10.0)
    cell.robot.status()
    cell.network.there = lambda _: []
    with pytest.raises(DeviceError, match="no reply"):
        cell.robot.wait_until_idle(5.0)
    cell.network.there = lambda data: [data]
    assert cell.board.state == "Alarm"
    with pytest.raises(DeviceFaultError, match="home"):
        cell.robot.wait_until_idle(5.0)
    cell.robot.home()


@pytest.mark.parametrize("high_mm", [(-10.0, 9.0, 19.0), (math.nan, 9.0, 19.0)])
def test_a_travel_that_is_no_box_is_refused(high_mm: Vector) -> None:
    with pytest.raises(ConfigError, match="no box"):
        Cell(travel=Travel(TRAVEL.low_mm, high_mm))
