"""Whole commands with --live, each in its own process, watched and stopped in a real browser."""

import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "cli"))

from browser import BRIGHT, CHROMIUM, DESKTOP_PX, Tab, tab
from processes import Command, started
from served_bench import served_bench
from test_real_processes import ENDING_S, MILLING_S, WINDOW_S, Rig, patient, run_words, short_job, truth_of

from drivers.clock import SystemClock

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
SEEN = "scene.setpoints.filter(each => each.state === 'seen').length"
BOTH_EYES = f"{BRIGHT}(0) > 10 && {BRIGHT}(1) > 10"


@pytest.fixture(scope="module")
def browser() -> Iterator[Tab]:
    with tab() as opened:
        opened.size(DESKTOP_PX)
        yield opened


def opened_by(command: Command, browser: Tab) -> None:
    """Follow the link that a command tells first."""
    assert command.comes_to("open ", MILLING_S), command.said
    browser.open(command.out.split()[1])


@pytest.mark.slow
def test_calibrate_shows_its_setpoints_and_the_button_ends_it(browser: Tab, tmp_path: Path) -> None:
    out = tmp_path / "calibration.toml"
    with started("calibrate", "--emulate", "--live", "--out", str(out)) as calibrate:
        opened_by(calibrate, browser)
        browser.until(f"{SEEN} >= 1", MILLING_S)
        browser.until(f"now.tip_px?.length === 2 && {BOTH_EYES}")
        assert browser.ask("document.getElementById('stage').textContent") == "Calibrating"
        assert browser.ask("document.querySelectorAll('#map circle title').length === scene.setpoints.length")
        assert browser.ask("getComputedStyle(document.getElementById('ring')).display") == "none"
        browser.key("Escape")
        browser.until("document.getElementById('banner').innerText.includes('told to stop')")
        code = calibrate.end(ENDING_S)
    assert (code, calibrate.err) == (1, "mill: supervisor: it has stopped the motion: told to stop; home next\n")
    assert not out.exists()
    assert browser.complaints == []


@pytest.mark.long
def test_doctor_shows_its_checks_as_they_come_and_the_button_ends_it(
    browser: Tab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the drill turns and no motion controller is open, the button interrupts the command."""
    monkeypatch.chdir(tmp_path)
    with started("doctor", "--emulate", "--live") as doctor:
        opened_by(doctor, browser)
        browser.until("document.querySelectorAll('#checks li').length >= 10", MILLING_S)
        browser.until("now.detail === 'spindle: run-up'", MILLING_S)
        assert browser.ask("document.querySelector('#checks li .sign').textContent") in {"✓", "✕"}
        browser.key("Escape")
        browser.until("now.outcome?.outcome === 'interrupted'")
        code = doctor.end(ENDING_S)
    assert (code, doctor.err.strip()) == (130, "mill: interrupted")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Calibrated, with the page watching."""
    folder = tmp_path_factory.mktemp("bench")
    with served_bench(folder) as bench:
        rig = Rig(bench, short_job(bench), folder / "calibration.toml", folder / "calibrate.json")
        with started("calibrate", "--rig", str(rig.rig_file), "--out", str(rig.calibration)) as calibrate:
            assert calibrate.end(MILLING_S) == 0, calibrate.said
        yield rig


@pytest.mark.long
def test_a_window_is_followed_from_its_start_to_its_end(rig: Rig, browser: Tab, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with started("run", *run_words(patient(rig.bench, "whole.toml"), rig.calibration, folder), "--live") as run:
        opened_by(run, browser)
        browser.until(f"{BOTH_EYES} && scene.ring_px && scene.surface", MILLING_S)
        browser.until("document.getElementById('stage').textContent === 'Milling'", MILLING_S)
        browser.until("now.outcome && ended", WINDOW_S)
        code = run.end(ENDING_S)
    assert run.err == ""
    result = json.loads(folder.with_suffix(".json").read_text())
    assert code == (0 if result["outcome"] == "complete" else 1)
    assert browser.ask("now.outcome") == {name: result[name] for name in ("outcome", "reason")}
    assert browser.ask("now.points.depth") == [point["depth_mm"] for point in result["points"]]
    assert browser.complaints == []


@pytest.mark.long
def test_the_button_stops_a_run_that_is_frozen_with_its_drill_at_the_bone(
    rig: Rig, browser: Tab, tmp_path: Path
) -> None:
    """The run hears of it when it wakes, from its supervisor or from the controller, whichever it asks first."""
    clock, folder = SystemClock(), tmp_path / "run"
    with started("run", *run_words(rig.rig_file, rig.calibration, folder), "--live") as run:
        opened_by(run, browser)
        browser.until("now.stage === 'contact' && now.immediate", MILLING_S)
        run.process.send_signal(signal.SIGSTOP)
        browser.key("Escape")
        deadline_s = clock.now_s() + ENDING_S
        before = truth_of(rig)
        while (truth := truth_of(rig))["tip_mm"] != before["tip_mm"] or abs(truth["spindle_rpm"]) > 60.0:
            assert clock.now_s() < deadline_s, truth
            before = truth
        run.process.send_signal(signal.SIGCONT)
        code = run.end(ENDING_S)
    assert (code, run.err) == (1, ""), run.said
    result = json.loads(folder.with_suffix(".json").read_text())
    assert result["outcome"] == "aborted"
    assert any(words in result["reason"] for words in ("told to stop", "reset by somebody else")), result["reason"]
    assert truth_of(rig)["membrane_touched"] is False
