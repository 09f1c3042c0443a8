"""Every rule of a point and of the ledger at its very edge, with an estimate that says what it is told to say."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest

from drivers.errors import SafetyStop
from milling.limits import Limits
from milling.permission import Ledger
from milling.point import ROUNDING_MM, Point, PointState

LIMITS = Limits()
BITE_MM = 0.01


@dataclass
class Said:
    """An estimate: T lies below ``surely_mm`` for certain, below ``maybe_mm`` with probability ``maybe``."""

    surely_mm: float = 9.0
    maybe_mm: float = 9.0
    maybe: float = 0.0
    weighed_at: list[tuple[int, float, float, float]] = field(default_factory=list)
    pictured_at: list[tuple[int, float, float]] = field(default_factory=list)
    forgotten: list[int] = field(default_factory=list)
    recalled: list[tuple[int, dict[str, Any]]] = field(default_factory=list)

    def weighed(self, index: int, depth_mm: float, ratio: float, *, beside_mm: float) -> None:
        self.weighed_at.append((index, depth_mm, ratio, beside_mm))

    def pictured(self, index: int, depth_mm: float, completion: float) -> None:
        self.pictured_at.append((index, depth_mm, completion))

    def forget_pictures(self, index: int) -> None:
        self.forgotten.append(index)

    def pictures(self, index: int) -> dict[str, Any]:
        return {"pictures": index}

    def recall_pictures(self, index: int, kept: Mapping[str, Any]) -> None:
        self.recalled.append((index, dict(kept)))

    def through(self, index: int, depth_mm: float) -> float:
        if depth_mm >= self.surely_mm:
            return 1.0
        return self.maybe if depth_mm >= self.maybe_mm else 0.0


def bone(cut_mm: float = 0.1, **known: Any) -> Point:
    """A point with good evidence of bone: seen at 1 s after its pass at 0 s."""
    point = Point(LIMITS)
    point.touched()
    point.cut_mm, point.last_pass_s = cut_mm, 0.0
    point.seen_at_s, point.upper, point.completion = 1.0, 0.3, 0.2
    for name, value in known.items():
        setattr(point, name, value)
    return point


def judge(point: Point, bite_mm: float = BITE_MM, **how: float) -> tuple[float, str]:
    told = {"now_s": 1.05, "frame_at_s": 1.0, "deepest_mm": 9.0, "said_mm": LIMITS.said_mm} | how
    grant = point.judge(
        bite_mm, told["now_s"], told["frame_at_s"], deepest_mm=told["deepest_mm"], said_mm=told["said_mm"]
    )
    assert grant.deeper == (grant.depth_mm > point.cut_mm)
    return grant.depth_mm, grant.reason


def ring(n: int = 4, said: Said | None = None, *, cut_mm: float = 0.1) -> tuple[Ledger, Said]:
    """A ring of bone that was seen, all of it at one depth."""
    said = said or Said()
    ledger = Ledger(n, LIMITS, said)
    for index in range(n):
        ledger.touched(index)
        ledger.recall(index, depth_mm=cut_mm)
        ledger.passed(index, depth_mm=cut_mm, now_s=0.0)
        ledger.points[index].unheard_mm = 0.0
        ledger.seen(index, completion=0.2, upper=0.3, exposed_at_s=1.0)
    return ledger, said


# A point's verdict.


def test_bone_gets_the_bite_that_was_asked_for() -> None:
    assert judge(bone()) == (pytest.approx(0.11), "bone")


@pytest.mark.parametrize(
    ("known", "how", "why"),
    [
        ({"contacted": False}, {}, "no contact yet"),
        ({"state": PointState.STOPPED, "why": "as told"}, {}, "as told"),
        ({"state": PointState.DONE, "why": "through"}, {}, "through"),
        ({}, {"bite_mm": 0.0}, "no bite asked"),
        ({}, {"bite_mm": ROUNDING_MM}, "no bite asked"),
        ({}, {"bite_mm": float("nan")}, "no bite asked"),
        ({}, {"frame_at_s": 0.949}, "no fresh frame"),
        ({}, {"frame_at_s": 1.051}, "no fresh frame"),
        ({}, {"now_s": float("nan")}, "no fresh frame"),
        ({"upper": None}, {}, "not seen since its last pass"),
        ({"last_pass_s": 1.0}, {}, "not seen since its last pass"),
        ({"load_above_idle": False}, {}, "no load at the last pass"),
        ({}, {"deepest_mm": 0.1099}, "waits for its neighbours"),
    ],
)
def test_what_is_missing_is_named_and_goes_no_deeper(known: dict[str, Any], how: dict[str, float], why: str) -> None:
    point = bone(**known)
    bite_mm = how.pop("bite_mm", BITE_MM)
    assert judge(point, bite_mm, **how) == (0.1, why)


def test_the_edges_of_fresh_and_of_neighbours_are_inside() -> None:
    assert judge(bone(), now_s=LIMITS.frame_age_s, frame_at_s=0.0)[1] == "bone"
    assert judge(bone(), now_s=1.0, frame_at_s=1.0)[1] == "bone"
    assert judge(bone(), deepest_mm=0.1 + BITE_MM)[1] == "bone"
    assert judge(bone(last_pass_s=0.999))[1] == "bone"


@pytest.mark.parametrize(
    ("cut_mm", "known", "why"),
    [
        (0.591, {}, "the high end of the thickness prior is reached"),
        (0.245, {"unheard_mm": 0.031}, "it may be through, and its load is not known"),
        (0.116, {"unheard_mm": 0.031, "upper": 0.995}, "it may be through, and its load is not known"),
        (0.2, {"lost_mm": 0.189}, "the load is lost"),
        (0.2, {"said_mm": 0.149}, "the picture has said through for too long"),
    ],
)
def test_a_limit_stops_the_point_until_a_look(cut_mm: float, known: dict[str, Any], why: str) -> None:
    point = bone(cut_mm, **known)
    assert judge(point) == (cut_mm, why)
    assert (point.state, point.why, point.resting) == (PointState.STOPPED, why, False)


@pytest.mark.parametrize(
    ("cut_mm", "known"),
    [
        (0.59, {}),
        (0.24, {"unheard_mm": 0.2}),
        (0.245, {"unheard_mm": 0.03}),
        (0.114, {"unheard_mm": 0.2, "upper": 0.995}),
        (0.2, {"unheard_mm": 0.2, "upper": 0.994}),
        (0.2, {"lost_mm": 0.19}),
        (0.2, {"said_mm": 0.15}),
    ],
)
def test_up_to_the_limit_there_is_bone(cut_mm: float, known: dict[str, Any]) -> None:
    assert judge(bone(cut_mm, **known)) == (pytest.approx(cut_mm + BITE_MM), "bone")


@pytest.mark.parametrize(
    ("cut_mm", "upper", "bite_mm"),
    [
        (0.05, 0.3, LIMITS.bite_mm),
        (0.0999, 0.3, LIMITS.bite_mm),
        (0.1001, 0.3, LIMITS.late_bite_mm),
        (0.05, 0.6, LIMITS.bite_mm),
        (0.05, 0.601, LIMITS.late_bite_mm),
        (0.05, None, LIMITS.bite_mm),
    ],
)
def test_the_bite_is_small_once_little_may_be_left(cut_mm: float, upper: float | None, bite_mm: float) -> None:
    assert bone(cut_mm, upper=upper).next_mm(1.0) == pytest.approx(cut_mm + bite_mm)


# What a point is told.


@pytest.mark.parametrize(
    ("completion", "upper", "exposed_at_s"),
    [(-0.1, 0.5, 2.0), (1.1, 1.1, 2.0), (0.5, 0.4, 2.0), (0.5, 1.1, 2.0), (0.5, 0.6, 1.0), (float("nan"), 0.5, 2.0)],
)
def test_pictures_of_no_world_and_old_ones_are_ignored(completion: float, upper: float, exposed_at_s: float) -> None:
    point = bone()
    assert not point.seen(completion=completion, upper=upper, exposed_at_s=exposed_at_s)
    assert (point.completion, point.upper, point.seen_at_s) == (0.2, 0.3, 1.0)


@pytest.mark.parametrize(("completion", "upper"), [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
def test_the_edges_of_the_world_are_of_it(completion: float, upper: float) -> None:
    point = bone()
    assert point.seen(completion=completion, upper=upper, exposed_at_s=1.001)
    assert (point.completion, point.upper, point.seen_at_s) == (completion, upper, 1.001)


def test_a_touch_is_load_and_says_so() -> None:
    point = Point(LIMITS)
    assert (point.contacted, point.load_above_idle, point.why) == (False, False, "no contact yet")
    point.touched()
    assert (point.contacted, point.load_above_idle, point.why) == (True, True, "contact found")


def test_a_picture_says_through_after_some_frames_in_a_row_and_takes_it_back_as_slowly() -> None:
    point = bone(0.3)
    for k in range(LIMITS.frames):
        assert point.said_mm is None
        assert point.seen(completion=0.9, upper=LIMITS.threshold, exposed_at_s=2.0 + k)
    assert (point.said_mm, point.incredible, point.frames) == (0.3, False, 0)
    point.cut_mm = 0.31
    for k in range(LIMITS.frames):
        assert point.said_mm == 0.3
        point.seen(completion=0.89, upper=0.9, exposed_at_s=12.0 + k)
    assert (point.said_mm, point.frames) == (None, 0)


def test_one_frame_that_differs_begins_the_count_anew() -> None:
    point = bone(0.3)
    for k, upper in enumerate([0.995, 0.995, 0.994, 0.995, 0.995]):
        point.seen(completion=0.9, upper=upper, exposed_at_s=2.0 + k)
    assert (point.said_mm, point.frames) == (None, 2)
    point.seen(completion=0.9, upper=0.995, exposed_at_s=9.0)
    for k, completion in enumerate([0.5, 0.5, 0.9, 0.5]):
        point.seen(completion=completion, upper=0.95, exposed_at_s=10.0 + k)
    assert (point.said_mm, point.frames) == (0.3, 1)


@pytest.mark.parametrize(("cut_mm", "incredible"), [(0.199, True), (0.2, False)])
def test_a_hole_where_no_skull_is_thin_enough_is_not_believed(cut_mm: float, incredible: bool) -> None:
    point = bone(cut_mm)
    for k in range(LIMITS.frames):
        point.seen(completion=1.0, upper=1.0, exposed_at_s=2.0 + k)
    assert (point.said_mm, point.incredible) == (LIMITS.thickness_low_mm, incredible)
    for k in range(LIMITS.frames):
        point.seen(completion=0.5, upper=0.6, exposed_at_s=12.0 + k)
    assert (point.said_mm, point.incredible) == (None, False)


def test_two_lost_loads_in_a_row_lose_it_and_two_whole_ones_find_it() -> None:
    point = bone(0.3)
    point.felt(ratio=0.59, above_idle=True)
    assert point.lost_mm is None, "the one before counts as whole"
    point.cut_mm = 0.31
    point.felt(ratio=0.6, above_idle=True)
    assert point.lost_mm is None
    point.felt(ratio=0.59, above_idle=True)
    point.felt(ratio=0.59, above_idle=True)
    assert point.lost_mm == 0.31
    point.cut_mm = 0.32
    point.felt(ratio=0.5, above_idle=True)
    assert point.lost_mm == 0.31, "where it was lost first"
    point.felt(ratio=0.9, above_idle=True)
    assert point.lost_mm == 0.31
    point.felt(ratio=0.89, above_idle=True)
    point.felt(ratio=0.9, above_idle=True)
    assert point.lost_mm == 0.31
    point.felt(ratio=0.9, above_idle=True)
    assert point.lost_mm is None


def test_a_droop_agrees_only_under_a_picture_that_says_through() -> None:
    point = bone(0.3)
    point.felt(ratio=0.84, above_idle=True)
    assert not point.agreed
    point.said_mm = 0.3
    point.felt(ratio=0.85, above_idle=True)
    assert not point.agreed
    point.felt(ratio=0.84, above_idle=True)
    point.felt(ratio=1.0, above_idle=True)
    assert point.agreed, "for good"


def test_a_pass_without_load_stops_the_point_below_where_contact_vouches() -> None:
    shallow, deep = bone(LIMITS.entry_mm), bone(LIMITS.entry_mm + 1e-4)
    for point in (shallow, deep):
        point.felt(ratio=None, above_idle=False)
    assert (shallow.state, shallow.load_above_idle) == (PointState.OPEN, True)
    assert (deep.state, deep.why) == (PointState.STOPPED, "no load at the last pass")
    heard = bone(0.3, unheard_mm=0.02)
    heard.felt(ratio=None, above_idle=True)
    assert (heard.unheard_mm, heard.load_ratio) == (0.02, None)
    heard.felt(ratio=0.95, above_idle=True)
    assert (heard.unheard_mm, heard.load_ratio) == (0.0, 0.95)


def test_a_pass_ends_the_permission_and_deeper_than_permitted_is_a_stop() -> None:
    point = bone(granted_mm=0.12)
    point.passed(depth_mm=0.115, now_s=3.0)
    assert (point.cut_mm, point.granted_mm, point.last_pass_s) == (0.115, None, 3.0)
    assert point.unheard_mm == pytest.approx(0.015)
    point.passed(depth_mm=0.115 + ROUNDING_MM, now_s=4.0)
    point.passed(depth_mm=0.05, now_s=5.0)
    assert (point.cut_mm, point.unheard_mm) == (pytest.approx(0.115, abs=2e-6), pytest.approx(0.015, abs=2e-6))
    with pytest.raises(SafetyStop, match=r"cut to 0\.1200 mm .* permitted were 0\.1150 mm"):
        point.passed(depth_mm=0.12, now_s=6.0)


# A point's states.


def test_what_is_done_stays_done() -> None:
    point = bone()
    point.finish("through")
    for act in (lambda: point.stop("no"), lambda: point.rest("no"), point.wake):
        act()
        assert (point.state, point.why, point.resting) == (PointState.DONE, "through", False)


def test_a_resting_point_wakes_and_a_stopped_one_does_not() -> None:
    point = bone()
    point.rest("maybe")
    assert (point.state, point.why, point.resting) == (PointState.STOPPED, "maybe", True)
    point.rest("still")
    assert point.why == "still"
    point.wake()
    assert (point.state, point.why, point.resting) == (PointState.OPEN, "bone is left, as far as is known", False)
    point.stop("limit")
    point.rest("maybe")
    point.wake()
    assert (point.state, point.why, point.resting) == (PointState.STOPPED, "limit", False)


@pytest.mark.parametrize(
    ("upper", "left", "unheard_mm"),
    [(0.994, 0.5, 0.0), (0.995, 0.5, 0.05), (0.995, 0.51, 0.0), (None, 0.5, 0.05), (None, 0.51, 0.0)],
)
def test_a_look_gives_back_what_was_unheard_where_bone_is_likely(
    upper: float | None, left: float, unheard_mm: float
) -> None:
    point = bone(upper=upper, left_probability=left, unheard_mm=0.05, load_above_idle=False)
    point.stop("limit")
    point.reopen()
    assert (point.unheard_mm, point.load_above_idle, point.resting) == (unheard_mm, True, False)
    assert (point.state, point.why, point.looks) == (PointState.OPEN, "re-opened after a look", 1)
    point.reopen()
    assert point.looks == 1, "a look that followed no bite told nothing new"
    point.cut_mm += 0.01
    point.reopen()
    assert point.looks == 2


def test_a_snapshot_brings_back_all_but_the_depth() -> None:
    point = bone(0.3, said_mm=0.28, agreed=True, looks=2, unheard_mm=0.01)
    point.rest("maybe")
    other = Point(LIMITS)
    other.restore(point.snapshot())
    assert other.snapshot() == point.snapshot()
    assert (other.state, other.resting, other.cut_mm) == (PointState.STOPPED, True, 0.0)


# The ring.


def test_a_ring_grants_counts_and_keeps_to_one_bite_a_visit() -> None:
    ledger, _ = ring()
    first = ledger.ask(1, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0)
    assert ledger.points[1].verdicts == {"bite": 1}
    again = ledger.ask(1, bite_mm=BITE_MM, now_s=1.06, frame_at_s=1.0)
    assert (first.depth_mm, again.depth_mm) == (pytest.approx(0.11), pytest.approx(0.11))
    assert ledger.points[1].verdicts == {"bite": 1}
    late = ledger.ask(1, bite_mm=BITE_MM, now_s=1.2, frame_at_s=1.0)
    assert (late.deeper, ledger.points[1].verdicts) == (False, {"bite": 1})
    ledger.void(1)
    ledger.ask(1, bite_mm=BITE_MM, now_s=1.2, frame_at_s=1.0)
    assert ledger.points[1].verdicts == {"bite": 1, "no fresh frame": 1}
    with pytest.raises(SafetyStop, match="point 2: cut to"):
        ledger.passed(1, depth_mm=0.11, now_s=1.3)


@pytest.mark.parametrize("beside", [(1, 3), (3, 1)])
def test_no_point_leads_its_shallower_neighbour_by_more_than_is_allowed(beside: tuple[int, int]) -> None:
    ledger, _ = ring()
    ledger.recall(0, depth_mm=0.1 + LIMITS.neighbour_mm - 0.005)
    ledger.points[0].unheard_mm = 0.0
    grant = ledger.ask(0, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0)
    assert (grant.deeper, grant.reason) == (False, "waits for its neighbours")
    for index in beside:
        assert not ledger.ask(0, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0).deeper
        ledger.recall(index, depth_mm=0.2)
    assert ledger.ask(0, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0).deeper


def test_a_bite_that_may_lead_too_deep_is_not_given_and_the_point_rests_until_more_is_known() -> None:
    ledger, said = ring()
    ledger.ask(0, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0)
    said.maybe_mm, said.maybe = 0.1 + BITE_MM - LIMITS.past_mm - 1e-6, LIMITS.past_risk + 0.001
    grant = ledger.ask(1, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0)
    assert (grant.deeper, grant.reason) == (False, "the bite may lead too deep")
    ledger.seen(1, completion=0.2, upper=0.3, exposed_at_s=1.5)
    assert (ledger.points[1].state, ledger.points[1].resting) == (PointState.STOPPED, True)
    assert ledger.points[1].why.startswith("may be through")
    assert ledger.ask(1, bite_mm=BITE_MM, now_s=1.9, frame_at_s=1.0).reason == ledger.points[1].why
    said.maybe = LIMITS.past_risk
    ledger.seen(1, completion=0.2, upper=0.3, exposed_at_s=1.6)
    assert ledger.ask(1, bite_mm=BITE_MM, now_s=1.65, frame_at_s=1.6).deeper


def test_a_point_that_is_probably_through_rests_and_is_finished_at_a_look_if_its_load_was_known() -> None:
    ledger, said = ring()
    said.maybe_mm, said.maybe = 0.0, 1.0 - LIMITS.left_risk + 0.001
    ledger.seen(2, completion=0.9, upper=0.95, exposed_at_s=2.0)
    point = ledger.points[2]
    assert (point.state, point.why, point.resting) == (PointState.STOPPED, "probably through", True)
    assert point.left_probability == pytest.approx(LIMITS.left_risk - 0.001)
    assert ledger.look(2) is PointState.STOPPED, "nothing is finished without any load"
    ledger.felt(2, ratio=0.7, above_idle=True)
    assert ledger.look(2) is PointState.DONE
    assert ledger.look(2) is PointState.DONE
    assert ledger.points[2].why.startswith("through, by load, pictures and neighbours: 97.1 %")
    assert ledger.open_points == []
    assert not ledger.done
    assert ledger.through_share == pytest.approx(1 - LIMITS.left_risk + 0.001)


def test_exactly_at_the_risk_a_point_is_not_through() -> None:
    ledger, said = ring()
    said.maybe_mm, said.maybe = 0.1 + LIMITS.left_mm, 1.0 - LIMITS.left_risk
    ledger.felt(2, ratio=0.9, above_idle=True)
    assert ledger.points[2].left_probability == pytest.approx(LIMITS.left_risk)
    assert ledger.look(2) is PointState.OPEN


def test_looks_reopen_a_stopped_point_until_there_have_been_enough() -> None:
    ledger, _ = ring()
    point = ledger.points[1]
    for look in range(LIMITS.looks):
        ledger.recall(1, depth_mm=0.1 + 0.001 * (look + 1))
        point.stop("limit")
        assert ledger.look(1) is PointState.OPEN
    ledger.recall(1, depth_mm=0.11)
    point.stop("limit")
    assert ledger.look(1) is PointState.STOPPED
    assert point.why == "the cues disagree after every look"
    assert ledger.look(0) is PointState.OPEN, "what is open needs no look"
    assert ledger.points[0].looks == 0


def test_a_stall_stops_the_open_points_and_says_what_they_waited_for() -> None:
    ledger, _ = ring()
    ledger.ask(0, bite_mm=BITE_MM, now_s=1.2, frame_at_s=1.0)
    ledger.ask(0, bite_mm=0.0, now_s=1.05, frame_at_s=1.0)
    ledger.ask(1, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0)
    ledger.points[2].finish("through")
    ledger.stall()
    assert [point.why for point in ledger.points] == [
        "got no bite (no bite asked)", "got no bite (nothing asked)", "through", "got no bite (nothing asked)",
    ]  # fmt: skip
    assert ledger.open_points == []
    for point in ledger.points:
        point.finish("through")
    assert ledger.done


def test_the_estimate_hears_what_counts() -> None:
    ledger, said = ring(cut_mm=0.21)
    said.pictured_at.clear()
    ledger.points[1].cut_mm, ledger.points[-1].cut_mm = 0.2, 0.16
    ledger.felt(0, ratio=0.9, above_idle=True)
    ledger.felt(0, ratio=None, above_idle=True)
    ledger.seen(0, completion=0.5, upper=0.6, exposed_at_s=2.0)
    ledger.seen(0, completion=0.5, upper=0.6, exposed_at_s=2.0)
    assert (said.weighed_at, said.pictured_at) == ([(0, 0.21, 0.9, pytest.approx(0.18))], [(0, 0.21, 0.5)])
    ledger.recall(0, depth_mm=0.2, ratio=0.8)
    assert ledger.cut_mm(0) == 0.21, "what was cut stays cut"
    assert said.weighed_at[-1] == (0, 0.21, 0.8, pytest.approx(0.18))
    assert ledger.completion(0) == 0.5


def test_pictures_of_a_hole_that_cannot_be_are_forgotten_and_those_of_untouched_bone_tell_nothing() -> None:
    ledger, said = ring(cut_mm=0.1)
    said.pictured_at.clear()
    for k in range(LIMITS.frames):
        ledger.seen(0, completion=1.0, upper=1.0, exposed_at_s=2.0 + k)
    assert said.forgotten == [0]
    assert len(said.pictured_at) == LIMITS.frames - 1
    said.maybe_mm, said.maybe = 0.0, 0.5
    fresh = Ledger(3, LIMITS, said)
    said.pictured_at.clear()
    fresh.seen(0, completion=0.1, upper=0.2, exposed_at_s=1.0)
    assert said.pictured_at == []
    fresh.felt(0, ratio=1.0, above_idle=True)
    assert fresh.points[0].left_probability == 1.0


def test_snapshots_hold_the_pictures_too() -> None:
    ledger, said = ring()
    kept = ledger.snapshot(3)
    assert kept["pictures"] == 3
    ledger.restore(0, kept | {"why": "as kept"})
    assert said.recalled == [(0, kept | {"why": "as kept"})]
    assert ledger.points[0].why in {"as kept", "bone is left, as far as is known"}


def test_a_load_that_drooped_at_enough_points_leads_on_farther_under_a_picture_that_says_through() -> None:
    ledger, _ = ring(8, cut_mm=0.4)
    for index in range(8):
        ledger.felt(index, ratio=0.95, above_idle=True)
        ledger.points[index].said_mm = 0.3
    assert not ledger.ask(5, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0).deeper
    ledger.points[0].agreed = True
    assert not ledger.ask(6, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0).deeper
    ledger.points[1].agreed = True
    assert ledger.ask(7, bite_mm=BITE_MM, now_s=1.05, frame_at_s=1.0).deeper


def test_what_an_earlier_run_cut_is_unheard_and_only_what_it_cut() -> None:
    ledger, _ = ring()
    ledger.recall(0, depth_mm=0.13)
    assert ledger.points[0].unheard_mm == pytest.approx(0.03)
    ledger.recall(0, depth_mm=0.12)
    assert (ledger.cut_mm(0), ledger.points[0].unheard_mm) == (0.13, pytest.approx(0.03))


@pytest.mark.parametrize("news", ["felt", "recalled", "passed", "restored", "seen"])
def test_every_piece_of_news_is_weighed_before_the_next_question(news: str) -> None:
    ledger, said = ring()
    assert ledger.points[1].left_probability == 1.0
    kept = ledger.snapshot(1)
    said.maybe_mm, said.maybe = 0.0, 0.4
    assert ledger.points[1].left_probability == 1.0, "no news, no new estimate"
    match news:
        case "felt":
            ledger.felt(0, ratio=1.0, above_idle=True)
        case "recalled":
            ledger.recall(0, depth_mm=0.1)
        case "passed":
            ledger.passed(0, depth_mm=0.1, now_s=2.0)
        case "restored":
            ledger.restore(0, kept)
        case _:
            ledger.seen(0, completion=0.2, upper=0.3, exposed_at_s=2.0)
    assert ledger.points[1].left_probability == pytest.approx(0.6)


@pytest.mark.parametrize(("maybe_mm", "share"), [(0.129, 0.25), (0.131, 1.0)])
def test_what_may_hold_the_flap_is_bone_thicker_than_the_published_criterion(maybe_mm: float, share: float) -> None:
    ledger, _ = ring(4, Said(maybe_mm=maybe_mm, maybe=0.75), cut_mm=0.1)
    assert ledger.bridge_share == pytest.approx(share)
