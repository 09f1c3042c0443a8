"""What a study of kills tells, and how it tears a record."""

import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from studies.killed_runs import _tear, grow_mouse, summary


def kill(**told: object) -> dict[str, object]:
    return {
        "stage": "mill", "standstill_s": 0.1, "lower_mm": 0.0, "overrun_mm": 0.0, "spindle_off_s": 0.2,
        "spindle_stands_s": 0.5, "events_lost": 0,
        "resumed": True, "outcome": "complete", "reason": "", "flap_free": True, "membrane_touched": False, **told,
    }  # fmt: skip


def test_the_worst_is_told_and_a_window_that_is_not_free_is_no_success() -> None:
    figures = summary(
        [
            kill(standstill_s=0.12, events_lost=1),
            kill(flap_free=False),
            kill(outcome="held", reason="bone is left", membrane_touched=True),
            kill(resumed=False, outcome="refused", spindle_off_s=None),
        ]
    )
    assert (figures["standstill_s_worst"], figures["events_lost_most"]) == (0.12, 1)
    assert (figures["resumed"], figures["refused"], figures["membranes_touched"]) == (3, 1, 1)
    assert figures["complete_and_free_of_resumed"] == pytest.approx(1 / 3)
    assert figures["ended_otherwise"] == ["bone is left"]
    assert figures["spindle_off_s_worst"] > 1.0, "a drive that was never off counts as on for all of the time"


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_torn_line_is_the_last_one_and_something_of_it_is_left(tmp_path: Path, share: float) -> None:
    file = tmp_path / "events.jsonl"
    file.write_bytes(b"first line\nsecond line\n")
    _tear(file, share)
    left = file.read_bytes()
    assert left.startswith(b"first line\ns")
    assert len(left) < len(b"first line\nsecond line\n")


AT_LEAST, ASKED = 60, 75
"""A run that ends sooner than usual is killed less often."""


@pytest.mark.slow
def test_sixty_kills_of_a_window_leave_a_tip_that_stands_a_drill_that_is_off_and_a_record_that_opens(
    tmp_path: Path,
) -> None:
    # In a process of its own: what is forked must not hold the threads of other tests.
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        grown = pool.submit(grow_mouse, 71, tmp_path, ASKED, statistical=True).result()
    assert grown >= AT_LEAST
    assert list(tmp_path.glob("*.error")) == []
    kills = [json.loads(file.read_text()) for file in tmp_path.glob("kill-*.json")]
    figures = summary(kills)
    assert figures["kills"] == grown
    assert figures["standstill_s_worst"] <= 0.25
    # The queue runs out along a lap's path, which may slope, and at depths that were permitted.
    assert figures["overrun_um_worst"] <= 10.0
    assert figures["spindle_off_s_worst"] <= 0.3
    assert figures["events_lost_most"] <= 1
    assert figures["membranes_touched"] == 0
    assert figures["resumable"] + figures["refused"] == grown
    assert figures["resumable"] > grown / 2
    assert all(kill["reason"] for kill in kills if kill["outcome"] == "refused")
