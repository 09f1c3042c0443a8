"""What a study of kills tells, and how it tears a record."""

from pathlib import Path

import pytest

from studies.killed_runs import _tear, summary


def kill(**told: object) -> dict[str, object]:
    return {
        "standstill_s": 0.1, "lower_mm": 0.0, "spindle_off_s": 0.2, "spindle_stands_s": 0.5, "events_lost": 0,
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
