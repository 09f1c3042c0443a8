"""What twenty viewers cost the loop, and whether the page's process grows: paired, in one run.

    python -m benchmarks.live_viewers --pairs 12 --seconds 10 --json FILE
    python -m benchmarks.live_viewers --hours 1 --json FILE

A loop of the shape of the one that mills (an event, now and then a pair of pictures, 5 ms of sleep) writes a record and
shows it on a page. In turn nobody watches, and twenty viewers read everything, in one process beside it. What is
compared is how long the loop's rounds take; 99 of 100 are shorter than p99. The pairs tell how much the ratio strays on
this machine: its interval is a bootstrap over them.

With ``--hours`` the events of so long a run pass as fast as the page's process takes them, with twenty viewers, and its
memory is looked at on the way.
"""

import argparse
import array
import asyncio
import contextlib
import fcntl
import http.client
import json
import re
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Self
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt

from benchmarks.live_page import FRAMES_HZ, POINTS, RATE_HZ, ToldClock, event_of
from drivers.clock import SystemClock
from drivers.recorder import NullRecorder
from live import wire
from live.page import PICTURE_PERIOD_S, Page, Shown
from live.viewers import MOST_VIEWERS
from milling.record import RunRecorder

Floats = npt.NDArray[np.float64]

SLEEP_S: Final = 0.005
SETTLE_S: Final = 1.0
RESAMPLED: Final = 2000
REST_S: Final = 0.002
LOOKS: Final = 12
"""At the memory, evenly over the hours; the first half is warming up."""


class Crowd:
    """Viewers in a process of their own, who come and go together."""

    def __init__(self, page: Page, count: int) -> None:
        """``page`` is fresh: its token is traded here."""
        address = urlsplit(page.address)
        self.host = address.netloc
        connection = http.client.HTTPConnection(self.host, timeout=20.0)
        connection.request("GET", f"/?{address.query}")
        self.cookie = str(connection.getresponse().getheader("set-cookie")).partition(";")[0]
        connection.close()
        words = [sys.executable, "-m", "benchmarks.live_viewers", "--watch", self.host, self.cookie, str(count)]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def come(self) -> None:
        """All look, and have been told something."""
        self._ask("come")

    def go(self) -> int:
        """All leave; how many of them were still there."""
        return int(self._ask("go"))

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for end in (self._process.stdin, self._process.stdout):
            assert end is not None
            end.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, word: str) -> str:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{word}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline().strip()
        if not answer:
            raise RuntimeError("the viewers' process has ended")
        return answer


async def _watch(host: str, cookie: str, count: int) -> None:
    """The crowd: does what stdin says."""
    from websockets.asyncio.client import ClientConnection, connect
    from websockets.exceptions import ConnectionClosed
    from websockets.typing import Origin

    async def read(viewer: ClientConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                await viewer.recv()

    viewers: list[ClientConnection] = []
    readers: list[asyncio.Task[None]] = []
    while word := (await asyncio.to_thread(sys.stdin.readline)).strip():
        if word == "come":
            for _ in range(count):
                opened = await connect(
                    f"ws://{host}/watch", origin=Origin(f"http://{host}"), additional_headers={"Cookie": cookie},
                    proxy=None, max_size=None,
                )  # fmt: skip
                await opened.recv()
                viewers.append(opened)
                readers.append(asyncio.create_task(read(opened)))
            print("watching", flush=True)
        else:
            left = sum(not each.done() for each in readers)
            await asyncio.gather(*(each.close() for each in viewers))
            await asyncio.gather(*readers)
            viewers.clear()
            readers.clear()
            print(left, flush=True)


def measure_loop(pairs: int, seconds: float, viewers: int = MOST_VIEWERS) -> dict[str, float]:
    """Rounds of the loop in ms, without and with viewers, and the ratio of p99 with its interval."""
    alone: list[Floats] = []
    watched: list[Floats] = []
    stayed = viewers
    with tempfile.TemporaryDirectory() as folder, Page() as page, Crowd(page, viewers) as crowd:
        clock = SystemClock()
        with RunRecorder(Path(folder) / "run", {}, clock) as record:
            loop = _Loop(Shown(record, page, clock, None))
            loop.rounds_ms(seconds)
            for number in range(pairs):
                # In turn the first and the second of a pair, so that what drifts drifts for both.
                for with_viewers in (False, True) if number % 2 else (True, False):
                    if with_viewers:
                        crowd.come()
                    loop.rounds_ms(SETTLE_S)
                    (watched if with_viewers else alone).append(loop.rounds_ms(seconds))
                    if with_viewers:
                        stayed = min(stayed, crowd.go())
    ratios = np.array([_p99([b]) / _p99([a]) for a, b in zip(alone, watched, strict=True)])
    drawn = np.random.default_rng(0).integers(0, pairs, (RESAMPLED, pairs))
    pooled = [_p99([watched[i] for i in each]) / _p99([alone[i] for i in each]) for each in drawn]
    return {
        "viewers": float(viewers),
        "viewers_stayed": float(stayed),
        "pairs": float(pairs),
        "rounds": float(sum(map(len, alone))),
        "alone_p50_ms": float(np.median(np.concatenate(alone))),
        "alone_p99_ms": _p99(alone),
        "watched_p50_ms": float(np.median(np.concatenate(watched))),
        "watched_p99_ms": _p99(watched),
        "p99_ratio": _p99(watched) / _p99(alone),
        "p99_ratio_low": float(np.percentile(pooled, 5)),
        "p99_ratio_high": float(np.percentile(pooled, 95)),
        "p99_ratio_of_a_pair_median": float(np.median(ratios)),
        "dropped": float(page.dropped),
    }


def _p99(blocks: Sequence[Floats]) -> float:
    return float(np.percentile(np.concatenate(blocks), 99))


class _Loop:
    """Rounds of what the loop that mills does for its record and its page."""

    def __init__(self, shown: Shown) -> None:
        self._shown = shown
        self._drawn = np.random.default_rng(0)
        self._number = 0
        self._picture_at_s = 0.0
        noise = self._drawn.integers(0, 255, (540, 960, 3), dtype=np.uint8)
        self._picture = noise // 8 + np.linspace(60, 180, 960, dtype=np.uint8)[None, :, None]

    def rounds_ms(self, seconds: float) -> Floats:
        """How long each of them took."""
        times = [time.monotonic()]
        while times[-1] - times[0] < seconds:
            kind, fields = event_of(self._drawn, self._number)
            self._number += 1
            self._shown.event(kind, **fields)
            if times[-1] - self._picture_at_s > 1.0 / FRAMES_HZ:
                self._picture_at_s = times[-1]
                self._shown.frame("left", self._picture)
                self._shown.frame("right", self._picture)
            time.sleep(SLEEP_S)
            times.append(time.monotonic())
        return 1000.0 * np.diff(times)


def measure_memory(hours: float, viewers: int = MOST_VIEWERS) -> dict[str, Any]:
    """Megabytes of the page's process after half of the hours and at their end, and the most between."""
    drawn = np.random.default_rng(0)
    clock = ToldClock()
    jpeg = drawn.integers(0, 255, 30_000, dtype=np.uint8).tobytes()
    events = int(hours * 3600 * RATE_HZ)
    every = int(RATE_HZ * PICTURE_PERIOD_S)
    sizes = []
    with Page() as page, Crowd(page, viewers) as crowd:
        shown = Shown(NullRecorder(), page, clock, None)
        shown.event("state", state="start", job={"n_points": POINTS, "thickness_high_mm": 0.5})
        crowd.come()
        for number in range(events):
            clock.sleep_s(1.0 / RATE_HZ)
            kind, fields = event_of(drawn, number)
            if number % 1000 == 0:
                kind, fields = "bad_reading", {"reason": "a completion is NaN or infinite"}
            shown.event(kind, **fields)
            if number % every == 0:
                for eye in (0, 1):
                    page.send(wire.PICTURE, wire.picture_body(eye, clock.now_s(), (0, 0, 960, 540), jpeg))
                _until_heard(page)
            if (number + 1) % max(1, events // LOOKS) == 0:
                sizes.append(memory_mb(page.process_id))
        stayed = crowd.go()
    half = sizes[len(sizes) // 2 :]
    return {
        "hours": hours,
        "viewers": float(viewers),
        "viewers_stayed": float(stayed),
        "events": float(events),
        "half_way_mb": half[0],
        "end_mb": half[-1],
        "most_mb": max(half),
        "growth_mb": half[-1] - half[0],
        "dropped": float(page.dropped),
        "looks_mb": sizes,
    }


def _until_heard(page: Page) -> None:
    """Wait until the far end has read everything, and a little longer: it has viewers as well."""
    unread = array.array("i", [1])
    while unread[0]:
        time.sleep(REST_S)
        fcntl.ioctl(page.feed_fd, termios.TIOCOUTQ, unread)


def memory_mb(process_id: int) -> float:
    """What a process holds."""
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{process_id}/status").read_text())
    assert found is not None
    return int(found[1]) / 1000


def main(words: Sequence[str] | None = None) -> None:
    """Print the figures, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--hours", type=float)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--watch", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args(words)
    if given.watch:
        asyncio.run(_watch(given.watch[0], given.watch[1], int(given.watch[2])))
        return
    figures: dict[str, Any] = (
        measure_loop(given.pairs, given.seconds) if given.hours is None else measure_memory(given.hours)
    )
    for name, value in figures.items():
        print(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")
    if given.json:
        given.json.write_text(json.dumps({"command": "live viewers", **figures}), encoding="utf-8")


if __name__ == "__main__":
    main()
