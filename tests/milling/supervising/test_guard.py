"""The supervisor as a process of its own, and the near end of it."""

import os
import pty
import threading
import tty
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from watched import CRY, SCRIPT, stopped, written

from drivers.clock import SystemClock
from drivers.errors import DeviceError
from drivers.motion.interface import StopPath
from drivers.spindle.interface import AlarmPath
from milling.guard import Guard


@pytest.fixture
def guard(wire) -> Iterator[Guard]:
    with Guard(StopPath(wire[0], SCRIPT), SystemClock(), silence_s=30.0) as started:
        yield started


@dataclass
class Drive:
    """What a spindle driver gives a supervisor, on a wire of its own."""

    path: AlarmPath
    far: int
    through: list[int]


@pytest.fixture
def drive() -> Iterator[Drive]:
    far, near = pty.openpty()
    tty.setraw(near)
    through: list[int] = []
    yield Drive(AlarmPath(near, CRY, lambda found: f"the drive says {found!r}", through.append), far, through)
    for end in (far, near, *through):
        os.close(end)


def test_a_guard_that_is_closed_leaves_the_machine_alone(wire) -> None:
    near, far = wire
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=30.0) as started:
        started.arm()
        started.beat()
    started.close()
    assert written(far) == b""


def test_a_guard_stops_when_asked_from_another_thread_and_says_so(wire, guard: Guard) -> None:
    _, far = wire
    guard.arm()
    thread = threading.Thread(target=guard.stop)
    thread.start()
    thread.join()
    assert stopped(far)
    guard._process.wait(5.0)
    with pytest.raises(DeviceError, match="it has stopped the motion: told to stop"):
        guard.disarm()


def test_a_supervisor_that_was_killed_is_missed_at_the_next_beat(wire, guard: Guard) -> None:
    _, far = wire
    guard.arm()
    guard._process.kill()
    guard._process.wait(5.0)
    with pytest.raises(DeviceError, match="its process has ended"):
        guard.beat()
    assert written(far) == b""


def test_the_death_of_who_mills_stops_the_motion(wire, guard: Guard) -> None:
    _, far = wire
    guard.arm()
    nothing, _ = ends = os.pipe()
    os.dup2(nothing, guard._to)
    assert stopped(far)
    for end in ends:
        os.close(end)


def test_a_frozen_process_is_stopped_within_its_silence(wire) -> None:
    near, far = wire
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=0.05) as started:
        started.arm()
        assert stopped(far)
        started._process.wait(5.0)
        with pytest.raises(DeviceError, match="no sign of life"):
            started.beat()


def test_an_alarm_of_a_drive_stops_the_motion_in_words(wire, drive: Drive) -> None:
    near, far = wire
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=30.0, alarm=drive.path) as started:
        started.arm()
        os.write(drive.far, b"t701105\r")
        assert os.read(drive.through[0], 64) == b"t701105\r"
        os.write(drive.far, b"t0811023\r")
        assert stopped(far)
        with pytest.raises(DeviceError, match=r"it has stopped the motion: the drive says b'.rt0811023"):
            started.beat()
        assert os.read(drive.through[0], 64) == b"t0811023\r"
    assert os.read(drive.through[0], 64) == b""


def test_other_reasons_are_told_as_they_are_where_a_drive_may_cry_out(wire, drive: Drive) -> None:
    near, far = wire
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=30.0, alarm=drive.path) as started:
        started.stop()
        assert stopped(far)
        with pytest.raises(DeviceError, match="it has stopped the motion: told to stop"):
            started.disarm()
