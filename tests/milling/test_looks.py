"""Looks and trials: what finishes a point, what re-opens it, and how far."""

import math

import pytest
from ledgers import LIMITS, dig, felt_through, holed, stopped_by_picture, touched, tried, visit

from milling.limits import Limits
from milling.point import PointState


def test_both_cues_finish_at_a_look_and_done_is_latched() -> None:
    ledger = stopped_by_picture()
    ledger.felt(0, ratio=0.4, above_idle=True)
    assert ledger.look(0) is PointState.DONE
    ledger.seen(0, completion=0.0, upper=0.1, exposed_at_s=2e3)
    ledger.felt(0, ratio=1.0, above_idle=True)
    assert ledger.look(0) is PointState.DONE
    assert not ledger.ask(0, bite_mm=0.01, now_s=2e3, frame_at_s=2e3).deeper


def test_a_load_that_was_weighed_and_is_whole_tries_a_picture_of_a_hole_over_a_bounded_way() -> None:
    ledger = touched()
    dig(ledger, 0, 0.3)
    start, now_s = ledger.cut_mm(0), 1e3
    holed(ledger, now_s)
    assert ledger.points[0].on_trial
    while ledger.points[0].state is PointState.OPEN:
        now_s += 3.0
        visit(ledger, 0, now_s, upper=1.0)
    assert start + 0.02 < ledger.cut_mm(0) <= start + LIMITS.trial_mm + 1e-9


def test_a_point_that_the_picture_calls_through_digs_no_pit() -> None:
    ledger = touched(limits=Limits())
    for point in ledger.points:
        point.cut_mm, point.load_ratio = 0.3, 1.0
    holed(ledger, 1e3)
    assert ledger.points[0].on_trial
    for lap in range(6):
        visit(ledger, 0, 1e3 + 3.0 * (lap + 1), upper=1.0)
    assert 0.3 < ledger.cut_mm(0) <= 0.3 + Limits().pit_mm


def test_a_droop_ends_a_trial_at_once_and_the_look_finishes() -> None:
    ledger = touched()
    dig(ledger, 0, 0.3)
    holed(ledger, 1e3)
    visit(ledger, 0, 1e3 + 1, upper=1.0, ratio=0.7)
    assert ledger.points[0].load_through
    assert ledger.look(0) is PointState.DONE


def test_a_load_that_was_not_weighed_tries_nothing() -> None:
    assert not stopped_by_picture().points[0].on_trial


def test_all_trials_together_are_bounded_from_where_the_picture_first_said_through() -> None:
    ledger = stopped_by_picture()
    start, now_s = ledger.cut_mm(0), 2e3
    for _ in range(10):
        ledger.look(0)
        for _ in range(20):
            visit(ledger, 0, now_s, upper=1.0)
            now_s += 3.0
    assert start + 0.02 < ledger.cut_mm(0) <= start + LIMITS.trial_mm + 1e-9
    assert ledger.points[0].state is not PointState.DONE


def test_looks_reopen_by_a_bounded_amount_and_not_for_ever() -> None:
    ledger = touched()
    dig(ledger, 0, 0.3)
    start, now_s = ledger.cut_mm(0), 2e3
    for _ in range(20):
        ledger.stall()
        ledger.look(0)
        while ledger.points[0].state is PointState.OPEN:
            now_s += 3.0
            visit(ledger, 0, now_s, upper=0.99, ratio=None)
    assert start + 0.02 < ledger.cut_mm(0) <= start + LIMITS.looks * LIMITS.unheard_mm + 1e-9
    assert ledger.points[0].state is PointState.STOPPED


def test_passes_that_cannot_be_weighed_end_soon_past_the_low_end_of_the_prior() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, LIMITS.thickness_low_mm + 0.01)
    start = ledger.cut_mm(0)
    for _ in range(6):
        visit(ledger, 0, now_s, ratio=None)
        now_s += 3.0
    assert start < ledger.cut_mm(0) <= start + LIMITS.unheard_mm + 1e-9
    assert ledger.points[0].state is PointState.STOPPED


def test_the_picture_alone_finishes_nothing() -> None:
    assert tried(0.35).look(2) is PointState.OPEN


def test_after_a_trial_the_picture_finishes_beside_points_that_were_felt_to_be_through() -> None:
    ledger = tried(0.35)
    felt_through(ledger, 1, 0.38)
    felt_through(ledger, 4, 0.36)
    assert ledger.look(2) is PointState.DONE


def test_much_deeper_neighbours_refute_the_picture_and_the_trial_begins_anew() -> None:
    ledger = tried(0.25)
    felt_through(ledger, 1, 0.38)
    felt_through(ledger, 4, 0.36)
    assert ledger.look(2) is PointState.OPEN
    assert ledger.points[2].picture_said_mm == 0.25
    assert ledger.points[2].allowance_mm == pytest.approx(0.25 + LIMITS.trial_mm)


def test_between_felt_points_the_straight_line_counts() -> None:
    ledger = tried(0.30)
    assert ledger.shallow_mm(2) == math.inf
    felt_through(ledger, 1, 0.40)
    assert ledger.shallow_mm(2) == math.inf, "on one side alone"
    felt_through(ledger, 4, 0.34)
    assert ledger.shallow_mm(2) == pytest.approx((2 * 0.40 + 0.34) / 3 - 0.30)


def test_a_point_that_cannot_be_weighed_goes_as_deep_as_its_neighbours_were_felt_and_is_done_there() -> None:
    ledger = touched()
    dig(ledger, 2, 0.30)
    felt_through(ledger, 1, 0.35)
    felt_through(ledger, 3, 0.35)
    now_s = 2e3
    for _ in range(8):
        ledger.stall()
        for at_s in (now_s, now_s + 0.05):
            ledger.seen(2, completion=0.9, upper=0.99, exposed_at_s=at_s)
        if ledger.look(2) is PointState.DONE:
            break
        while ledger.points[2].state is PointState.OPEN:
            now_s += 3.0
            visit(ledger, 2, now_s, upper=0.99, ratio=None)
    assert ledger.points[2].state is PointState.DONE
    assert 0.35 - LIMITS.late_bite_mm < ledger.cut_mm(2) <= 0.35 + 1e-9


def test_a_point_that_waits_for_its_neighbours_is_not_done_by_waiting() -> None:
    ledger = touched(limits=Limits())
    for index, cut_mm in ((0, 0.38), (1, 0.24), (2, 0.33), (3, 0.38)):
        ledger.points[index].cut_mm = cut_mm
    felt_through(ledger, 0, 0.38)
    felt_through(ledger, 3, 0.38)
    for _ in range(4):
        ledger.stall()
        ledger.seen(2, completion=0.9, upper=0.99, exposed_at_s=1e3)
        assert ledger.look(2) is PointState.OPEN


def test_a_notch_between_two_deeper_points_is_not_through_whatever_its_cues_say() -> None:
    for deeper_mm, expected in ((0.04, PointState.DONE), (0.06, PointState.OPEN)):
        ledger = touched(limits=Limits())
        for index, cut_mm in ((1, 0.3 + deeper_mm), (2, 0.3), (3, 0.3 + deeper_mm)):
            ledger.points[index].cut_mm = cut_mm
        point = ledger.points[2]
        point.load_through, point.load_lost_mm, point.state = True, 0.3, PointState.STOPPED
        ledger.seen(2, completion=0.998, upper=1.0, exposed_at_s=1e3)
        assert ledger.look(2) is expected


def test_a_load_lost_in_thick_bone_is_never_called_through() -> None:
    ledger = touched()
    now_s = dig(ledger, 0, 0.05)
    for _ in range(6):
        ledger.felt(0, ratio=None, above_idle=False)
        ledger.seen(0, completion=0.1, upper=0.2, exposed_at_s=now_s)
        ledger.look(0)
        visit(ledger, 0, now_s + 1)
        now_s += 5.0
    assert ledger.points[0].state is not PointState.DONE
