"""The page in a real browser: with the mouse, with the keyboard alone, with a second person, over a killed server."""

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from bench_album import Known, bench_album
from desk_tab import SAVED, Tab, opened, tab

from studies.annotation_walk import browser_at, page_of
from studies.chromium import CHROMIUM

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Known]]:
    folder = tmp_path_factory.mktemp("bench") / "album"
    return folder, bench_album(folder, 1)


@pytest.fixture(scope="module")
def browser() -> Iterator[Tab]:
    with tab() as one:
        yield one


@pytest.fixture
def album(drawn: tuple[Path, list[Known]], tmp_path: Path) -> Path:
    return Path(shutil.copytree(drawn[0], tmp_path / "album"))


def labels(album: Path, annotator: str = "anna") -> dict:
    file = album / "annotations" / f"{annotator}.json"
    return json.loads(file.read_text())["labels"] if file.is_file() else {}


def test_suggestions_are_accepted_or_moved_and_every_click_is_saved(
    album: Path, drawn: tuple[Path, list[Known]], browser: Tab
) -> None:
    (known,) = drawn[1]
    with page_of(album, "anna", "--task", "landmarks") as (_, address):
        opened(browser, address, suggesting=True)
        browser.press("Enter")
        browser.until(f"{SAVED} && here().settled")
        said = labels(album)["mouse-1-before.png"]["points"]
        assert {name: place["origin"] for name, place in said.items()} == {"bregma": "accepted", "lambda": "accepted"}
        assert np.hypot(said["bregma"]["x_px"] - known.bregma[0], said["bregma"]["y_px"] - known.bregma[1]) < 10

        browser.press("PageDown")
        browser.until("bitmap !== null && here().name === 'mouse-1.png'")
        browser.draw(known.bregma)
        browser.draw(known.lambda_)
        browser.until(f"{SAVED} && here().settled")
        said = labels(album)["mouse-1.png"]["points"]
        for name, place in (("bregma", known.bregma), ("lambda", known.lambda_)):
            assert [said[name]["x_px"], said[name]["y_px"]] == pytest.approx(place, abs=1.5)
            assert said[name].get("origin", "hand") == "hand"
        assert browser.ask("$('done').textContent") == "2 of 2 done"
        assert browser.complaints == []


def test_the_keyboard_alone_is_enough(album: Path, browser: Tab) -> None:
    with page_of(album, "anna", "--task", "landmarks", "--task", "tip") as (_, address):
        opened(browser, address)
        browser.press("b", "Space")
        x, y = browser.ask("[label().points.bregma.x_px, label().points.bregma.y_px]")
        browser.press("ArrowRight", "ArrowDown")
        browser.press("Shift+ArrowLeft")
        browser.press("l", "n", "t", "n")
        browser.until(f"{SAVED} && here().settled")
        said = labels(album)["mouse-1-before.png"]["points"]
        assert [said["bregma"]["x_px"], said["bregma"]["y_px"]] == pytest.approx([x + 1 - 10, y + 1])
        assert (said["lambda"], said["tip"]) == ("unseen", "unseen")
        browser.press("l", "Delete")
        browser.until(f"{SAVED} && !here().settled")
        assert "lambda" not in labels(album)["mouse-1-before.png"]["points"]


def test_a_ring_is_placed_painted_and_read(album: Path, drawn: tuple[Path, list[Known]], browser: Tab) -> None:
    (known,) = drawn[1]
    ring = known.ring
    with page_of(album, "anna", "--task", "completion") as (_, address):
        opened(browser, address)
        browser.press("PageDown")
        browser.until("bitmap !== null && here().name === 'mouse-1.png'")
        browser.press("r")
        browser.draw((ring["center_x_px"], ring["center_y_px"]))
        for name in ("radius", "ball"):
            browser.ask(f"$('{name}').value = {ring[name + '_px']}; $('{name}').dispatchEvent(new Event('change'))")
        browser.press("p", "x", "ArrowRight", "3", "ArrowRight", "u")
        edge = [
            (
                ring["center_x_px"] + ring["radius_px"] * np.cos(a),
                ring["center_y_px"] + ring["radius_px"] * np.sin(a),
            )
            for a in np.linspace(1.0, 2.0, 12)
        ]
        browser.ask("take(0.8)")
        browser.draw(*edge)
        browser.until(SAVED)
        said = labels(album)["mouse-1.png"]["ring"]
        assert said["completion"][:3] == [1.0, 0.3, None]
        assert said["completion"][5:11] == [0.8] * 6
        assert [said["center_x_px"], said["radius_px"]] == pytest.approx(
            [ring["center_x_px"], ring["radius_px"]], abs=1.5
        )
        before = "mouse-1-before.png"
        browser.ask(f"$('reference').value = '{before}'; $('reference').dispatchEvent(new Event('change'))")
        browser.press("Enter")
        browser.until("ring().completion.filter(share => share === null).length < 8")
        browser.until(SAVED)
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
        browser.press("t", "Space")
        browser.until(f"{SAVED} && here().settled && $('banner').textContent === ''")
        assert labels(album)["mouse-1-before.png"]["points"]["tip"]["x_px"] > 0
        process.kill()
        browser.until("$('banner').textContent.includes('open its new link')")
        browser.press("Delete")
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
        browser.draw((403.0, 204.0))
        browser.draw((400.0, 310.0))
        browser.until(f"{SAVED} && here().settled && !$('comparing').classList.contains('hidden')")
        assert "bregma" in browser.ask("$('here').innerText")
        apart = browser.ask(f"album.apart['{name}'].find(each => each.what === 'bregma')")
        assert apart["px"] == pytest.approx(5.0, abs=1.0)
        assert apart["mm"] == pytest.approx(apart["px"] * 4.2 / 108, rel=0.05)
        assert "ben" in browser.ask("$('summary').innerText")
