"""A disk that is full, or slow, and the recorder behind it."""

import errno
from typing import Any

import numpy as np
import pytest

from firmware_sim.clock import SimClock
from firmware_sim.faults import parse_faults
from firmware_sim.faulty_disk import FaultyDisk


class Kept:
    def __init__(self) -> None:
        self.kinds: list[str] = []

    def event(self, kind: str, **fields: Any) -> None:
        self.kinds.append(kind)

    def frame(self, name: str, image: np.ndarray) -> None:
        self.kinds.append(name)


def disk(*faults: str) -> tuple[FaultyDisk, Kept, SimClock]:
    kept, clock = Kept(), SimClock()
    return FaultyDisk(kept, parse_faults(faults), clock), kept, clock


def test_a_full_disk_says_so_once_and_takes_nothing_more() -> None:
    faulty, kept, clock = disk("disk.full@2s")
    faulty.event("spindle", state="at speed")
    clock.sleep_s(1.9)
    faulty.event("cut")
    clock.sleep_s(0.1)
    with pytest.raises(OSError, match="No space left") as full:
        faulty.event("cut")
    assert full.value.errno == errno.ENOSPC
    faulty.event("outcome")
    assert kept.kinds == ["spindle", "cut"]


def test_before_the_drill_turns_the_time_does_not_run() -> None:
    faulty, kept, clock = disk("disk.full@2s")
    clock.sleep_s(60.0)
    faulty.event("stage")
    assert kept.kinds == ["stage"]


def test_a_slow_disk_keeps_the_program_waiting_once_a_second() -> None:
    faulty, kept, clock = disk("disk.slow=300ms")
    for _ in range(3):
        faulty.event("load")
    assert clock.now_s() == pytest.approx(0.3)
    clock.sleep_s(1.0)
    faulty.event("load")
    assert clock.now_s() == pytest.approx(1.6)
    assert kept.kinds == ["load"] * 4


def test_other_families_are_not_its_business() -> None:
    faulty, kept, clock = disk("vision.slow", "host.stop")
    faulty.event("load")
    faulty.frame("left", np.zeros((2, 2, 3), np.uint8))
    assert (kept.kinds, clock.now_s()) == (["load", "left"], 0.0)
