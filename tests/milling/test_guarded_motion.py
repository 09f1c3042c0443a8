"""A controller beside which a supervisor stands: what is stopped from outside moves no more, and is called stopped."""

import os
import pty
import select
import tty
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from drivers.clock import SystemClock
from drivers.errors import DeviceFaultError, SafetyStop
from drivers.motion.grbl.driver import GrblController
from drivers.motion.interface import MotionState, StopPath
from firmware_sim.bench import MAX_FEED_MM_S, MECHANICAL_SETTINGS, ORIGIN_MM, PARK_MM, Bench
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine
from milling.guard import Guard
from milling.guarded_motion import GuardedMotion

SCRIPT = ((b"!", 0.0), (b"\x18", 0.0))
ELSEWHERE_MM = (PARK_MM[0] - 4.0, PARK_MM[1], PARK_MM[2])


@dataclass
class Guarded:
    """On the virtual clock; the supervisor is a process, and its wire leads to the test instead of the board."""

    motion: GuardedMotion
    guard: Guard
    far: int
    bench: Bench

    def stop(self) -> None:
        """From outside: the script has been written when this returns."""
        self.guard.stop()
        said = b""
        while len(said) < 2:
            assert select.select([self.far], [], [], 10.0)[0]
            said += os.read(self.far, 8)
        assert said == b"!\x18"


@pytest.fixture
def guarded() -> Iterator[Guarded]:
    bench, clock = Bench(seed=3), SimClock()
    clock.attach(bench.advance_to)
    far, near = pty.openpty()
    tty.setraw(near)
    with (
        GrblController(
            InProcessLine(bench, clock), clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=MAX_FEED_MM_S,
            expected_settings=MECHANICAL_SETTINGS,
        ) as controller,
        Guard(StopPath(near, SCRIPT), SystemClock()) as guard,
    ):  # fmt: skip
        yield Guarded(GuardedMotion(controller, guard), guard, far, bench)
    os.close(near)
    os.close(far)


def test_it_moves_as_the_controller_does(guarded: Guarded) -> None:
    motion = guarded.motion
    motion.home()
    motion.start_move(PARK_MM, feed_mm_per_s=10.0)
    assert motion.wait_until_idle(timeout_s=30.0).position_mm == pytest.approx(PARK_MM, abs=0.01)
    motion.start_move(ELSEWHERE_MM, feed_mm_per_s=1.0)
    motion.hold()
    assert motion.flush().state is MotionState.IDLE
    motion.resume()
    motion.set_floor(-5.0)
    assert motion.travel.low_mm[2] == pytest.approx(-5.0, abs=0.01)
    motion.set_floor(None)
    assert "mill-bench" in motion.identity
    assert motion.settings["$100"] == 1000
    assert motion.dead_time_s > 0.0
    assert motion.stop_path is None
    motion.close()
    motion.close()


def test_silence_is_allowed(guarded: Guarded) -> None:
    assert not select.select([guarded.far], [], [], 0.7)[0], "0.55 s would do for a supervisor that is armed"
    guarded.motion.home()


@pytest.mark.parametrize(
    "call",
    [
        lambda motion: motion.start_move(ELSEWHERE_MM, feed_mm_per_s=1.0),
        lambda motion: motion.status(),
        lambda motion: motion.wait_until_idle(1.0),
        lambda motion: motion.home(),
        lambda motion: motion.resume(),
        lambda motion: motion.flush(),
        lambda motion: motion.set_floor(None),
    ],
    ids=["start_move", "status", "wait_until_idle", "home", "resume", "flush", "set_floor"],
)
def test_nothing_moves_and_nothing_is_asked_once_it_is_stopped(guarded: Guarded, call) -> None:
    guarded.motion.home()
    before = tuple(guarded.bench.machine.tip_mm)
    guarded.stop()
    with pytest.raises(SafetyStop, match="supervisor: it has stopped the motion: told to stop; home next"):
        call(guarded.motion)
    assert tuple(guarded.bench.machine.tip_mm) == before


def test_what_the_controller_says_of_a_foreign_stop_is_told_as_a_stop(guarded: Guarded) -> None:
    """The reset comes while the driver waits: it sees a fault, and the supervisor says whose it was."""
    motion = guarded.motion
    motion.home()
    motion.start_move(ELSEWHERE_MM, feed_mm_per_s=1.0)
    status = guarded.motion._motion.status

    def stopped_meanwhile():
        guarded.stop()
        guarded.bench.receive(b"\x18")
        guarded.motion._motion.status = status
        return status()

    guarded.motion._motion.status = stopped_meanwhile
    with pytest.raises(SafetyStop, match="told to stop"):
        motion.wait_until_idle(30.0)


@pytest.mark.parametrize("call", [lambda motion: motion.status(), lambda motion: motion.wait_until_idle(1.0)],
                         ids=["status", "wait_until_idle"])  # fmt: skip
def test_a_foreign_stop_that_the_controller_calls_idle_is_told_as_a_stop(guarded: Guarded, call) -> None:
    """A g2core board is idle after the script, with nothing latched."""
    guarded.motion.home()
    status = guarded.motion._motion.status

    def stopped_meanwhile():
        guarded.motion._motion.status = status
        guarded.stop()
        return status()

    guarded.motion._motion.status = stopped_meanwhile
    with pytest.raises(SafetyStop, match="told to stop"):
        call(guarded.motion)


def test_the_reason_is_told_as_often_as_it_is_asked_for_and_after_the_end(guarded: Guarded) -> None:
    guarded.stop()
    for _ in range(2):
        with pytest.raises(SafetyStop, match="told to stop"):
            guarded.motion.status()
    guarded.guard.close()
    assert guarded.guard.stopped() == "it has stopped the motion: told to stop"


def test_one_that_is_told_to_stop_and_then_to_leave_is_heard(guarded: Guarded) -> None:
    guarded.guard.stop()
    guarded.guard.close()
    with pytest.raises(SafetyStop, match="told to stop"):
        guarded.motion.require_unstopped()


def test_one_that_left_in_peace_has_stopped_nothing(guarded: Guarded) -> None:
    guarded.guard.close()
    guarded.motion.require_unstopped()


def test_a_fault_of_the_controller_stays_one(guarded: Guarded) -> None:
    motion = guarded.motion
    motion.home()
    motion.halt()
    with pytest.raises(DeviceFaultError, match="halt"):
        motion.start_move(PARK_MM, feed_mm_per_s=1.0)


def test_a_supervisor_that_was_killed_is_missed(guarded: Guarded) -> None:
    os.kill(guarded.guard.process_id, 9)
    guarded.guard._process.wait()
    with pytest.raises(SafetyStop, match="its process has ended"):
        guarded.motion.status()
