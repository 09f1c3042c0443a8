"""`mill runs`: what a person sees of past runs, whole, cut off or damaged."""

import json
from pathlib import Path
from typing import Any

import pytest
from mill_command import mill

from drivers.clock import SystemClock
from milling.record import RunRecorder

POINT = {"depth_mm": 0.31, "completion": 1.0, "contact_mm": -2.4, "state": "done", "why": "the picture says through"}
RESULT: dict[str, Any] = {
    "outcome": "complete",
    "reason": "every point is through, judged again with the drill aside",
    "milling_time_s": 81.6,
    "laps": 3.0,
    "points": [POINT] * 4,
}


def record(folder: Path, *, rig: str = "bench 7", result: dict[str, Any] | None = RESULT) -> Path:
    """A run's folder; without a result, of a process that was killed."""
    header = {"rig": rig, "date": "2026-05-04T09:00:00+00:00", "seed": None}
    with RunRecorder(folder, header, SystemClock()) as recorder:
        recorder.event("state", state="start")
        recorder.event("lap", lap=1, depth_mm=[0.1] * 4, completion=[0.3] * 4)
        if result is not None:
            recorder.event("outcome", **result)
        recorder.close(result)
    return folder


@pytest.fixture(autouse=True)
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of runs where `mill` looks for them."""
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("exists", [True, False])
def test_no_runs_yet_says_how_to_make_one(runs: Path, exists: bool, capsys: pytest.CaptureFixture[str]) -> None:
    if exists:
        runs.mkdir()
    assert mill("runs", "list") == 0
    assert capsys.readouterr().out == "runs: no runs yet; `mill run --emulate` makes one\n"


def test_the_list_has_a_line_for_each_run_however_it_ended(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(runs / "a")
    record(runs / "b", result=None)
    damaged = record(runs / "c") / "events.jsonl"
    damaged.write_bytes(b"x" + damaged.read_bytes())
    headless = record(runs / "d") / "header.json"
    headless.write_text("{")
    (runs / "no run").mkdir()
    assert mill("runs", "list", "--json", "list.json") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["run", "outcome", "milling", "reason"]
    assert lines[1].split(maxsplit=4) == ["a", "complete", "82", "s", RESULT["reason"]]
    assert lines[2].split(maxsplit=3)[:3] == ["b", "cut", "off"]
    assert lines[3].split(maxsplit=2)[:2] == ["c", "damaged"]
    assert "events.jsonl line 1" in lines[3]
    assert lines[4].split(maxsplit=2)[:2] == ["d", "damaged"]
    assert "header.json" in lines[4]
    assert len(lines) == 5
    listed = json.loads(Path("list.json").read_text())["runs"]
    assert [(run["run"], run["outcome"]) for run in listed] == [
        ("a", "complete"),
        ("b", "cut off"),
        ("c", "damaged"),
        ("d", "damaged"),
    ]


def test_a_run_is_shown_with_every_point(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(runs / "a")
    assert mill("runs", "show", "a") == 0
    said = capsys.readouterr().out
    for part in ("bench 7", "2026-05-04T09:00:00", "complete", RESULT["reason"], "82 s", "damage  none"):
        assert part in said
    points = said.splitlines()[-4:]
    assert [line.split(maxsplit=5) for line in points] == [
        [str(number), "-2.400", "0.310", "1.00", "done", POINT["why"]] for number in range(1, 5)
    ]


def test_results_for_machines_alone_on_stdout(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(runs / "a")
    assert mill("runs", "show", "runs/a", "--json", "-") == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["command"], shown["outcome"], shown["damage"]) == ("runs show", "complete", None)
    assert shown["points"] == [POINT] * 4


def test_a_torn_line_of_a_killed_run_is_named_and_the_rest_is_shown(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    events = record(runs / "a", result=None) / "events.jsonl"
    events.write_bytes(events.read_bytes() + b'0badc0de {"t":1.0,"ki')
    before = contents(runs)
    assert mill("runs", "show", "a") == 0
    said = capsys.readouterr().out
    for part in ("cut off", "events.jsonl line 3: torn", "the rest is whole"):
        assert part in said
    assert mill("runs", "report", "a") == 0
    assert "not finished" in Path(capsys.readouterr().out.strip()).read_text()
    assert contents(runs).items() >= before.items()


def test_the_report_is_written_anew(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = record(runs / "a")
    (folder / "report.html").write_text("old")
    assert mill("runs", "report", "a") == 0
    assert capsys.readouterr().out == "runs/a/report.html\n"
    assert "every point is through" in (folder / "report.html").read_text()


@pytest.mark.parametrize("command", ["show", "report"])
def test_a_run_that_is_not_there_names_the_next_step(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("runs", command, "yesterday") == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == "mill: yesterday: no such run, here or in runs; `mill runs list` lists them\n"


@pytest.mark.parametrize("command", ["show", "report"])
@pytest.mark.parametrize("name", ["events.jsonl", "header.json", "result.json"])
def test_a_damaged_record_is_one_line_and_nothing_is_lost(
    runs: Path, name: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = record(runs / "a") / name
    file.write_bytes(b"?" + file.read_bytes())
    before = contents(runs)
    assert mill("runs", command, "a") == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    for part in ("runs/a", name, "damage"):
        assert part in said.err
    assert contents(runs) == before


def test_without_a_verb_the_help_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("runs") == 2
    assert capsys.readouterr().err == "mill: Missing command; see `mill runs --help`\n"
