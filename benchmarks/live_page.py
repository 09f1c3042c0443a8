"""What showing a run costs the loop: the page's recorder beside the writing of the record.

    python -m benchmarks.live_page --events 5000 --json FILE

The events are those of a second of milling, in their proportions, on a clock that is told; the page's process lives and
reads. Times are of the processor, per event, and the shares are of a second of milling: events, and the pictures of
both eyes.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.recorder import NullRecorder, Recorder
from live.page import Page, Shown
from live.story import Floats
from milling.record import RunRecorder

POINTS: Final = 32
RATE_HZ: Final = 100.0
"""Events in a second of milling."""
FRAMES_HZ: Final = 30.0


class ToldClock:
    """Time passes when it is told to."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        """Seconds so far."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Let them pass."""
        self._now_s += duration_s


class _Straight:
    """A calibration that takes mm for pixels."""

    def project(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """The same place in both pictures."""
        return points_mm[:, :2], points_mm[:, :2]


def measure(events: int) -> dict[str, float]:
    """Median times in us, their ratio, and shares of a second."""
    drawn = np.random.default_rng(0)
    many = [event_of(drawn, number) for number in range(events)]
    picture = drawn.integers(0, 255, (540, 960, 3), dtype=np.uint8)
    picture = picture // 8 + np.linspace(60, 180, 960, dtype=np.uint8)[None, :, None]
    clock = ToldClock()
    with tempfile.TemporaryDirectory() as folder, Page() as page:
        with RunRecorder(Path(folder) / "run", {}, clock) as record:
            record_us = _times(record, many, clock)
        shown = Shown(NullRecorder(), page, clock, _Straight())
        shown_us = _times(shown, many, clock)
        took_us = []
        for _ in range(int(4 * FRAMES_HZ)):
            clock.sleep_s(1.0 / FRAMES_HZ)
            for name in ("left", "right"):
                began = time.thread_time()
                shown.frame(name, picture)
                took_us.append(1e6 * (time.thread_time() - began))
    return {
        "events": float(events),
        "record_us": float(np.median(record_us)),
        "page_us": float(np.median(shown_us)),
        "page_p99_us": float(np.percentile(shown_us, 99)),
        "ratio": float(np.mean(shown_us) / np.mean(record_us)),
        "events_share": float(np.mean(shown_us)) * RATE_HZ / 1e6,
        "pictures_share": float(np.mean(took_us)) * 2 * FRAMES_HZ / 1e6,
        "dropped": float(page.dropped),
    }


def event_of(drawn: np.random.Generator, number: int) -> tuple[str, dict[str, Any]]:
    """Three questions and three readings, a place cut or left and a load, again and again."""
    point = number % POINTS + 1
    match number % 8:
        case 0 | 1 | 2:
            asked = {"bite_mm": 0.03, "frame_age_s": 0.03, "depth_mm": 0.1 + 0.001 * point, "reason": ""}
            return "asked", {"point": point, **asked}
        case 3 | 4 | 5:
            completion = drawn.random(POINTS)
            return "reading", {"age_s": 0.03, "completion": completion, "upper": completion, "shown": "s" * POINTS}
        case 6:
            return "left", {"point": point, "depth_mm": 0.1, "age_s": 0.001}
    return "load", {"torque": float(drawn.random()), "rpm": 50_000.0, "tip_mm": (1.0, 2.0, -2.5)}


def _times(recorder: Recorder, many: Sequence[tuple[str, dict[str, Any]]], clock: ToldClock) -> list[float]:
    times = []
    for kind, fields in many:
        clock.sleep_s(1.0 / RATE_HZ)
        began = time.thread_time()
        recorder.event(kind, **fields)
        times.append(1e6 * (time.thread_time() - began))
    return times


def main(words: Sequence[str] | None = None) -> None:
    """Print the figures, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=5000)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(words)
    figures = measure(given.events)
    for name, value in figures.items():
        print(f"{name}: {value:.4g}")
    if given.json:
        given.json.write_text(json.dumps({"command": "live page", **figures}), encoding="utf-8")


if __name__ == "__main__":
    main()
