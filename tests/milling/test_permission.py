"""The ledger: every rule by itself, and what no sequence of evidence can ever make it do."""

import ast
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ledgers import LIMITS, PITCH_MM, dig, touched, visit

import milling.latch
import milling.limits
import milling.point
from drivers.errors import ConnectionLostError, SafetyStop
from milling.latch import Latch, Reaction, reaction_to
from milling.permission import Ledger
from milling.point import PointState
from milling.thickness import Thickness


@pytest.mark.parametrize("module", [milling.point, milling.limits, milling.latch])
def test_it_is_standard_library_only(module: ModuleType) -> None:
    tree = ast.parse(Path(module.__file__ or "").read_text())
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert imported <= {
        "collections",
        "collections.abc",
        "dataclasses",
        "enum",
        "math",
        "typing",
        "drivers.errors",
        "milling.limits",
        "milling.point",
    }


def test_all_evidence_grants_one_bite() -> None:
    ledger = touched()
    grant = ledger.ask(0, bite_mm=0.02, now_s=1.0, frame_at_s=0.95)
    assert grant.deeper
    assert grant.depth_mm == pytest.approx(0.02)


def test_asking_again_at_one_visit_adds_nothing() -> None:
    ledger = touched()
    depths = {ledger.ask(0, bite_mm=0.02, now_s=1.0 + k / 100, frame_at_s=0.99).depth_mm for k in range(9)}
    assert depths == {0.02}


def test_no_contact_no_descent() -> None:
    ledger = Ledger(8, LIMITS, Thickness(8, LIMITS, pitch_mm=PITCH_MM))
    ledger.seen(0, completion=0.0, upper=0.1, exposed_at_s=0.9)
    assert not ledger.ask(0, bite_mm=0.01, now_s=1.0, frame_at_s=0.95).deeper


@pytest.mark.parametrize(
    ("age_s", "deeper"), [(0.0, True), (0.0999, True), (0.1001, False), (3.0, False), (-0.01, False)]
)
def test_only_a_fresh_frame_permits(age_s: float, deeper: bool) -> None:
    assert touched().ask(0, bite_mm=0.01, now_s=5.0, frame_at_s=5.0 - age_s).deeper is deeper


def test_a_permission_ends_when_frames_grow_old_within_the_visit() -> None:
    ledger = touched()
    assert ledger.ask(0, bite_mm=0.02, now_s=1.0, frame_at_s=0.95).deeper
    again = ledger.ask(0, bite_mm=0.02, now_s=1.2, frame_at_s=0.95)
    assert not again.deeper
    assert again.depth_mm == 0.0


def test_a_point_must_be_seen_after_its_last_pass() -> None:
    ledger = touched()
    depth = visit(ledger, 0, 1.0)
    ledger.passed(0, depth_mm=depth, now_s=4.0)
    grant = ledger.ask(0, bite_mm=0.01, now_s=4.1, frame_at_s=4.05)
    assert not grant.deeper
    assert "not seen" in grant.reason


def test_old_pictures_and_nonsense_are_ignored() -> None:
    ledger = touched()
    for completion, upper, at_s in ((0.5, 0.4, 9.0), (float("nan"), 0.5, 9.0), (-0.1, 0.5, 9.0), (0.2, 1.1, 9.0)):
        ledger.seen(0, completion=completion, upper=upper, exposed_at_s=at_s)
    assert ledger.points[0].seen_at_s == 0.0


def test_no_load_below_the_entry_stops_whatever_the_picture_says() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, LIMITS.entry_mm + 0.005)
    ledger.felt(0, ratio=None, above_idle=False)
    assert ledger.points[0].state is PointState.STOPPED
    assert not ledger.ask(0, bite_mm=0.01, now_s=now_s, frame_at_s=now_s).deeper


def test_contact_alone_is_evidence_for_the_entry_only() -> None:
    ledger = touched()
    now_s, depths = 1.0, []
    for _ in range(8):
        grant = ledger.ask(0, bite_mm=0.013, now_s=now_s, frame_at_s=now_s)
        ledger.passed(0, depth_mm=grant.depth_mm, now_s=now_s + 0.1)
        ledger.felt(0, ratio=None, above_idle=False)
        ledger.seen(0, completion=0.0, upper=0.1, exposed_at_s=now_s + 0.2)
        depths.append(grant.depth_mm)
        now_s += 3.0
    assert max(depths) <= LIMITS.entry_mm + 0.013


def test_a_load_that_is_gone_stops_at_any_depth() -> None:
    ledger = touched()
    dig(ledger, 0, 0.15)
    ledger.felt(0, ratio=0.0, above_idle=False)
    assert ledger.points[0].state is PointState.STOPPED


def test_one_noisy_pass_stops_nothing() -> None:
    ledger = touched()
    dig(ledger, 0, 0.3)
    ledger.felt(0, ratio=0.6, above_idle=True)
    assert ledger.points[0].state is PointState.OPEN


def test_late_bites_are_small() -> None:
    ledger = touched()
    now_s, last = 1.0, 0.0
    while ledger.points[0].state is PointState.OPEN and last < 0.4:
        grant = ledger.ask(0, bite_mm=0.05, now_s=now_s, frame_at_s=now_s)
        bite = grant.depth_mm - last
        assert (
            bite
            <= (LIMITS.bite_mm if last <= LIMITS.thickness_low_mm - LIMITS.late_margin_mm else LIMITS.late_bite_mm)
            + 1e-9
        )
        ledger.passed(0, depth_mm=grant.depth_mm, now_s=now_s + 0.1)
        ledger.points[1].cut_mm = ledger.points[-1].cut_mm = grant.depth_mm
        ledger.felt(0, ratio=1.0, above_idle=True)
        ledger.seen(0, completion=0.3, upper=0.4, exposed_at_s=now_s + 0.2)
        last, now_s = grant.depth_mm, now_s + 3.0
    assert last > 0.4


def test_the_high_end_of_the_prior_is_never_passed() -> None:
    ledger = touched()
    dig(ledger, 0, 9.0)
    assert ledger.points[0].state is PointState.STOPPED
    assert 0.58 < ledger.cut_mm(0) <= LIMITS.thickness_high_mm


def test_deeper_than_permitted_is_a_safety_stop() -> None:
    ledger = touched()
    grant = ledger.ask(0, bite_mm=0.01, now_s=1.0, frame_at_s=1.0)
    with pytest.raises(SafetyStop, match="permitted"):
        ledger.passed(0, depth_mm=grant.depth_mm + 0.001, now_s=1.1)


def test_a_visit_that_is_given_up_leaves_no_permission() -> None:
    ledger = touched()
    ledger.ask(0, bite_mm=0.01, now_s=1.0, frame_at_s=1.0)
    ledger.void(0)
    with pytest.raises(SafetyStop):
        ledger.passed(0, depth_mm=0.01, now_s=1.1)


EVIDENCE = st.lists(
    st.tuples(
        st.sampled_from(["ask", "seen", "felt", "passed", "void", "look", "stall"]),
        st.floats(0, 1),
        st.floats(0, 1),
        st.floats(0.3, 1.5) | st.none(),
        st.booleans(),
    ),
    max_size=120,
)


@settings(max_examples=150, deadline=None)
@given(EVIDENCE)
def test_no_order_of_evidence_breaks_the_bounds(evidence: list[tuple[str, float, float, float | None, bool]]) -> None:
    """Depth grows by one bite a visit at most, stays within the prior, and a latched point never moves again."""
    ledger = touched()
    point, now_s = ledger.points[0], 1.0
    for what, a, b, ratio, flag in evidence:
        now_s += 0.03
        done, cut = point.state is PointState.DONE, point.cut_mm
        if what == "ask":
            grant = ledger.ask(0, bite_mm=0.06 * a, now_s=now_s, frame_at_s=now_s - 0.15 * b)
            assert grant.depth_mm <= cut + LIMITS.bite_mm + 1e-9
            assert grant.depth_mm <= LIMITS.thickness_high_mm + 1e-9
            assert grant.deeper == (grant.depth_mm > cut)
            assert not (grant.deeper and (done or 0.15 * b > LIMITS.frame_age_s + 1e-9))
        elif what == "seen":
            ledger.seen(0, completion=min(a, b), upper=max(a, b), exposed_at_s=now_s)
        elif what == "felt":
            ledger.felt(0, ratio=ratio, above_idle=flag)
        elif what == "passed":
            depth = point.granted_mm if flag and point.granted_mm is not None else cut
            ledger.passed(0, depth_mm=depth, now_s=now_s)
        elif what == "void":
            ledger.void(0)
        elif what == "look":
            ledger.look(0)
        else:
            ledger.stall()
        assert point.cut_mm >= cut
        if done:
            assert point.state is PointState.DONE


def test_the_first_failure_latches_and_only_hardens() -> None:
    latch = Latch()
    latch.trip(Reaction.HOLD, "first")
    latch.trip(Reaction.KILL, "second")
    latch.trip(Reaction.RETRACT, "third")
    assert (latch.reaction, latch.reason) == (Reaction.KILL, "first")


def test_reactions() -> None:
    assert reaction_to(SafetyStop("x")) is Reaction.HOLD
    assert reaction_to(ConnectionLostError("x")) is Reaction.RETRACT
    assert reaction_to(KeyboardInterrupt()) is Reaction.RETRACT
