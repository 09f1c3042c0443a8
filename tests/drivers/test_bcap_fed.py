"""A robot that a process of its own feeds: who may stop it, and what becomes of it when somebody dies."""

import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.clock import SystemClock
from drivers.errors import ConnectionLostError, DeviceBusyError, DeviceFaultError
from drivers.lock import DeviceLock, owner_of, udp_device
from drivers.motion.bcap.fed import FedRobot
from drivers.motion.interface import MotionState
from milling.guard import Guard

sys.path.insert(0, str(Path(__file__).parents[1] / "conformance"))
from bcap_benches import BCAP, UdpDevice, fed
from motion_benches import Axes, Wire

from firmware_sim.bcap_controller import RcController

CLOCK = SystemClock()
SOON_S = 5.0
"""For what takes a few hundredths of a second on a machine that does nothing else."""
OWNER = """
import sys
sys.path[:0] = [sys.argv[1]]
from bcap_benches import fed
from drivers.clock import SystemClock
from types import SimpleNamespace
robot = fed(SimpleNamespace(host="127.0.0.1", port=int(sys.argv[2])), SystemClock())
robot.home()
x, y, z = robot.status().position_mm
robot.start_move((x - 20.0, y, z), feed_mm_per_s=5.0)
print(robot.process_id, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def axes() -> Axes:
    return Axes()


@pytest.fixture
def device(axes: Axes) -> Iterator[UdpDevice]:
    served = UdpDevice(RcController(axes), Wire(CLOCK.now_s, BCAP))
    yield served
    served.close()


@pytest.fixture
def robot(device: UdpDevice) -> Iterator[FedRobot]:
    """On its way, 20 mm along X at 5 mm/s, 3 mm below the top of its travel."""
    with fed(device.port, CLOCK) as robot:
        robot.home()
        x, y, z = robot.status().position_mm
        z -= 2.5
        robot.start_move((x, y, z), feed_mm_per_s=20.0)
        robot.wait_until_idle(SOON_S)
        robot.start_move((x - 20.0, y, z), feed_mm_per_s=5.0)
        yield robot


def comes_true(what: Callable[[], bool]) -> bool:
    deadline_s = CLOCK.now_s() + SOON_S
    while not (true := what()) and CLOCK.now_s() < deadline_s:
        CLOCK.sleep_s(0.005)
    return true


def is_free(name: str) -> bool:
    try:
        DeviceLock(name).release()
    except DeviceBusyError:
        return False
    return True


def at_rest(device: UdpDevice) -> bool:
    with device.lock:
        return device.board.motion.mode == 0


def test_it_is_fed_while_whoever_asks_does_something_else(robot: FedRobot, axes: Axes) -> None:
    def far() -> bool:
        return axes.axes_mm[0] < -2.0

    assert comes_true(far)
    assert robot.status().state is MotionState.MOVING
    robot.hold()
    assert comes_true(lambda: robot.status().state is MotionState.HELD)
    with pytest.raises(DeviceFaultError, match="a hold stands"):
        robot.start_move(robot.status().position_mm, feed_mm_per_s=5.0)
    robot.flush()
    at_mm = robot.status().position_mm
    assert math.dist(robot.wait_until_idle(SOON_S).position_mm, at_mm) < 1e-6


def test_a_halt_is_heard_before_what_is_asked_behind_it(robot: FedRobot) -> None:
    robot.halt()
    with pytest.raises(DeviceFaultError, match="halted"):
        robot.start_move((20.0, 0.0, 15.0), feed_mm_per_s=5.0)
    robot.home()
    assert robot.status().state is MotionState.IDLE


def test_a_supervisor_holds_and_lifts_by_the_stop_path(robot: FedRobot, device: UdpDevice, axes: Axes) -> None:
    z_mm = axes.axes_mm[2]
    with Guard(robot.stop_path, CLOCK) as guard:
        guard.stop()
        assert comes_true(lambda: abs(axes.axes_mm[2] - z_mm - 1.5) < 0.01)
    assert comes_true(lambda: at_rest(device))
    with pytest.raises(DeviceFaultError, match="halted"):
        robot.start_move((20.0, 0.0, 15.0), feed_mm_per_s=5.0)


@pytest.mark.parametrize("ends", ["flush", "home"])
def test_no_move_is_taken_between_a_supervisors_hold_and_its_lift(
    robot: FedRobot, device: UdpDevice, axes: Axes, ends: str
) -> None:
    """Both forget a hold."""
    z_mm = axes.axes_mm[2]
    (first, _), (second, _) = robot.stop_path.script
    os.write(robot.stop_path.fd, first)
    getattr(robot, ends)()
    for move in (robot.resume, lambda: robot.start_move((20.0, 0.0, 15.0), feed_mm_per_s=5.0)):
        with pytest.raises(DeviceFaultError, match="a supervisor is stopping the arm"):
            move()
    assert robot.status().state is MotionState.IDLE
    os.write(robot.stop_path.fd, second)
    assert comes_true(lambda: abs(axes.axes_mm[2] - z_mm - 1.5) < 0.01)
    assert comes_true(lambda: robot.status().alarm == "halted by halt()")
    robot.home()
    robot.start_move(robot.status().position_mm, feed_mm_per_s=5.0)


def test_a_hold_does_not_end_a_lift(robot: FedRobot, axes: Axes) -> None:
    z_mm = axes.axes_mm[2]
    os.write(robot.stop_path.fd, b"^")

    def lifted_whatever_is_said() -> bool:
        robot.hold()
        return abs(axes.axes_mm[2] - z_mm - 1.5) < 0.01

    assert comes_true(lifted_whatever_is_said)


def test_a_supervisor_that_waits_long_is_still_heard(device: UdpDevice, axes: Axes) -> None:
    """Whoever asked is gone, and the page still has the supervisor's pipe: it speaks after its whole silence."""
    with fed(device.port, CLOCK, silence_s=1.3) as robot:
        robot.home()
        x, y, z = robot.status().position_mm
        robot.start_move((x, y, z - 2.5), feed_mm_per_s=20.0)
        robot.wait_until_idle(SOON_S)
        z_mm = axes.axes_mm[2]
        with Guard(robot.stop_path, CLOCK, silence_s=1.3) as guard:
            guard.arm()
            robot._requests.close()
            robot._lost = True
            assert comes_true(lambda: abs(axes.axes_mm[2] - z_mm - 1.5) < 0.01)
            assert "no sign of life" in (guard.stopped() or "")
    assert not device.board.motor_on


def test_a_feeder_that_fails_switches_the_motor_off(robot: FedRobot, device: UdpDevice) -> None:
    with pytest.raises(ConnectionLostError, match="the process that feeds the robot has ended"):
        robot._ask("start_move", nonsense=True)
    assert at_rest(device)
    assert not device.board.motor_on


def test_without_its_feeder_the_arm_stops_and_the_next_call_says_so(robot: FedRobot, device: UdpDevice) -> None:
    os.kill(robot.process_id, signal.SIGKILL)
    with pytest.raises(ConnectionLostError, match="the process that feeds the robot has ended"):
        robot.status()
    assert comes_true(lambda: at_rest(device))


def test_the_arm_of_a_killed_owner_comes_to_rest_on_its_path(device: UdpDevice, axes: Axes) -> None:
    words = [sys.executable, "-c", OWNER, str(Path(__file__).parents[1] / "conformance"), str(device.port.port)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        feeder = int(owner.stdout.readline())
        name = udp_device(device.port.host, device.port.port)
        assert (owner_of(name) or "").startswith(f"pid {owner.pid} (")
        with pytest.raises(DeviceBusyError, match=f"in use by pid {owner.pid} "):
            fed(device.port, CLOCK)
        assert comes_true(lambda: axes.axes_mm[0] < -1.0)
        owner.kill()
    # Nobody else has it before the arm stands and its motor is off.
    assert comes_true(lambda: is_free(name))
    assert at_rest(device)
    assert not device.board.motor_on
    assert -19.0 < axes.axes_mm[0] < -1.0
    assert abs(axes.axes_mm[1]) < 1e-6
    assert comes_true(lambda: not Path(f"/proc/{feeder}").exists())


def test_what_cannot_be_opened_leaves_no_process_and_no_lock(device: UdpDevice) -> None:
    device.close()
    with pytest.raises(ConnectionLostError, match="nobody is there"):
        fed(device.port, CLOCK)
    assert owner_of(udp_device(device.port.host, device.port.port)) is None
