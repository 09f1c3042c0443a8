"""Whole rings of formula bone: how deep the ledger goes, what it finishes, what it leaves to a person."""

import numpy as np
import pytest
from ledgers import BITE_MM, LIMITS, Bone, dig, touched, visit, wavy

from milling.conclusion import conclude
from milling.limits import Limits
from milling.point import PointState


def bridges(bone: Bone) -> float:
    """Share of the ring that holds the flap, by the published criterion."""
    return float(np.mean(np.array(bone.excess_mm) < -0.03))


@pytest.mark.parametrize("seed", range(4))
def test_honest_cues_free_the_flap_and_stay_off_the_membrane(seed: int) -> None:
    bone = Bone(wavy(32, seed), seed=seed)
    bone.mill()
    assert bridges(bone) <= 0.05
    assert max(bone.excess_mm) < 0.075
    assert conclude(bone.ledger)[0] == "complete"


@pytest.mark.parametrize("shift_mm", [-0.04, 0.04])
def test_pictures_that_are_all_wrong_alike_are_found_out(shift_mm: float) -> None:
    bone = Bone(wavy(32, 5), picture_shift_mm=shift_mm, seed=5)
    bone.mill()
    assert bridges(bone) <= 0.05
    assert max(bone.excess_mm) < 0.075


@pytest.mark.parametrize("seed", range(4))
def test_a_completion_that_is_stuck_low_leads_no_deeper_and_the_load_alone_frees_the_flap(seed: int) -> None:
    """The failure of the published system: the picture never says "through"."""
    bone = Bone(wavy(32, 6), seed=seed)
    honest = bone.completion
    bone.completion = lambda index: min(0.7, honest(index))  # type: ignore[method-assign]
    bone.mill()
    assert max(bone.excess_mm) < 0.085
    assert bridges(bone) <= 0.05
    assert conclude(bone.ledger)[0] == "complete"


def test_a_completion_that_is_stuck_high_is_held_and_never_called_complete() -> None:
    bone = Bone(wavy(32, 7), seed=7)
    bone.completion = lambda _: 1.0  # type: ignore[method-assign]
    bone.mill()
    assert bridges(bone) <= 0.05 or conclude(bone.ledger)[0] == "held"
    assert max(bone.excess_mm) < 0.075


def test_a_picture_of_a_hole_where_no_skull_is_thin_enough_is_not_believed_until_it_takes_it_back() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, 0.1)
    for frame in range(LIMITS.frames + 5):
        ledger.seen(0, completion=1.0, upper=1.0, exposed_at_s=now_s + frame)
    assert ledger.points[0].incredible
    assert ledger.points[0].left_probability > 0.95
    for frame in range(LIMITS.frames):
        ledger.seen(0, completion=0.5, upper=0.6, exposed_at_s=now_s + 100 + frame)
    assert not ledger.points[0].incredible


def test_a_load_that_never_droops_is_stopped_by_the_picture() -> None:
    bone = Bone(wavy(32, 8), seed=8)
    bone.ratio = lambda _: 1.0  # type: ignore[method-assign]
    bone.mill()
    assert max(bone.excess_mm) < 0.1


def test_done_is_latched() -> None:
    bone = Bone(wavy(32, 1), seed=1)
    bone.mill()
    index = next(i for i, point in enumerate(bone.ledger.points) if point.state is PointState.DONE)
    bone.ledger.seen(index, completion=0.0, upper=0.1, exposed_at_s=2e3)
    bone.ledger.felt(index, ratio=1.0, above_idle=True)
    assert bone.ledger.look(index) is PointState.DONE
    assert not bone.ledger.ask(index, bite_mm=0.01, now_s=2e3, frame_at_s=2e3).deeper


def test_a_point_that_rests_goes_on_when_its_neighbours_prove_deeper() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, 0.3)
    while ledger.points[0].state is PointState.OPEN:
        visit(ledger, 0, now_s, completion=1.0, ratio=0.8)
        now_s += 3.0
    assert ledger.points[0].resting
    rested_mm = ledger.cut_mm(0)
    for lap in range(50):
        for index in range(1, 8):
            if ledger.cut_mm(index) < rested_mm + 0.13:
                visit(ledger, index, now_s + 3.0 * lap, alone=True)
    visit(ledger, 0, now_s + 1e3, completion=0.8)
    assert ledger.points[0].state is PointState.OPEN


def test_nothing_is_finished_that_was_never_weighed() -> None:
    ledger = touched()
    for point in ledger.points:
        point.cut_mm = 0.5
    for index in range(len(ledger.points)):
        for frame in range(5):
            ledger.seen(index, completion=1.0, upper=1.0, exposed_at_s=10.0 + frame)
    assert ledger.points[0].left_probability < LIMITS.left_risk
    assert ledger.look(0) is not PointState.DONE


def test_passes_that_cannot_be_weighed_end_soon_past_the_low_end_of_the_prior() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, LIMITS.thickness_low_mm)
    start_mm = ledger.cut_mm(0)
    for _ in range(10):
        visit(ledger, 0, now_s, ratio=None)
        now_s += 3.0
    assert start_mm < ledger.cut_mm(0) <= start_mm + LIMITS.unheard_mm + 1e-9
    assert "its load is not known" in ledger.points[0].why


def test_a_load_that_is_lost_bounds_the_depth_whatever_else_is_known() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, 0.15)
    for ratio in (0.5, 0.5):
        visit(ledger, 0, now_s, ratio=ratio)
        now_s += 3.0
    lost_mm = ledger.cut_mm(0)
    for _ in range(20):
        ledger.stall()
        ledger.look(0)
        visit(ledger, 0, now_s, ratio=0.8)
        now_s += 3.0
    assert ledger.cut_mm(0) <= lost_mm + LIMITS.past_loss_mm + 1e-9


def test_whole_loads_refute_a_lost_one() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, 0.15)
    for ratio in (0.5, 0.5, *[1.0] * 5):
        ledger.felt(0, ratio=ratio, above_idle=True)
    lost_mm = ledger.cut_mm(0)
    for _ in range(6):
        visit(ledger, 0, now_s)
        now_s += 3.0
    assert ledger.cut_mm(0) > lost_mm + 2 * LIMITS.past_loss_mm


def test_a_load_proved_at_other_points_may_overrule_the_picture_farther() -> None:
    depths = []
    for proven in (False, True):
        ledger = touched(16)
        now_s = dig(ledger, 0, 0.15)
        for point in ledger.points[4:8]:
            point.agreed = proven
        for _ in range(60):
            visit(ledger, 0, now_s, completion=0.93, ratio=1.0)
            ledger.points[0].upper = 1.0
            now_s += 3.0
        depths.append(ledger.cut_mm(0))
    assert depths[1] > depths[0] + LIMITS.said_mm / 2


def test_unweighed_under_a_picture_of_a_hole_a_look_gives_nothing_back_by_itself() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, 0.3)
    for frame in range(5):
        ledger.seen(0, completion=0.97, upper=0.99, exposed_at_s=now_s - 1.0 + 0.1 * frame)
    for _ in range(10):
        visit(ledger, 0, now_s, completion=0.99, ratio=None)
        now_s += 3.0
    stopped_mm = ledger.cut_mm(0)
    for _ in range(10):
        ledger.look(0)
        visit(ledger, 0, now_s, completion=0.99, ratio=None)
        now_s += 3.0
    assert ledger.cut_mm(0) == stopped_mm


def test_looks_reopen_not_for_ever() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, 0.3)
    start_mm = ledger.cut_mm(0)
    for _ in range(20):
        ledger.stall()
        ledger.look(0)
        while ledger.points[0].state is PointState.OPEN:
            now_s += 3.0
            visit(ledger, 0, now_s, completion=0.4, ratio=None)
    assert start_mm + 0.02 < ledger.cut_mm(0) <= start_mm + LIMITS.looks * (LIMITS.unheard_mm + BITE_MM)
    assert ledger.points[0].state is PointState.STOPPED


def test_a_point_waits_for_its_shallower_neighbour_also_when_it_is_reopened() -> None:
    ledger = touched(limits=Limits())
    now_s = 1.0
    for _ in range(40):
        visit(ledger, 0, now_s, alone=True)
        visit(ledger, 1, now_s, alone=True)
        now_s += 3.0
    assert 0.03 < ledger.cut_mm(0) <= Limits().neighbour_mm, "the neighbour on the other side is untouched"
    ledger.stall()
    ledger.look(0)
    visit(ledger, 0, now_s, alone=True)
    assert ledger.cut_mm(0) <= Limits().neighbour_mm
