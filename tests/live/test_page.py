"""The page in a real browser: what it shows, in what words, and how soon its button stops the motion."""

import contextlib
import os
import pty
import select
import signal
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from browser import BRIGHT, CHROMIUM, DESKTOP_PX, TABLET_PX, Tab, tab
from rehearsal import rehearsed

from live.player import Player
from milling.record import Run

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
HERE = Path(__file__).parent
SHOWN_S = 2.0
STOPPED_S = 0.1


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return rehearsed(tmp_path_factory.mktemp("run") / "rehearsal")


@pytest.fixture(scope="module")
def browser() -> Iterator[Tab]:
    with tab() as opened:
        opened.size(DESKTOP_PX)
        yield opened


@dataclass
class Bench:
    """A process that feeds a page from a record, and the far end of the wire that its supervisor stops.

    With ``--pipe`` the far end is where the supervisor would be.
    """

    process: "subprocess.Popen[str]"
    address: str
    far: int

    def hold_after(self, pressed_s: float) -> float:
        """Seconds from ``pressed_s`` to the hold at the far end of the wire."""
        assert select.select([self.far], [], [], 5.0)[0], "no stop on the wire"
        took_s = time.monotonic() - pressed_s
        assert os.read(self.far, 16)[:1] == b"!"
        return took_s

    def says(self) -> str:
        assert self.process.stdout is not None
        assert select.select([self.process.stdout], [], [], 20.0)[0]
        return self.process.stdout.readline().strip()


@contextlib.contextmanager
def fed(folder: Path, *words: str) -> Iterator[Bench]:
    if "--pipe" in words:
        far, near = os.pipe()
    else:
        far, near = pty.openpty()
        tty.setraw(near)
    command = [sys.executable, str(HERE / "feeder.py"), str(folder), str(near), *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, pass_fds=(near,), text=True)
    try:
        assert process.stdout is not None
        yield Bench(process, process.stdout.readline().strip(), far)
    finally:
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.wait()
        process.stdout.close()
        os.close(near)
        os.close(far)


PAINTED = """(c => {
    const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    let sum = 0;
    for (let i = 3; i < d.length; i += 400) sum += d[i] > 0;
    return sum / (d.length / 400);
})(document.getElementById("hills"))"""
"""Which share of the surface's canvas is not empty."""


def test_both_streams_and_the_ring_are_there_within_two_seconds(run: Run, browser: Tab) -> None:
    with fed(run.folder) as bench:
        browser.open(bench.address)
        browser.until("document.readyState === 'complete' && document.getElementById('gauge')")
        shown = f"{BRIGHT}(0) > 10 && {BRIGHT}(1) > 10 && document.querySelectorAll('#gauge path title').length === 16"
        assert browser.until(shown) < SHOWN_S
        browser.until("document.getElementById('stage').textContent === 'Milling'")
        browser.until("document.querySelectorAll('#why li').length > 0")
        assert browser.ask("location.search") == "", "the token does not stay in the address"
        assert browser.complaints == []


def test_what_is_unknown_is_hatched_and_the_surface_is_there_with_the_path(run: Run, browser: Tab) -> None:
    """Before the first picture is read."""
    planned = next(run.of_kind("trajectory"))
    with fed(run.folder, f"--until={planned['t']}") as bench:
        browser.open(bench.address)
        browser.until("scene.path_mm.length === 16")
        browser.until("document.querySelectorAll('#gauge path[fill=\"url(#hatch)\"]').length === 16")
        assert browser.ask("document.getElementById('rest').textContent") == "0 of 16 at rest, 16 not seen yet"
        assert browser.ask("scene.marks_px.map(eye => Object.keys(eye).join())") == ["bregma,lambda"] * 2
        browser.until(f"{PAINTED} > 0.1")
        assert browser.ask("document.getElementById('eye0').getAttribute('aria-label')")
        before = browser.ask("document.getElementById('hills').toDataURL()")
        browser.ask("document.getElementById('hills').focus()")
        browser.key("ArrowRight")
        assert browser.ask("document.getElementById('hills').toDataURL()") != before, "the arrow keys turn it"


def test_a_run_is_followed_to_its_end(run: Run, browser: Tab) -> None:
    with fed(run.folder, "--to-the-end") as bench:
        browser.open(bench.address)
        browser.until("document.getElementById('stage').textContent === 'Aborted'")
        browser.until("document.getElementById('stop-how').textContent === 'the run has ended'")
        assert browser.ask("document.getElementById('stop').disabled") is True
        assert "stopped by a person" in browser.ask("document.getElementById('banner').innerText")
        depths = [point["depth_mm"] for point in next(run.of_kind("outcome"))["points"]]
        assert browser.ask("now.points.depth") == depths
        assert browser.complaints == []


def test_a_point_that_is_withheld_says_why_in_words(run: Run, browser: Tab) -> None:
    with fed(run.folder, "--withheld") as bench:
        browser.open(bench.address)
        browser.until("document.querySelector('#why').innerText.includes('withheld: no fresh frame')")
        line = "[...document.querySelectorAll('#why li')].find(li => li.innerText.includes('no fresh frame')).innerText"
        assert "points 3, 4, 9" in browser.ask(line)
        assert "no fresh frame" in browser.ask("document.querySelectorAll('#gauge title')[2].textContent")
        stop = "document.getElementById('stop').getBoundingClientRect()"
        try:
            for size_px in (TABLET_PX, DESKTOP_PX):
                browser.size(size_px)
                assert browser.ask("document.documentElement.scrollWidth <= innerWidth"), "nothing hangs over the edge"
                browser.ask("scrollTo(0, document.body.scrollHeight)")
                assert browser.ask(f"{stop}.top >= 0 && {stop}.bottom <= innerHeight"), "the button stays in sight"
        finally:
            browser.size(DESKTOP_PX)


@pytest.mark.parametrize("frozen", [False, True], ids=["", "with the process that mills frozen"])
def test_stop_reaches_the_supervisor_in_time(run: Run, browser: Tab, frozen: bool) -> None:
    """The best of some presses, since this machine may be busy with something else."""
    with fed(run.folder, "--pipe") as bench:
        browser.open(bench.address)
        browser.until("document.getElementById('stop')?.disabled === false && now?.immediate")
        if frozen:
            bench.process.send_signal(signal.SIGSTOP)
        browser.ask("document.getElementById('stop').focus()")
        for press in (lambda: browser.key("Escape"), lambda: browser.key("Enter"), lambda: browser.click("#stop")):
            took_s = []
            for _ in range(5):
                pressed_s = time.monotonic()
                press()
                took_s.append(bench.hold_after(pressed_s))
            assert min(took_s) < STOPPED_S


def test_stop_stops_the_motion_and_the_run_hears_of_it(run: Run, browser: Tab) -> None:
    with fed(run.folder) as bench:
        browser.open(bench.address)
        browser.until("document.getElementById('stop')?.disabled === false && now?.immediate")
        browser.key(" ")
        bench.hold_after(time.monotonic())
        assert bench.says() == "heard: supervisor: it has stopped the motion: told to stop"
        browser.until("document.getElementById('banner').innerText.includes('told to stop')")


def test_stop_holds_a_frozen_run_and_asks_it_to_end_when_it_wakes(run: Run, browser: Tab) -> None:
    with fed(run.folder) as bench:
        browser.open(bench.address)
        browser.until("document.getElementById('stop')?.disabled === false && now?.immediate")
        bench.process.send_signal(signal.SIGSTOP)
        browser.key("Escape")
        bench.hold_after(time.monotonic())
        browser.until("document.getElementById('banner').innerText.includes('silent')")
        browser.until("now.silent_s > 2.5")
        bench.process.send_signal(signal.SIGCONT)
        assert bench.says() in {"asked", "heard: supervisor: it has stopped the motion: told to stop"}


def test_a_run_that_is_killed_is_said_to_be_gone(run: Run, browser: Tab) -> None:
    with fed(run.folder) as bench:
        browser.open(bench.address)
        browser.until("document.getElementById('stop')?.disabled === false")
        bench.process.kill()
        browser.until("document.getElementById('banner').innerText.includes('without a word')")
        assert browser.ask("document.getElementById('stop').disabled") is True


def test_a_record_plays_in_the_same_page(run: Run, browser: Tab) -> None:
    command = [sys.executable, "-m", "cli.main", "live", str(run.folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            browser.open(process.stdout.readline().split()[1])
            browser.until("record && record.moments.length")
            browser.ask("document.getElementById('slider').focus()")
            browser.key("ArrowRight")
            browser.until("at === 1")
            moments = browser.ask("record.moments.length")
            browser.page.locator("#slider").fill(str(moments // 2))
            browser.until(f"at === {moments // 2}")
            assert browser.ask("rows.length > 2 && now.t < record.moments.at(-1).t && now.points.depth.length === 16")
            browser.until(f"{PAINTED} > 0.1")
            browser.page.locator("#slider").fill(str(moments - 1))
            browser.until(f"{BRIGHT}(0) > 10 && {BRIGHT}(1) > 10")
            assert "stopped by a person" in browser.ask("document.getElementById('banner').innerText")
            assert browser.ask("getComputedStyle(document.getElementById('stop')).display") == "none"
            assert browser.complaints == []
        finally:
            process.send_signal(signal.SIGINT)


def test_every_moment_of_a_record_is_told(run: Run) -> None:
    player = Player(run)
    assert '"outcome":"aborted"' in player.story
    assert player.picture("00003-reference_left.jpg") is not None
