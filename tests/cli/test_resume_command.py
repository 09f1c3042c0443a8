"""`mill resume`: what it refuses before anything moves. That it goes on is tested in tests/milling and tests/e2e."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest
from mill_command import mill

from firmware_sim.clock import SimClock
from milling.job import Job
from milling.record import RunRecorder


def record(folder: Path, **header: object) -> Path:
    with RunRecorder(folder, {"command": "run", "seed": None, "job": asdict(Job()), **header}, SimClock()) as recorder:
        recorder.event("state", state="start")
    return folder


@pytest.mark.parametrize(
    ("header", "words", "says"),
    [
        ({}, [], "give --rig FILE"),
        ({"seed": 3}, ["--rig", "rig.toml"], "its virtual bench ended with it"),
        ({"job": None}, ["--rig", "rig.toml"], "key job: found None"),
        ({}, ["--rig", "rig.toml"], "before all contacts were known; nothing is milled"),
        ({"job": {**asdict(Job()), "policy": "paper"}}, ["--rig", "rig.toml"], "policy 'paper' felt nothing"),
    ],
)
def test_what_cannot_be_resumed_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    header: dict[str, object],
    words: list[str],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "runs/first", **header)
    before = sorted(tmp_path.rglob("*"))
    assert mill("resume", "first", *words) == 2
    said = capsys.readouterr().err.strip()
    assert says in said
    assert "\n" not in said
    assert sorted(tmp_path.rglob("*")) == before


def test_a_complete_window_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (record(tmp_path / "runs/first") / "result.json").write_text(json.dumps({"outcome": "complete"}))
    assert mill("resume", "first", "--rig", "rig.toml") == 2
    assert "its window is complete" in capsys.readouterr().err
