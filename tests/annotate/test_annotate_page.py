"""The page in a real browser: with the mouse, with the keyboard alone, with a second person, over a killed server."""

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "live"))

from bench_album import Known, bench_album
from browser import CHROMIUM, Tab, tab

from studies.annotation_walk import browser_at, page_of

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
CODES = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "PageDown": 34, "Enter": 13, "Delete": 46}
SAVED = "$('saved').textContent === '✓ saved'"
ANY_S = 60.0
"""A network's first answer takes some seconds on a busy machine."""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Known]]:
    folder = tmp_path_factory.mktemp("bench") / "album"
    return folder, bench_album(folder, 1)


@pytest.fixture(scope="module")
def browser() -> Iterator[Tab]:
    with tab() as opened:
        opened.size(1440, 900)
        yield opened


@pytest.fixture
def album(drawn: tuple[Path, list[Known]], tmp_path: Path) -> Path:
    return Path(shutil.copytree(drawn[0], tmp_path / "album"))


def labels(album: Path, annotator: str = "anna") -> dict:
    file = album / "annotations" / f"{annotator}.json"
    return json.loads(file.read_text())["labels"] if file.is_file() else {}


def press(browser: Tab, *keys: str, shift: bool = False) -> None:
    for key in keys:
        code = CODES.get(key, ord(key.upper()) if len(key) == 1 else 0)
        words = {"key": key, "windowsVirtualKeyCode": code, "modifiers": 8 * shift}
        browser.do("Input.dispatchKeyEvent", type="keyDown", **words)
        browser.do("Input.dispatchKeyEvent", type="keyUp", **words)


def mouse(browser: Tab, *path: tuple[float, float]) -> None:
    """Press at the first of some places of the picture, draw along the others, let go."""
    for k, (x, y) in enumerate(path):
        at = browser.ask(f"(b => to({x}, {y}).map((v, i) => v + [b.left, b.top][i]))(canvas.getBoundingClientRect())")
        kinds = ["mousePressed"] if k == 0 else ["mouseMoved"]
        kinds += ["mouseReleased"] if k == len(path) - 1 else []
        for kind in kinds:
            browser.do("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], button="left", buttons=1, clickCount=1)


def opened(browser: Tab, address: str, *, suggesting: bool = False) -> None:
    browser.open(address)
    browser.until("bitmap !== null", ANY_S)
    # The page before this one may have complained that its server was gone.
    browser.complaints.clear()
    if suggesting:
        browser.until("Object.keys(suggested).length === 2", ANY_S)
    elif browser.ask("$('suggesting').checked"):
        press(browser, "s")


def test_suggestions_are_accepted_or_moved_and_every_click_is_saved(
    album: Path, drawn: tuple[Path, list[Known]], browser: Tab
) -> None:
    (known,) = drawn[1]
    with page_of(album, "anna", "--task", "landmarks") as (_, address):
        opened(browser, address, suggesting=True)
        press(browser, "Enter")
        browser.until(f"{SAVED} && here().settled", ANY_S)
        said = labels(album)["mouse-1-before.png"]["points"]
        assert {name: place["origin"] for name, place in said.items()} == {"bregma": "accepted", "lambda": "accepted"}
        assert np.hypot(said["bregma"]["x_px"] - known.bregma[0], said["bregma"]["y_px"] - known.bregma[1]) < 10

        press(browser, "PageDown")
        browser.until("bitmap !== null && here().name === 'mouse-1.png'", ANY_S)
        mouse(browser, known.bregma)
        mouse(browser, known.lambda_)
        browser.until(f"{SAVED} && here().settled", ANY_S)
        said = labels(album)["mouse-1.png"]["points"]
        for name, place in (("bregma", known.bregma), ("lambda", known.lambda_)):
            assert [said[name]["x_px"], said[name]["y_px"]] == pytest.approx(place, abs=1.5)
            assert said[name].get("origin", "hand") == "hand"
        assert browser.ask("$('done').textContent") == "2 of 2 done"
        assert browser.complaints == []


def test_the_keyboard_alone_is_enough(album: Path, browser: Tab) -> None:
    with page_of(album, "anna", "--task", "landmarks", "--task", "tip") as (_, address):
        opened(browser, address)
        press(browser, "b", " ")
        x, y = browser.ask("[label().points.bregma.x_px, label().points.bregma.y_px]")
        press(browser, "ArrowRight", "ArrowDown")
        press(browser, "ArrowLeft", shift=True)
        press(browser, "l", "n", "t", "n")
        browser.until(f"{SAVED} && here().settled", ANY_S)
        said = labels(album)["mouse-1-before.png"]["points"]
        assert [said["bregma"]["x_px"], said["bregma"]["y_px"]] == pytest.approx([x + 1 - 10, y + 1])
        assert (said["lambda"], said["tip"]) == ("unseen", "unseen")
        press(browser, "l", "Delete")
        browser.until(f"{SAVED} && !here().settled", ANY_S)
        assert "lambda" not in labels(album)["mouse-1-before.png"]["points"]


def test_a_ring_is_placed_painted_and_read(album: Path, drawn: tuple[Path, list[Known]], browser: Tab) -> None:
    (known,) = drawn[1]
    ring = known.ring
    with page_of(album, "anna", "--task", "completion") as (_, address):
        opened(browser, address)
        press(browser, "PageDown")
        browser.until("bitmap !== null && here().name === 'mouse-1.png'", ANY_S)
        press(browser, "r")
        mouse(browser, (ring["center_x_px"], ring["center_y_px"]))
        for name in ("radius", "ball"):
            browser.ask(f"$('{name}').value = {ring[name + '_px']}; $('{name}').dispatchEvent(new Event('change'))")
        press(browser, "p", "x", "ArrowRight", "3", "ArrowRight", "u")
        edge = [
            (
                ring["center_x_px"] + ring["radius_px"] * np.cos(a),
                ring["center_y_px"] + ring["radius_px"] * np.sin(a),
            )
            for a in np.linspace(1.0, 2.0, 12)
        ]
        browser.ask("take(0.8)")
        mouse(browser, *edge)
        browser.until(SAVED, ANY_S)
        said = labels(album)["mouse-1.png"]["ring"]
        assert said["completion"][:3] == [1.0, 0.3, None]
        assert said["completion"][5:11] == [0.8] * 6
        assert [said["center_x_px"], said["radius_px"]] == pytest.approx(
            [ring["center_x_px"], ring["radius_px"]], abs=1.5
        )
        before = "mouse-1-before.png"
        browser.ask(f"$('reference').value = '{before}'; $('reference').dispatchEvent(new Event('change'))")
        press(browser, "Enter")
        browser.until("ring().completion.filter(share => share === null).length < 8", ANY_S)
        browser.until(SAVED, ANY_S)
        said = labels(album)["mouse-1.png"]["ring"]
        assert (said["reference"], said["origin"]) == (before, "moved")
        read = [k for k in range(12, 32) if said["completion"][k] is not None]
        off = [abs(said["completion"][k] - known.completion[k]) for k in read]
        assert len(read) > 12
        assert np.mean(off) < 0.15
        assert browser.complaints == []


def test_what_is_marked_without_a_connection_waits_and_is_saved_when_it_is_back(album: Path, browser: Tab) -> None:
    with page_of(album, "anna", "--task", "tip") as (process, address):
        opened(browser, address)
        browser.ask("socket.close()")
        browser.until("$('banner').textContent.startsWith('No connection')")
        press(browser, "t", " ")
        browser.until(f"{SAVED} && here().settled && $('banner').textContent === ''", ANY_S)
        assert labels(album)["mouse-1-before.png"]["points"]["tip"]["x_px"] > 0
        process.kill()
        browser.until("$('banner').textContent.includes('open its new link')")
        press(browser, "Delete")
        assert browser.ask("$('saved').textContent") == "1 not saved"
        # Or the browser would ask whether to leave.
        browser.ask("unsaved.clear()")
    assert "tip" in labels(album)["mouse-1-before.png"]["points"], "what was saved before the kill stays"


def test_the_others_are_shown_once_a_picture_is_done(album: Path, browser: Tab) -> None:
    name = "mouse-1-before.png"
    with page_of(album, "ben") as (_, address), browser_at(address) as other:
        points = {"bregma": {"x_px": 400, "y_px": 200}, "lambda": {"x_px": 400, "y_px": 310}}
        other.ask(do="put", picture=name, label={"points": points})
    with page_of(album, "anna", "--task", "landmarks") as (_, address):
        opened(browser, address)
        assert browser.ask("album.theirs") == {}
        mouse(browser, (403.0, 204.0))
        mouse(browser, (400.0, 310.0))
        browser.until(f"{SAVED} && here().settled && !$('comparing').classList.contains('hidden')", ANY_S)
        assert "bregma" in browser.ask("$('here').innerText")
        apart = browser.ask(f"album.apart['{name}'].find(each => each.what === 'bregma')")
        assert apart["px"] == pytest.approx(5.0, abs=1.0)
        assert apart["mm"] == pytest.approx(apart["px"] * 4.2 / 108, rel=0.05)
        assert "ben" in browser.ask("$('summary').innerText")
