"""Whole windows as an experiment: what is counted, and one mouse of it."""

from pathlib import Path

import pytest

from firmware_sim.clock import SimClock
from studies import milling_trials
from studies.milling_trials import Relooks, summary
from studies.trials import World


def trial(seed: int, policy: str, outcome: str, *, free: bool, touched: bool, minutes: float = 2.0) -> dict:
    return {
        "seed": seed, "recipe": policy, "failed": None, "outcome": outcome, "reason": "", "flap_free": free,
        "success": free and not touched and outcome == "complete", "membrane_touched": touched,
        "membrane_overrun_mm": 0.0, "milling_time_min": minutes, "laps": 40.0, "relook_s": 0.0, "heat_rise_c": 8.0,
    }  # fmt: skip


def test_a_hold_is_a_failure_and_a_touched_membrane_is_counted() -> None:
    trials = {
        "a": trial(1, "default", "complete", free=True, touched=False, minutes=2.0),
        "b": trial(2, "default", "held", free=True, touched=False, minutes=9.0),
        "c": trial(3, "default", "complete", free=False, touched=False),
        "d": trial(4, "default", "complete", free=True, touched=False, minutes=3.0),
        "e": trial(1, "paper", "complete", free=True, touched=True),
    }
    figures = summary(trials)
    default = figures["default"]
    assert default["trials"] == 4
    assert default["success_rate"] == 0.5
    assert default["wilson_95"] == pytest.approx([0.15, 0.85], abs=0.005)
    assert (default["holds"], default["false_completes"], default["membranes_touched"]) == (1, 1, 0)
    assert default["time_min_median"] == 2.5, "only windows that succeeded have a time"
    assert figures["paper"]["membranes_touched"] == 1
    assert figures["paper"]["damage_rate"] == 1.0
    assert "time_min_median" not in figures["paper"]


def test_a_window_that_holds_or_looks_again_for_long_is_a_nuisance() -> None:
    trials = {
        "a": trial(1, "default", "complete", free=True, touched=False),
        "b": trial(2, "default", "held", free=True, touched=False),
        "c": trial(3, "default", "complete", free=True, touched=False) | {"relook_s": 5.5},
        "d": trial(4, "default", "complete", free=True, touched=False) | {"relook_s": 4.5},
    }
    assert summary(trials)["default"]["nuisance_rate"] == 0.5


def test_looks_count_after_which_milling_goes_on(tmp_path: Path) -> None:
    clock = SimClock()
    with Relooks(tmp_path / "run", {}, clock) as record:
        for stage in ("contact", "mill", "look", "mill", "look", "retract"):
            record.event("stage", stage=stage)
            clock.sleep_s(1.5)
    assert record.spent_s == pytest.approx(1.5)


def test_each_mouse_meets_every_policy() -> None:
    mice = [World(5), World(6)]
    trials = milling_trials.trials_of(mice, ["default", "paper"], [], False, None)
    assert list(trials) == ["mouse-5-default", "mouse-5-paper", "mouse-6-default", "mouse-6-paper"]


@pytest.mark.slow
def test_a_mouse_with_blind_eyes_is_not_harmed(tmp_path: Path) -> None:
    """The paper's failure: completion that never reads "through" anywhere."""
    figures = milling_trials.mill_one(World(11), "default", ("vision.low=0.7:all",), True, tmp_path)
    assert not figures["membrane_touched"]
    assert figures["laps"] > 1
    assert (tmp_path / "mouse-11-default/events.jsonl").is_file()


@pytest.mark.long
def test_a_mouse_comes_out_the_same_twice() -> None:
    one, two = (milling_trials.mill_one(World(12), "default", (), True, None) for _ in range(2))
    assert one == two
