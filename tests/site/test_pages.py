"""What the pages tell to type is typed, and what they show is what comes."""

import contextlib
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pages import DOCS, Block, Step, blocks, fences, is_shown
from prepared import record
from reader import Reader, StandIn

sys.path.insert(0, str(Path(__file__).parent.parent / "cli"))

from processes import started
from served_bench import served_bench

PAGES = sorted(path.name for path in DOCS.glob("*.md") if blocks(path))
BY_HAND = {
    "index.md": ["python3 -m venv .venv", ".venv/bin/pip install -e .", ". .venv/bin/activate"],
    "first-rig.md": [
        "sudo cp udev/60-mill.rules /etc/udev/rules.d/ && sudo udevadm control --reload && sudo udevadm trigger"
    ],
}
"""What no test types: it needs a network or root."""

STUCK = "camera: the left eye sent the same bytes twice"
LEFT_BEHIND: dict[str, dict[str, StandIn]] = {
    "tutorial.md": {
        "mill run --rig": lambda folder: record(folder / "runs/first"),
        "mill run --emulate": lambda folder: record(folder / "runs/stuck", "aborted", STUCK),
    }
}
"""By page and command, what stands for the work of minutes."""
AT_FIRST: dict[str, StandIn] = {"after-a-crash.md": lambda folder: record(folder / "runs/crashed", None)}
"""By page, what its reader has when they come to it."""
LONG = [name for name in PAGES if any(block.takes_long for block in blocks(DOCS / name)) and name not in AT_FIRST]
KILLED_S = 300.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty one."""
    path = tmp_path / "work"
    path.mkdir()
    return path


@contextlib.contextmanager
def bench_for(page: list[Block], folder: Path, *, quick: bool) -> Iterator[None]:
    """The reader's rig: a served bench, where the page uses a rig file that it does not make itself."""
    commands = [step.command for block in page for step in block.steps if not (quick and block.takes_long)]
    if not any("--rig rig.toml" in command for command in commands) or any("--rig-out" in each for each in commands):
        yield
        return
    with served_bench(folder):
        yield


@pytest.mark.parametrize("name", PAGES)
def test_what_takes_no_minutes_is_as_the_page_shows(name: str, folder: Path) -> None:
    page = blocks(DOCS / name)
    if name in AT_FIRST:
        AT_FIRST[name](folder)
    with bench_for(page, folder, quick=True), Reader(folder, LEFT_BEHIND.get(name, {})) as reader:
        for block in page:
            reader.follow(block)


@pytest.mark.long
@pytest.mark.parametrize("name", LONG)
def test_a_reader_who_follows_the_page_reaches_its_end(name: str, folder: Path) -> None:
    page = blocks(DOCS / name)
    with bench_for(page, folder, quick=False), Reader(folder) as reader:
        for block in page:
            reader.follow(block)


@pytest.mark.long
def test_a_window_that_a_kill_left_behind_is_finished_as_the_page_shows(folder: Path) -> None:
    crashed, calibration = folder / "runs/crashed", folder / "calibration.toml"
    with served_bench(folder) as bench:
        rig = ("--rig", str(bench.rig_file))
        with started("calibrate", *rig, "--out", str(calibration)) as calibrate:
            assert calibrate.end(KILLED_S) == 0, calibrate.said
        with started("run", *rig, "--calibration", str(calibration), "--record", str(crashed)) as run:
            assert run.comes_to("mill: ", KILLED_S), run.said
            run.process.kill()
            run.process.wait(KILLED_S)
        with Reader(folder) as reader:
            for block in blocks(DOCS / "after-a-crash.md"):
                reader.follow(block)


def test_by_hand_is_only_what_no_test_can_type() -> None:
    found = {
        path.name: text.splitlines() for path in DOCS.glob("*.md") for kind, _, text in fences(path) if kind == "sh"
    }
    assert found == BY_HAND


def test_every_command_that_is_run_can_be_copied() -> None:
    for name in PAGES:
        for block in blocks(DOCS / name):
            for step in block.steps:
                assert shlex.split(step.command, comments=True) or not step.command, step


@pytest.mark.parametrize(
    ("shown", "said", "same"),
    [
        ("a  b\n", "a b\n", True),
        ("a b", "a\nb", True),
        ("a b", "a b c", False),
        ("a ... c", "a c", True),
        ("a ... c", "a b\nb c", True),
        ("a ... c", "ac", False),
        ("...\nc", "c", True),
        ("...\nc", "bc", False),
        ("a\n...", "a", True),
        ("a\n...", "ab", False),
        ("in ... s", "in 45 s", True),
        ("in ... s", "in 45 sec", False),
        ("x-...-left.png", "x-12.0-left.png", True),
        ("1.5", "1x5", False),
    ],
)
def test_dots_stand_for_anything_and_nothing_else_does(shown: str, said: str, same: bool) -> None:
    assert is_shown(shown, said) is same


@pytest.mark.parametrize(("shown", "title"), [("mill, version 9\n", ""), ("mill, version ...\n", "(exit code 2)")])
def test_a_page_that_shows_something_else_fails(folder: Path, shown: str, title: str) -> None:
    block = Block("x.md", title, (Step("mill --version", shown),))
    with Reader(folder) as reader, pytest.raises(AssertionError, match="the page shows"):
        reader.follow(block)
