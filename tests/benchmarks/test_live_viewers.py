"""The benchmark of viewers: they come, read and go, and the page's process does not grow. Times are no matter here."""

import pytest

from benchmarks.live_viewers import Crowd, measure_loop, measure_memory
from live.page import Page


def test_a_loop_is_timed_without_and_with_viewers() -> None:
    figures = measure_loop(pairs=2, seconds=0.3, viewers=3)
    assert figures["viewers_stayed"] == 3
    assert figures["rounds"] > 10
    assert figures["alone_p50_ms"] > 5.0
    assert figures["p99_ratio"] == pytest.approx(figures["watched_p99_ms"] / figures["alone_p99_ms"])
    assert figures["p99_ratio_low"] <= figures["p99_ratio"] <= figures["p99_ratio_high"]


def test_a_run_of_minutes_leaves_the_pages_memory_as_it_was() -> None:
    figures = measure_memory(hours=0.03, viewers=20)
    assert figures["viewers_stayed"] == 20
    assert figures["dropped"] == 0
    assert figures["growth_mb"] < 2.0, figures["looks_mb"]


def test_a_crowd_that_is_gone_is_missed() -> None:
    with Page() as page, Crowd(page, 1) as crowd:
        crowd.close()
        with pytest.raises((RuntimeError, ValueError, BrokenPipeError)):
            crowd.come()
