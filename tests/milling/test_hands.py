"""How hands make a machine safe, on a bench with its real drivers on in-process wires."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from drivers.errors import DeviceError, OutOfTravelError
from drivers.recorder import NullRecorder
from firmware_sim.bench import Bench
from firmware_sim.clock import SimClock
from firmware_sim.faults import parse_fault
from firmware_sim.specimen import draw_specimen
from milling.hands import RETRACT_MM, Hands
from milling.latch import Latch, Reaction
from studies.virtual_runs import SIZE_PX, opened

ABOVE_MM = (0.0, 0.0, 8.0)
RPM = 45_000.0


def dark(_time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Nobody looks here."""
    picture = np.zeros((SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    return picture, picture


@dataclass
class At:
    """Hands over a bench, the drill turning in the air."""

    hands: Hands
    bench: Bench
    clock: SimClock


@pytest.fixture
def at() -> Iterator[At]:
    bench, clock = Bench(draw_specimen(900)), SimClock()
    with opened(bench, clock, render=dark) as rig:
        hands = Hands(rig.motion, rig.spindle, clock, NullRecorder(), lambda: False)
        rig.motion.home()
        hands.go_high(ABOVE_MM, ABOVE_MM[2])
        hands.start_spindle(RPM)
        yield At(hands, bench, clock)


def test_a_retract_lifts_first_and_then_stops_the_drill(at: At) -> None:
    began_s, z = at.clock.now_s(), at.bench.machine.tip_mm[2]
    latch = at.hands.make_safe(Latch(Reaction.RETRACT, "for a test"))
    assert latch.reaction is Reaction.RETRACT
    assert at.bench.machine.tip_mm[2] == pytest.approx(z + RETRACT_MM, abs=0.02)
    assert abs(at.bench.machine.spindle_rpm) < 100.0
    assert at.clock.now_s() - began_s < 2.0


def test_who_falls_silent_on_a_long_way_leaves_a_tip_that_runs_for_a_moment(at: At) -> None:
    class Silent(BaseException):
        """Nobody speaks any more."""

    far_s = at.clock.now_s() + 0.4

    def leave() -> bool:
        if at.clock.now_s() > far_s:
            raise Silent
        return False

    at.hands.stop_requested = leave
    x, y, z = ABOVE_MM
    with pytest.raises(Silent):
        at.hands.go_high((x + 12.0, y, z), z)
    left_at = at.bench.machine.tip_mm[0]
    assert left_at > x + 3.0
    assert at.bench.machine.velocity_mm_s[0] > 10.0
    at.clock.sleep_s(0.2)
    assert at.bench.machine.velocity_mm_s[0] == 0.0
    assert at.bench.machine.tip_mm[0] - left_at < 2.5


def test_a_long_way_is_one_straight_line_at_full_speed(at: At) -> None:
    began_s = at.clock.now_s()
    x, y, z = ABOVE_MM
    status = at.hands.travel((x + 12.0, y + 3.0, z), 15.0)
    assert status.position_mm == pytest.approx((x + 12.0, y + 3.0, z), abs=0.002)
    assert at.clock.now_s() - began_s < 12.4 / 15.0 + 0.25


def test_a_long_way_out_of_the_travel_is_refused_before_it_begins(at: At) -> None:
    before = at.bench.machine.tip_mm
    with pytest.raises(OutOfTravelError, match="nothing was sent"):
        at.hands.travel((-30.0, 0.0, 8.0), 15.0)
    at.clock.sleep_s(0.3)
    assert list(at.bench.machine.tip_mm) == list(before)


def test_the_drill_may_stop_a_millimetre_up_and_no_earlier(at: At, monkeypatch: pytest.MonkeyPatch) -> None:
    z, stopped_at = at.bench.machine.tip_mm[2], []
    stop = at.hands.spindle.stop

    def noted() -> None:
        stopped_at.append(at.bench.machine.tip_mm[2] - z)
        stop()

    monkeypatch.setattr(at.hands.spindle, "stop", noted)
    at.hands.make_safe(Latch(Reaction.RETRACT, "for a test"))
    assert 1.0 <= stopped_at[0] < RETRACT_MM - 0.1


def test_a_drill_that_does_not_obey_is_told_within_two_seconds_and_not_waited_for(at: At) -> None:
    at.hands.stop_spindle()
    at.bench.plant([parse_fault("spindle.starts_by_itself")])
    at.clock.sleep_s(1.0)
    began_s = at.clock.now_s()
    latch = at.hands.make_safe(Latch(Reaction.RETRACT, "for a test"))
    assert latch.reaction is Reaction.KILL
    assert at.clock.now_s() - began_s < 2.0
    with pytest.raises(DeviceError, match=r"told to stop 0\.5 s ago and still at \d+ rpm; use the emergency stop"):
        at.hands.stop_spindle()


@dataclass
class Fired:
    """A supervisor that has stopped the motion, and says so when it is done."""

    bench: Bench
    clock: SimClock
    order: list[str] = field(default_factory=list)

    def beat(self) -> None:
        raise DeviceError("supervisor: it has stopped the motion: the drive's emergency")

    def stopped(self) -> str:
        self.clock.sleep_s(0.3)
        self.order.append(f"done at z = {self.bench.machine.tip_mm[2]:.2f}")
        return "the drive's emergency"

    def arm(self) -> None:
        self.order.append("armed")

    def disarm(self) -> None:
        self.order.append("disarmed")


def test_a_retract_waits_for_a_supervisor_that_is_at_it_and_asks_it_nothing_more(at: At) -> None:
    z = at.bench.machine.tip_mm[2]
    guard = Fired(at.bench, at.clock)
    at.hands.into_the_bone()
    at.hands.guard = guard
    latch = at.hands.make_safe(Latch(Reaction.RETRACT, "for a test"))
    assert latch.reaction is Reaction.RETRACT
    assert guard.order == [f"done at z = {z:.2f}"]
    assert at.bench.machine.tip_mm[2] == pytest.approx(z + RETRACT_MM, abs=0.02)


def test_a_kill_waits_for_nobody(at: At, monkeypatch: pytest.MonkeyPatch) -> None:
    guard = Fired(at.bench, at.clock)
    at.hands.guard = guard
    stop, halt = at.hands.spindle.stop, at.hands.motion.halt
    monkeypatch.setattr(at.hands.spindle, "stop", lambda: (guard.order.append("drill off"), stop()))
    monkeypatch.setattr(at.hands.motion, "halt", lambda: (guard.order.append("halt"), halt()))
    at.hands.make_safe(Latch(Reaction.KILL, "for a test"))
    assert guard.order == ["drill off", "halt", "disarmed"]
    assert abs(at.bench.machine.spindle_rpm) < 100.0


def test_a_drive_that_is_lost_does_not_keep_the_drill_in_the_bone(at: At) -> None:
    z = at.bench.machine.tip_mm[2]
    at.bench.plant([parse_fault("can.bus_off")])
    latch = at.hands.make_safe(Latch(Reaction.RETRACT, "for a test"))
    assert latch.reaction is Reaction.KILL, "nobody saw the drill stand"
    at.clock.sleep_s(1.0)
    assert at.bench.machine.tip_mm[2] == pytest.approx(z + RETRACT_MM, abs=0.02)
    assert abs(at.bench.machine.spindle_rpm) < 100.0, "the drive misses its host"


class Told(NullRecorder):
    """Keeps how long silences were."""

    def __init__(self) -> None:
        self.silent_s: list[float] = []

    def event(self, kind: str, **fields: object) -> None:
        if kind == "late":
            self.silent_s.append(float(str(fields["silent_s"])))


def test_long_silences_are_told_in_the_bone_where_somebody_counts_on_signs_of_life(at: At) -> None:
    told = at.hands.recorder = Told()
    for silence_s in (0.1, 0.07, 0.03):
        at.clock.sleep_s(silence_s)
        at.hands.beat()
    assert told.silent_s == [], "in the air this process may take its time"
    at.clock.sleep_s(0.1)
    at.hands.into_the_bone()
    for silence_s in (0.03, 0.07, 0.03):
        at.clock.sleep_s(silence_s)
        at.hands.beat()
    assert told.silent_s == [pytest.approx(0.07, abs=0.01)]


class Full(NullRecorder):
    """A disk that takes nothing."""

    def event(self, kind: str, **fields: object) -> None:
        raise OSError(28, "No space left on device")


@pytest.mark.parametrize("reaction", [Reaction.HOLD, Reaction.RETRACT, Reaction.KILL])
def test_a_full_disk_holds_nothing_up(at: At, reaction: Reaction) -> None:
    z = at.bench.machine.tip_mm[2]
    at.hands.recorder = Full()
    assert at.hands.make_safe(Latch(reaction, "for a test")).reaction is reaction
    assert abs(at.bench.machine.spindle_rpm) < 100.0
    if reaction is not Reaction.KILL:
        assert at.bench.machine.tip_mm[2] >= z + RETRACT_MM - 0.02
