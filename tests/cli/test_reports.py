"""The pages that people look at: whole, self-contained, alike, readable by everybody, and saying what was measured."""

import itertools
import re
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from a_calibration import a_calibration
from a_record import a_record
from mill_command import mill

from calib.calibration_file import Calibration
from cli.reports.calibration_report import write_calibration_report
from cli.reports.chart import Chart, ticks
from cli.reports.doctor_report import write_doctor_report
from cli.reports.run_report import write_report
from cli.reports.study_report import write_study_report
from cli.reports.train_report import write_train_report
from doctor.check import Check
from studies import completion_trials
from vision.training import History, Worst

sys.path.insert(0, str(Path(__file__).parent.parent / "live"))

from browser import CHROMIUM, Tab, tab

SHIFTS = {shift: {"mape": 0.12, "mape_low": 0.1, "mape_high": 0.15} for shift in completion_trials.SHIFTS[1:]}
RECIPES = {"default": {"trials": 2, "mape": 0.1, "mape_low": 0.08, "mape_high": 0.12, "shifts": SHIFTS}}
CHECKS = (
    Check("motion: hold to standstill", 64.5, "ms", "at most 250", True),
    Check("camera: age at delivery, median", 140.0, "ms", "at most 100", False, "use a shorter exposure"),
    Check("eyes: error of a fresh calibration", 0.07, "mm", "at most 0.15", True),
)
VOID = {"meta", "br", "hr", "img", "input", "link", "wbr"}
ENDED_THEMSELVES = {"line", "circle", "rect", "path", "polyline", "image"}


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return a_calibration()


def _run(folder: Path) -> Path:
    return write_report(a_record(folder / "run"))


def _calibration(folder: Path) -> Path:
    write_calibration_report(folder / "rig.html", a_calibration(), folder / "rig.toml", 31.4)
    return folder / "rig.html"


def _doctor(folder: Path) -> Path:
    devices = ("stage <7>", "drive", "eyes")
    write_doctor_report(folder / "rig.html", "rig", CHECKS, devices, None, datetime.now(UTC), certified=False)
    return folder / "rig.html"


def _study(folder: Path) -> Path:
    trials = {"a": {"mape": 0.1, "recipe": "default"}}
    write_study_report(folder / "report.html", "completion", RECIPES, completion_trials.PUBLISHED, trials)
    return folder / "report.html"


def _training(folder: Path) -> Path:
    worst = [Worst(np.full((20, 30, 3), 90, np.uint8), "ring 3, off by 0.4")]
    history = History([3.0, 2.0, 1.5], [(2, 2.1)])
    write_train_report(folder / "net.html", "tip network", {"task": "tip"}, {"tip_rmse_px": 0.6}, history, worst)
    return folder / "net.html"


def _comparison(folder: Path) -> Path:
    for name in ("one", "two"):
        a_record(folder / name)
    out = folder / "compare.html"
    assert mill("runs", "compare", str(folder / "one"), str(folder / "two"), "--out", str(out)) == 0
    return out


REPORTS: dict[str, Callable[[Path], Path]] = {
    "run": _run, "calibration": _calibration, "doctor": _doctor, "study": _study, "training": _training,
    "comparison": _comparison,
}  # fmt: skip


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: make(tmp_path_factory.mktemp(name)) for name, make in REPORTS.items()}


class Outline(HTMLParser):
    """The elements of a page, and whether each is ended in its place."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in ENDED_THEMSELVES | VOID, f"<{tag}/> does not end itself in HTML"
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> ends something else"

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.mark.parametrize("name", REPORTS)
def test_a_page_is_whole_and_fetches_nothing(pages: dict[str, Path], name: str) -> None:
    text = pages[name].read_text(encoding="utf-8")
    outline = Outline(text)
    assert outline.open == []
    for _, attributes in outline.elements:
        for key in ("src", "href", "data", "poster", "srcset"):
            assert str(attributes.get(key, "data:")).startswith("data:"), attributes
    assert "http" not in text
    assert not re.search(r"url\(|@import|\bimport\(|fetch\(|XMLHttpRequest", text)
    assert pages[name].stat().st_size < 1_000_000


@pytest.mark.parametrize("name", REPORTS)
def test_a_page_can_be_read_without_seeing_it(pages: dict[str, Path], name: str) -> None:
    outline = Outline(pages[name].read_text(encoding="utf-8"))
    assert outline.of("html")[0]["lang"] == "en"
    tags = [tag for tag, _ in outline.elements]
    assert tags.count("h1") == tags[: tags.index("body")].count("title") == 1
    headings = [int(tag[1]) for tag, _ in outline.elements if re.fullmatch(r"h[1-6]", tag)]
    assert all(after <= before + 1 for before, after in itertools.pairwise(headings)), "no level is skipped"
    for drawing in (*outline.of("svg"), *outline.of("canvas")):
        assert drawing["role"] == "img"
        assert drawing["aria-label"]
    assert all(picture["alt"] for picture in outline.of("img"))
    assert all(cell.get("scope") == "col" for cell in outline.of("th"))


def test_all_pages_share_one_look_and_the_picture_comes_first(pages: dict[str, Path]) -> None:
    sheets = {
        name: re.search(r"<style>(.*?@media print \{.*?\n\})", page.read_text(), re.DOTALL)
        for name, page in pages.items()
    }
    assert len({sheet[1] for sheet in sheets.values() if sheet}) == 1
    for name, page in pages.items():
        tags = [tag for tag, _ in Outline(page.read_text()).elements]
        first = min(tags.index(tag) for tag in ("svg", "img", "canvas") if tag in tags)
        # What failed is told before any picture.
        assert first < tags.index("table") or name == "doctor"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_colour_of_words_stands_out_from_its_ground(pages: dict[str, Path], scheme: str) -> None:
    """4.5 to 1, as WCAG 2.2 asks of text (1.4.3)."""
    sheet = pages["run"].read_text()
    found = re.findall(r":root \{(.*?)\}", sheet)[["light", "dark"].index(scheme)]
    colors = dict(re.findall(r"--(\w+):(#[0-9a-f]{6})", found))
    for words in ("ink", "soft", "good", "bad", "held"):
        for ground in ("paper", "ground"):
            light, dark = sorted((_luminance(colors[words]), _luminance(colors[ground])), reverse=True)
            assert (light + 0.05) / (dark + 0.05) >= 4.5, (words, ground)


def _luminance(color: str) -> float:
    """Relative luminance, WCAG 2.2."""
    shares = [int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_browser_shows_them_dark_and_prints_them_light(pages: dict[str, Path]) -> None:
    with tab() as browser:
        for name, page in pages.items():
            for media, scheme, ink in (
                ("screen", "light", "rgb(28, 29, 33)"),
                ("screen", "dark", "rgb(232, 233, 236)"),
                ("print", "dark", "rgb(28, 29, 33)"),
            ):
                _show(browser, page, media, scheme)
                assert browser.ask("getComputedStyle(document.body).color") == ink, (name, media, scheme)
                ground = browser.ask("getComputedStyle(document.body).backgroundColor")
                assert (ground == "rgba(0, 0, 0, 0)") == (media == "print")
                assert browser.ask("document.documentElement.scrollWidth <= innerWidth"), (
                    f"{name} is cut off on the right"
                )
            assert (
                browser.ask("performance.getEntriesByType('resource').filter(e => !e.name.startsWith('data:')).length")
                == 0
            )
            assert browser.complaints == []


def _show(browser: Tab, page: Path, media: Literal["screen", "print"], scheme: Literal["light", "dark"]) -> None:
    # A4 between its margins, at 96 dots to the inch.
    width = 687 if media == "print" else 1200
    browser.page.set_viewport_size({"width": width, "height": 900})
    browser.page.emulate_media(media=media, color_scheme=scheme)
    browser.open(page.as_uri())
    browser.until(f"document.readyState === 'complete' && location.href === '{page.as_uri()}'")


# What each says.


def test_a_calibrations_page_names_what_was_left_out(calibration: Calibration, pages: dict[str, Path]) -> None:
    text = pages["calibration"].read_text(encoding="utf-8")
    assert text.count("<td>left out</td>") == len(calibration.outliers) == 1
    assert text.count(", left out</title>") == 4, "a cross in every panel"
    assert "15 of 16" in text
    assert f"{calibration.rmse_mm:.3f} mm" in text
    assert "31 s" in text
    assert "stage &lt;7&gt;" in text, "names come from devices: they are text and never markup"


def test_a_studys_page_tells_simulation_from_the_paper(pages: dict[str, Path]) -> None:
    text = pages["study"].read_text(encoding="utf-8")
    assert "This is simulation" in text
    assert "0.1 (0.08 to 0.12)" in text
    assert "0.2432" in text
    assert all(f"<td>{shift}</td>" in text for shift in SHIFTS)
    assert all(f"{shift}: 0.12 (0.1 to 0.15)</title>" in text for shift in SHIFTS), "drawn as well"


def test_an_examinations_page_tells_what_failed_and_what_is_near_its_limit(pages: dict[str, Path]) -> None:
    text = pages["doctor"].read_text(encoding="utf-8")
    assert "1 of 3 checks failed" in text
    assert "use a shorter exposure" in text
    drawn = re.findall(r'class="name"[^>]*>([^<]+)<', text)
    assert drawn == [CHECKS[1].name, CHECKS[2].name, CHECKS[0].name], "the nearest to its limit first"
    assert "the paper: 0.77 mm" in text


@pytest.mark.parametrize("name", ["run", "calibration", "doctor", "training"])
def test_what_stands_beside_the_papers_figures_is_said(pages: dict[str, Path], name: str) -> None:
    text = pages[name].read_text(encoding="utf-8")
    assert "real tissue" in text
    assert "simulation" in text


def test_a_chart_places_data_between_its_edges() -> None:
    chart = Chart((10.0, 20.0), (0.0, 5.0), unit="s")
    assert chart.at(10.0, 0.0) == (chart.left, chart.bottom)
    assert chart.at(20.0, 5.0) == (chart.right, chart.top)
    assert [tick.text for tick in chart.across] == ["10 s", "12 s", "14 s", "16 s", "18 s", "20 s"]
    picture = Chart((0.0, 960.0), (540.0, 0.0), width=520.0, height=330.0, even=True)
    across = picture.at(100.0, 0.0)[0] - picture.at(0.0, 0.0)[0]
    assert picture.at(0.0, 100.0)[1] - picture.at(0.0, 0.0)[1] == pytest.approx(across, abs=0.1), "rows run downwards"
    losses = Chart((0.0, 1.0), (0.01, 10.0), logarithmic=True)
    middle = (losses.top + losses.bottom) / 2
    assert losses.at(0.0, 0.1 * 10.0**0.5)[1] == pytest.approx(middle, abs=0.1)
    assert [tick.text for tick in losses.up][:3] == ["0.01", "0.02", "0.05"]


@pytest.mark.parametrize("low", [-3.0, 0.0, 0.017])
@pytest.mark.parametrize("span", [1e-4, 0.3, 7.0, 540.0])
def test_ticks_are_few_and_lie_inside(low: float, span: float) -> None:
    found = ticks(low, low + span)
    assert 3 <= len(found) <= 7
    assert all(low - 1e-9 <= value <= low + span + 1e-9 for value in found)
    assert found == ticks(low + span, low)
    assert ticks(low, low) == [low]
