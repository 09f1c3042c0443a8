"""STOP is clicked on the page in a real browser while the tip runs: when the bench's tip stands.

    python -m studies.stop_clicks --clicks 20 --json FILE

Real processes: a served bench that writes down every millisecond where its tip is; a program that drives the tip in
long strides through free air, with a supervisor and a page, as `mill calibrate --live` does; and Chromium, which
Playwright drives. Every other click is made while the program is frozen by SIGSTOP: its strides would go on for
seconds. Times are real ones, from the moment at which the browser has the click, and include whatever else this machine
does. Needs the extra `test` and a Chromium.
"""

import argparse
import contextlib
import json
import os
import select
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from drivers.clock import SystemClock
from drivers.errors import MillError
from drivers.motion.grbl.driver import GrblController
from drivers.motion.serial_line import open_serial
from drivers.recorder import NullRecorder
from firmware_sim.bench import MAX_FEED_MM_S, MECHANICAL_SETTINGS, ORIGIN_MM, Bench
from firmware_sim.serve import BenchService
from firmware_sim.specimen import draw_specimen
from live.page import Page, Shown
from milling.guard import Guard
from milling.guarded_motion import GuardedMotion
from studies.chromium import chromium

if TYPE_CHECKING:
    from playwright.sync_api import Page as Tab

BAUD: Final = 115_200
FEED_MM_S: Final = 5.0
SIDE_MM: Final = 8.0
CORNERS_MM: Final = ((21.0, 4.0, 16.0), (13.0, 4.0, 16.0), (13.0, -4.0, 16.0), (21.0, -4.0, 16.0))
"""Far above the skull, near the switches."""
WATCHED_S: Final = 0.6
"""After a click; the supervisor lifts the tip, straight up, after that."""
BEFORE: Final = 50
JUST_BEFORE: Final = 10
"""Lines of the track from before the driver's call, and those before the click that say whether the tip ran."""
MOVES_MM_S: Final = 0.5
START_S: Final = 120.0
PICTURE_S: Final = 0.2
TRACK: Final = struct.Struct("<5d")
"""Real time, the bench's time, and where the tip is."""


# The bench.


def serve(track: Path, seed: int) -> None:
    """Serve a bench until stdin closes, and write its track."""
    bench = Bench(draw_specimen(seed))
    with BenchService(bench) as service, track.open("wb", buffering=0) as file:

        def look() -> bool:
            x, y, z = (float(value) for value in bench.machine.tip_mm)
            file.write(TRACK.pack(time.monotonic(), bench.now_s, x, y, z))
            return bool(select.select([sys.stdin], [], [], 0.0)[0])

        print(service.motion_port, flush=True)
        service.run(look)


# The program that moves.


def stride(port: str) -> None:
    """Round a square again and again; home and go on after each stop, until somebody ends this process."""
    # What the page sends as well is for programs that end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    clock = SystemClock()
    with (
        Page() as page,
        GrblController(
            open_serial(port, BAUD),
            clock,
            origin_mm=ORIGIN_MM,
            max_feed_mm_per_s=MAX_FEED_MM_S,
            expected_settings=MECHANICAL_SETTINGS,
        ) as motion,
    ):
        print(page.address, flush=True)
        page.header(title="strides", command="calibrate")
        shown = Shown(NullRecorder(), page, clock, None)
        while True:
            path = motion.stop_path
            assert path is not None
            with Guard(path, clock) as guard:
                page.hand_over_stop(guard.stop_end)
                try:
                    _round(GuardedMotion(motion, guard), shown)
                except MillError as error:
                    shown.event("latched", reason=str(error))
                    print(f"stopped: {error}", flush=True)


def _round(motion: GuardedMotion, shown: Shown) -> None:
    clock = SystemClock()
    picture = np.random.default_rng(0).integers(0, 90, (540, 960, 3), dtype=np.uint8)
    shown.event("stage", stage="homing")
    motion.home()
    motion.start_move(CORNERS_MM[0], feed_mm_per_s=MAX_FEED_MM_S)
    motion.wait_until_idle(timeout_s=30.0)
    print("striding", flush=True)
    shown.event("stage", stage="striding")
    for number in range(1, 10_000):
        motion.start_move(CORNERS_MM[number % 4], feed_mm_per_s=FEED_MM_S)
        while motion.status().queued_s > SIDE_MM / FEED_MM_S:
            shown.frame("left", picture)
            shown.frame("right", picture)
            clock.sleep_s(0.02)


# The one who clicks.


@dataclass
class Stage:
    """All of it, running: a page in the browser, the program that moves, and the bench's track."""

    tab: "Tab"
    program: "subprocess.Popen[str]"
    track: Path

    def says(self, word: str) -> None:
        """Wait until the program says a line that begins so."""
        assert self.program.stdout is not None
        deadline_s = time.monotonic() + START_S
        while True:
            left_s = max(0.0, deadline_s - time.monotonic())
            if not select.select([self.program.stdout], [], [], left_s)[0]:
                raise RuntimeError(f"the program does not come to {word!r} within {START_S:g} s")
            line = self.program.stdout.readline()
            if not line:
                raise RuntimeError("the program has ended")
            if line.startswith(word):
                return

    def click(self, *, frozen: bool) -> dict[str, Any]:
        """Click once the tip strides again, and see when it stands."""
        self.says("striding")
        self.tab.wait_for_function("!document.getElementById('stop').disabled && now.stage === 'striding'")
        self.tab.evaluate("stamped = null")
        box = self.tab.locator("#stop").bounding_box()
        assert box is not None
        self.tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        since = self.track.stat().st_size // TRACK.size - BEFORE
        if frozen:
            self.program.send_signal(signal.SIGSTOP)
        asked_s = time.monotonic()
        self.tab.mouse.down()
        self.tab.mouse.up()
        time.sleep(WATCHED_S)
        clicked_s = float(self.tab.evaluate("stamped")) / 1000.0 - (time.time() - time.monotonic())
        with self.track.open("rb") as file:
            file.seek(since * TRACK.size)
            raw = file.read()
        raw = raw[: len(raw) - len(raw) % TRACK.size]
        if frozen:
            self.program.send_signal(signal.SIGCONT)
        return {
            "frozen": frozen,
            "driver_s": clicked_s - asked_s,
            **stood(np.frombuffer(raw).reshape(-1, 5), clicked_s),
        }


def stood(track: "np.ndarray[Any, np.dtype[np.float64]]", clicked_s: float) -> dict[str, Any]:
    """When the tip stands, in seconds after the click, and whether it ran before and was ever seen to stand."""
    real_s, bench_s, x, y, _ = track.T
    speed = np.hypot(np.diff(x), np.diff(y)) / np.maximum(np.diff(bench_s), 1e-6)
    moves = speed > MOVES_MM_S
    before, after = real_s[1:] <= clicked_s, real_s[1:] > clicked_s
    last_s = real_s[1:][moves & after].max() if (moves & after).any() else clicked_s
    return {
        "ran_before": bool(moves[before][-JUST_BEFORE:].any()),
        "stands_in_the_end": bool(real_s[-1] - last_s > 0.1),
        "standstill_s": float(last_s - clicked_s),
    }


@contextlib.contextmanager
def stage(seed: int = 0) -> Iterator[Stage]:
    """Start everything; the tip strides and the page is open."""
    pipe = subprocess.PIPE
    own = [sys.executable, "-m", "studies.stop_clicks"]
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as all_of_it:
        track = Path(folder) / "track"
        bench = subprocess.Popen([*own, "--bench", str(track), "--seed", str(seed)], stdin=pipe, stdout=pipe, text=True)
        all_of_it.callback(_end, bench)
        browser = all_of_it.enter_context(chromium())
        assert bench.stdout is not None
        port = bench.stdout.readline().strip()
        program = subprocess.Popen([*own, "--strides", port], stdout=pipe, text=True)
        all_of_it.callback(_end, program)
        assert program.stdout is not None
        # The page's own policy keeps a function that is waited for out of it.
        tab = browser.new_context(bypass_csp=True, viewport={"width": 1600, "height": 900}).new_page()
        tab.set_default_timeout(1000 * START_S)
        tab.goto(program.stdout.readline().strip())
        stamp = "event => { stamped = performance.timeOrigin + event.timeStamp; }"
        tab.evaluate(f"() => {{ addEventListener('pointerdown', {stamp}, true); }}")
        yield Stage(tab, program, track)


def _end(process: "subprocess.Popen[str]") -> None:
    process.send_signal(signal.SIGCONT)
    process.kill()
    process.wait()
    for end in (process.stdin, process.stdout):
        if end is not None:
            end.close()


def measure(clicks: int, seed: int) -> dict[str, Any]:
    """Click, with the program frozen every other time."""
    with stage(seed) as all_of_it:
        results = []
        for number in range(clicks):
            results.append(all_of_it.click(frozen=bool(number % 2)))
            print(f"{number + 1}/{clicks} {results[-1]}", flush=True)
    figures: dict[str, Any] = {"command": "stop clicks", "clicks": clicks, "load_1min": os.getloadavg()[0]}
    for name, frozen in (("", False), ("frozen_", True)):
        valid = [each for each in results if each["frozen"] is frozen and each["ran_before"]]
        times = [each["standstill_s"] for each in valid]
        figures[f"{name}clicks_while_moving"] = len(valid)
        figures[f"{name}not_stopped"] = sum(not each["stands_in_the_end"] for each in valid)
        if times:
            figures[f"{name}standstill_s_p50"] = float(np.median(times))
            figures[f"{name}standstill_s_max"] = max(times)
            figures[f"{name}within_100_ms"] = sum(each <= 0.1 for each in times)
    return figures


def main(words: Sequence[str] | None = None) -> None:
    """Print the figures, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clicks", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--bench", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--strides", help=argparse.SUPPRESS)
    given = parser.parse_args(words)
    if given.bench:
        serve(given.bench, given.seed)
        return
    if given.strides:
        stride(given.strides)
        return
    figures = measure(given.clicks, given.seed)
    for name, value in figures.items():
        print(f"{name}: {value}")
    if given.json:
        given.json.write_text(json.dumps(figures), encoding="utf-8")


if __name__ == "__main__":
    main()
