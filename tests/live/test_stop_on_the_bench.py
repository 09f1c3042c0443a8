"""STOP on the page, clicked in a real browser, and the bench's own word for when its tip stands."""

import numpy as np
import pytest

from studies.chromium import CHROMIUM
from studies.stop_clicks import stage, stood

STANDS_S = 0.1


def track(stands_at_s: float, *, speed_mm_s: float = 5.0) -> np.ndarray:
    """A tip that runs along x until it stands, one line a millisecond; the bench's clock is another."""
    t = np.arange(0.0, 1.0, 0.001)
    x = speed_mm_s * np.minimum(t, stands_at_s)
    return np.column_stack([100.0 + t, 7.0 + t, x, np.zeros_like(t), np.zeros_like(t)])


def test_a_tip_stands_after_the_last_line_in_which_it_moved() -> None:
    seen = stood(track(0.25), 100.2)
    assert seen == {"ran_before": True, "stands_in_the_end": True, "standstill_s": pytest.approx(0.05, abs=0.002)}


def test_a_tip_that_goes_on_or_never_ran_is_told() -> None:
    assert stood(track(2.0), 100.2)["stands_in_the_end"] is False
    assert stood(track(0.0), 100.2)["ran_before"] is False
    assert stood(track(0.1), 100.2)["ran_before"] is False, "it stood by itself before, and that is no stop"


def test_a_lift_is_no_motion_along_the_way() -> None:
    lifted = track(0.25)
    lifted[600:, 4] = np.linspace(0.0, 1.5, 400)
    assert stood(lifted, 100.2)["standstill_s"] == pytest.approx(0.05, abs=0.002)


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
@pytest.mark.slow
def test_a_click_stops_the_tip_also_while_the_program_that_moves_it_is_frozen() -> None:
    """The better of two clicks, since this machine may be busy with something else."""
    with stage() as all_of_it:
        for frozen in (True, False):
            both = [all_of_it.click(frozen=frozen) for _ in range(2)]
            assert all(seen["ran_before"] and seen["stands_in_the_end"] for seen in both), both
            assert 0.0 < min(seen["standstill_s"] for seen in both) < STANDS_S, both
