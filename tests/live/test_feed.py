"""What a run tells its page's process, how both end, and that neither waits for the other."""

import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from served_page import Served, closed, page_served

from live import wire
from live.server import MOST_NEWS


@pytest.fixture
def fresh() -> Iterator[Served]:
    """One that does not outlive its test."""
    with page_served() as served:
        yield served


def test_a_run_that_ends_says_so_and_the_process_leaves(fresh: Served) -> None:
    with fresh.viewer() as viewer:
        fresh.page.send(
            wire.EVENT, json.dumps({"t": 1.0, "kind": "outcome", "outcome": "held", "reason": "x"}).encode()
        )
        fresh.page.close()
        told = [json.loads(news) for news in closed(viewer)]
    assert told[-1]["ended"] is True
    assert told[-1]["cut_off"] is False
    assert told[-1]["outcome"] == {"outcome": "held", "reason": "x"}
    assert fresh.page._process.returncode == 0


def test_what_a_command_does_next_is_told_from_its_beginning(fresh: Served) -> None:
    """A virtual bench is calibrated before it mills, each on a clock of its own."""
    fresh.page.header(title="bench", command="run")
    fresh.page.send(wire.EVENT, json.dumps({"t": 60.0, "kind": "latched", "reason": "x"}).encode())
    fresh.page.header(title="2026", command="run")
    fresh.page.send(wire.EVENT, json.dumps({"t": 1.0, "kind": "stage", "stage": "mill"}).encode())
    with fresh.viewer() as viewer:
        told: dict[str, dict[str, object]] = {}
        while told.get("now", {}).get("stage") != "mill":
            news = json.loads(viewer.recv(5.0))
            told[news["kind"]] = news
    assert told["history"]["title"] == "2026"
    assert (told["now"]["t"], told["now"]["news"]) == (1.0, [])
    assert all(row[0] <= 1.0 for row in told["history"]["rows"])  # type: ignore[attr-defined]


def test_news_without_end_stay_bounded(fresh: Served) -> None:
    for number in range(20 * MOST_NEWS):
        told = {"t": float(number), "kind": "bad_reading", "reason": str(number)}
        while True:
            dropped = fresh.page.dropped
            fresh.page.send(wire.EVENT, json.dumps(told).encode())
            if fresh.page.dropped == dropped:
                break
    with fresh.viewer() as viewer:
        news: list[dict[str, object]] = []
        while not news or news[-1]["why"] != str(20 * MOST_NEWS - 1):
            told = json.loads(viewer.recv(5.0))
            news = told["news"] if told["kind"] == "now" else news
    assert len(news) == MOST_NEWS


def test_a_page_that_dies_leaves_the_run_alone(fresh: Served) -> None:
    lost: list[str] = []
    fresh.page._on_loss = lost.append
    os.kill(fresh.page.process_id, signal.SIGKILL)
    fresh.page._process.wait()
    for _ in range(3):
        fresh.page.send(wire.EVENT, b"{}")
    fresh.page.hand_over_stop(fresh.stop_hears)
    assert len(lost) == 1
    assert "the run goes on without it" in lost[0]


def test_a_page_that_is_frozen_makes_nobody_wait(fresh: Served) -> None:
    os.kill(fresh.page.process_id, signal.SIGSTOP)
    try:
        began_s = time.monotonic()
        for _ in range(5000):
            fresh.page.send(wire.EVENT, b"x" * 1000)
        assert time.monotonic() - began_s < 2.0
        assert fresh.page.dropped > 4000
    finally:
        os.kill(fresh.page.process_id, signal.SIGKILL)
