"""What every motion controller promises (drivers/motion/interface.py)."""

import math
import time

import pytest
from motion_benches import MAX_FEED_MM_PER_S, MotionBench

from drivers.errors import (
    ConfigError,
    ConnectionLostError,
    DeviceFaultError,
    DeviceTimeoutError,
    NotHomedError,
    OutOfTravelError,
)
from drivers.motion.interface import MotionController, MotionState, Vector

FEED_MM_PER_S = 10.0


def shifted(point_mm: Vector, *, axis: int = 0, by_mm: float) -> Vector:
    x, y, z = (value + by_mm * (index == axis) for index, value in enumerate(point_mm))
    return (x, y, z)


def homed(bench: MotionBench) -> MotionController:
    bench.controller.home()
    return bench.controller


def moving(bench: MotionBench, *, by_mm: float = -8.0) -> tuple[MotionController, Vector]:
    controller = homed(bench)
    target_mm = shifted(controller.status().position_mm, by_mm=by_mm)
    controller.start_move(target_mm, feed_mm_per_s=FEED_MM_PER_S)
    # Half way up to speed at least, so that something can be interrupted.
    while controller.status().position_mm[0] - target_mm[0] > abs(by_mm) - 0.5:
        pass
    return controller, target_mm


def test_identity_travel_and_dead_time_are_told(motion_bench: MotionBench) -> None:
    controller = motion_bench.controller
    assert controller.identity
    assert all(low < high for low, high in zip(controller.travel.low_mm, controller.travel.high_mm, strict=True))
    assert 0 < controller.dead_time_s <= 0.2


def test_not_homed_is_refused(motion_wire_bench: MotionBench) -> None:
    before = motion_wire_bench.wire.lines
    with pytest.raises(NotHomedError, match="home"):
        motion_wire_bench.controller.start_move((0.0, 0.0, 0.0), feed_mm_per_s=FEED_MM_PER_S)
    assert motion_wire_bench.wire.lines == before


def test_homing_ends_idle_inside_the_travel(motion_bench: MotionBench) -> None:
    controller = homed(motion_bench)
    status = controller.status()
    assert status.state is MotionState.IDLE
    assert status.alarm is None
    assert controller.travel.contains(status.position_mm)


def test_a_move_ends_at_its_target(motion_bench: MotionBench) -> None:
    controller = homed(motion_bench)
    x, y, z = controller.status().position_mm
    target_mm = (x - 1.2344, y - 0.5, z - 0.75)
    controller.start_move(target_mm, feed_mm_per_s=FEED_MM_PER_S)
    status = controller.status()
    assert status.state is MotionState.MOVING
    assert 0 < status.queued_s < 1
    status = controller.wait_until_idle(5.0)
    assert status.state is MotionState.IDLE
    assert status.queued_s == 0
    assert math.dist(status.position_mm, target_mm) < 0.0015


def test_idle_is_not_told_before_the_last_of_many_short_moves(motion_bench: MotionBench) -> None:
    controller = homed(motion_bench)
    start_mm = controller.status().position_mm
    for index in range(1, 31):
        controller.start_move(shifted(start_mm, by_mm=-0.1 * index), feed_mm_per_s=FEED_MM_PER_S)
    assert math.dist(controller.wait_until_idle(5.0).position_mm, shifted(start_mm, by_mm=-3.0)) < 0.0015


def test_every_edge_of_the_travel_is_refused_just_outside_and_nothing_is_sent(motion_wire_bench: MotionBench) -> None:
    controller = homed(motion_wire_bench)
    travel = controller.travel
    middle_mm = tuple((low + high) / 2 for low, high in zip(travel.low_mm, travel.high_mm, strict=True))
    before = motion_wire_bench.wire.lines
    for axis in range(3):
        for edge, sign in ((travel.low_mm[axis], -1), (travel.high_mm[axis], 1)):
            for beyond in (1e-6, 1e-5, 4e-4, 5e-4, 6e-4, 1e-3, 0.01, 1.0, 1e3, 1e9, math.inf, math.nan):
                target = list(middle_mm)
                target[axis] = edge + sign * beyond
                with pytest.raises(OutOfTravelError, match="travel"):
                    controller.start_move((target[0], target[1], target[2]), feed_mm_per_s=FEED_MM_PER_S)
    assert motion_wire_bench.wire.lines == before
    assert controller.status().state is MotionState.IDLE


def test_the_very_edge_of_the_travel_is_reached(motion_bench: MotionBench) -> None:
    controller = homed(motion_bench)
    controller.start_move(controller.travel.high_mm, feed_mm_per_s=FEED_MM_PER_S)
    assert math.dist(controller.wait_until_idle(5.0).position_mm, controller.travel.high_mm) < 0.0015


@pytest.mark.parametrize("feed_mm_per_s", [0.0, -1.0, MAX_FEED_MM_PER_S + 0.01, math.inf, math.nan])
def test_a_feed_that_is_not_allowed_is_refused(motion_wire_bench: MotionBench, feed_mm_per_s: float) -> None:
    controller = homed(motion_wire_bench)
    before = motion_wire_bench.wire.lines
    with pytest.raises(ConfigError, match="feed"):
        controller.start_move(controller.status().position_mm, feed_mm_per_s=feed_mm_per_s)
    assert motion_wire_bench.wire.lines == before


def test_a_move_ends_where_it_should_after_hold_and_resume(motion_bench: MotionBench) -> None:
    controller, target_mm = moving(motion_bench)
    controller.hold()
    while controller.status().state is not MotionState.HELD:
        pass
    held_mm = controller.status().position_mm
    assert math.dist(held_mm, target_mm) > 1.0
    with pytest.raises(DeviceFaultError, match="hold"):
        controller.start_move(target_mm, feed_mm_per_s=FEED_MM_PER_S)
    with pytest.raises(DeviceTimeoutError, match="still held"):
        controller.wait_until_idle(0.2)
    assert controller.status().position_mm == held_mm
    controller.resume()
    assert math.dist(controller.wait_until_idle(5.0).position_mm, target_mm) < 0.0015


def test_resume_right_after_hold_is_not_lost(motion_bench: MotionBench) -> None:
    controller, target_mm = moving(motion_bench)
    controller.hold()
    controller.resume()
    assert math.dist(controller.wait_until_idle(5.0).position_mm, target_mm) < 0.0015


def test_resume_without_a_hold_changes_nothing(motion_bench: MotionBench) -> None:
    controller, target_mm = moving(motion_bench)
    controller.resume()
    assert math.dist(controller.wait_until_idle(5.0).position_mm, target_mm) < 0.0015


def test_flush_drops_the_queue_and_keeps_the_position(motion_wire_bench: MotionBench) -> None:
    controller, target_mm = moving(motion_wire_bench)
    controller.start_move(shifted(target_mm, axis=1, by_mm=-3.0), feed_mm_per_s=FEED_MM_PER_S)
    status = controller.flush()
    assert status.state is MotionState.IDLE
    assert status.queued_s == 0
    assert math.dist(status.position_mm, target_mm) > 1.0
    # The axes themselves are where the controller believes them: 1 mm up from power-up is machine zero.
    true_mm = motion_wire_bench.axes.axes_mm
    top_mm = shifted(true_mm, by_mm=0.0)
    assert all(
        abs((value - 1.0) - (position + origin)) < 0.03
        for value, position, origin in zip(top_mm, status.position_mm, (-25.0, -10.0, -20.0), strict=True)
    )
    back_mm = shifted(status.position_mm, by_mm=0.5)
    controller.start_move(back_mm, feed_mm_per_s=FEED_MM_PER_S)
    assert math.dist(controller.wait_until_idle(5.0).position_mm, back_mm) < 0.0015


def test_flush_at_rest_changes_nothing(motion_bench: MotionBench) -> None:
    controller = homed(motion_bench)
    before_mm = controller.status().position_mm
    status = controller.flush()
    assert status.state is MotionState.IDLE
    assert status.position_mm == before_mm
    assert controller.status().state is MotionState.IDLE


def test_halt_stops_and_latches_until_homing(motion_bench: MotionBench) -> None:
    controller, target_mm = moving(motion_bench)
    controller.halt()
    with pytest.raises(DeviceFaultError, match="halt"):
        controller.start_move(target_mm, feed_mm_per_s=FEED_MM_PER_S)
    with pytest.raises(DeviceFaultError, match="home"):
        controller.wait_until_idle(5.0)
    with pytest.raises(DeviceFaultError, match="halt"):
        controller.resume()
    status = controller.status()
    assert status.state is MotionState.ALARM
    assert status.alarm
    controller.home()
    assert controller.status().state is MotionState.IDLE
    assert math.dist(controller.status().position_mm, target_mm) > 1.0


def test_halt_from_a_second_thread_reaches_the_wire_while_the_first_waits(motion_wire_bench: MotionBench) -> None:
    controller = homed(motion_wire_bench)
    target_mm = shifted(controller.status().position_mm, by_mm=-20.0)
    controller.start_move(target_mm, feed_mm_per_s=2.0)
    called_s: list[float] = []

    def halt() -> None:
        called_s.append(motion_wire_bench.clock.now_s())
        controller.halt()

    motion_wire_bench.during_wait(halt)
    with pytest.raises(DeviceFaultError, match="halt"):
        controller.wait_until_idle(8.0)
    raised_s = motion_wire_bench.clock.now_s()
    # The bytes may still be on their way to the other end when the waiting thread has raised.
    deadline_s = time.monotonic() + 1.0
    while (stopped_s := motion_wire_bench.wire.stopped_s(called_s[0])) is None and time.monotonic() < deadline_s:
        controller.status()
    assert stopped_s is not None
    assert stopped_s - called_s[0] < 0.020
    assert raised_s - called_s[0] < 0.3


def test_an_alarm_latches_and_homing_releases_it(motion_wire_bench: MotionBench) -> None:
    controller, target_mm = moving(motion_wire_bench)
    language = motion_wire_bench.wire.language
    motion_wire_bench.axes.pressed = True
    with pytest.raises(DeviceFaultError, match=language.position):
        controller.wait_until_idle(5.0)
    motion_wire_bench.axes.pressed = False
    with pytest.raises(DeviceFaultError, match=language.alarm):
        controller.start_move(target_mm, feed_mm_per_s=FEED_MM_PER_S)
    assert controller.status().state is MotionState.ALARM
    assert language.alarm in (controller.status().alarm or "")
    controller.home()
    assert controller.status().state is MotionState.IDLE


def test_a_reset_by_somebody_else_latches(motion_wire_bench: MotionBench) -> None:
    controller, _ = moving(motion_wire_bench)
    motion_wire_bench.reset()
    with pytest.raises(DeviceFaultError, match=motion_wire_bench.wire.language.position):
        controller.wait_until_idle(5.0)
    motion_wire_bench.controller.home()
    assert controller.status().state is MotionState.IDLE


def test_a_target_below_the_floor_is_refused_and_one_above_it_reached(motion_wire_bench: MotionBench) -> None:
    controller = homed(motion_wire_bench)
    controller.set_floor(15.0)
    assert controller.travel.low_mm[2] == pytest.approx(15.0, abs=0.001)
    with pytest.raises(OutOfTravelError):
        controller.start_move((20.0, 0.0, 14.99), feed_mm_per_s=FEED_MM_PER_S)
    target_mm = (*controller.status().position_mm[:2], 15.001)
    controller.start_move(target_mm, feed_mm_per_s=FEED_MM_PER_S)
    assert math.dist(controller.wait_until_idle(5.0).position_mm, target_mm) < 0.0015
    controller.home()
    assert controller.travel.low_mm[2] == pytest.approx(15.0, abs=0.001)


def test_the_controller_itself_refuses_what_is_below_the_floor(motion_soft_limit_bench: MotionBench) -> None:
    """Only of makes whose firmware keeps the floor; the others say in their driver that they do not."""
    controller = homed(motion_soft_limit_bench)
    controller.set_floor(15.0)
    controller.start_move(shifted(controller.status().position_mm, axis=2, by_mm=-1.0), feed_mm_per_s=FEED_MM_PER_S)
    controller.wait_until_idle(5.0)
    motion_soft_limit_bench.inject(b"G53G1Z-6.000F600\n")
    while controller.status().state is MotionState.IDLE:
        pass
    with pytest.raises(DeviceFaultError, match="soft limits"):
        controller.wait_until_idle(5.0)
    controller.home()
    assert controller.travel.low_mm[2] == pytest.approx(15.0, abs=0.001)


def test_a_floor_goes_with_none_and_with_close(motion_wire_bench: MotionBench) -> None:
    controller = homed(motion_wire_bench)
    full = controller.travel
    controller.set_floor(3.0)
    controller.set_floor(None)
    assert controller.travel == full
    controller.set_floor(4.0)
    controller.close()
    again = motion_wire_bench.reopen()
    assert again.travel == full
    again.close()


@pytest.mark.parametrize("z_mm", [-8.01, 20.0, 50.0, math.nan, math.inf])
def test_a_floor_outside_the_travel_is_refused(motion_wire_bench: MotionBench, z_mm: float) -> None:
    controller = homed(motion_wire_bench)
    before = motion_wire_bench.wire.lines
    with pytest.raises(OutOfTravelError, match="floor"):
        controller.set_floor(z_mm)
    assert motion_wire_bench.wire.lines == before


def test_a_floor_is_not_written_in_motion(motion_wire_bench: MotionBench) -> None:
    controller, _ = moving(motion_wire_bench)
    with pytest.raises(DeviceFaultError, match="standstill"):
        controller.set_floor(3.0)
    controller.wait_until_idle(5.0)


def test_close_twice_and_in_motion(motion_wire_bench: MotionBench) -> None:
    controller, target_mm = moving(motion_wire_bench)
    controller.close()
    controller.close()
    stopped_mm = motion_wire_bench.axes.axes_mm
    with pytest.raises(ConnectionLostError, match="closed"):
        controller.start_move(target_mm, feed_mm_per_s=FEED_MM_PER_S)
    again = motion_wire_bench.reopen()
    again.status()
    assert motion_wire_bench.axes.axes_mm == stopped_mm
    again.close()


def test_a_wire_that_is_cut_is_named_and_latches(motion_wire_bench: MotionBench) -> None:
    controller, target_mm = moving(motion_wire_bench)
    motion_wire_bench.cut()
    with pytest.raises(ConnectionLostError):
        controller.wait_until_idle(2.0)
    with pytest.raises(ConnectionLostError):
        controller.start_move(target_mm, feed_mm_per_s=FEED_MM_PER_S)
    with pytest.raises(ConnectionLostError):
        controller.home()
