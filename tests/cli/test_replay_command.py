"""`mill runs replay`: what a person sees of decisions taken again."""

import json
from dataclasses import asdict
from math import cos, pi, sin
from pathlib import Path

import pytest
from mill_command import mill

from firmware_sim.clock import SimClock
from milling.job import Job
from milling.record import RunRecorder

JOB = Job(n_points=8)


def record(folder: Path, *, granted_mm: float = 0.013, job: Job = JOB) -> Path:
    """A ring that was touched, seen, and asked about once."""
    angles = [2 * pi * k / job.n_points for k in range(1, job.n_points + 1)]
    with RunRecorder(folder, {"job": asdict(job)}, SimClock()) as told:
        told.event("trajectory", tip_mm=[(2 * cos(a), 2 * sin(a), 0.0) for a in angles])
        for point in range(1, job.n_points + 1):
            told.event("contact", point=point, z_mm=0.0, predicted_mm=0.0)
        bone = [0.1] * job.n_points
        told.event("reading", age_s=0.05, completion=bone, upper=bone, shown="s" * job.n_points)
        told.event("asked", point=3, bite_mm=0.013, frame_age_s=0.05, depth_mm=granted_mm, reason="")
    return folder


def test_what_is_decided_the_same_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("runs", "replay", str(record(tmp_path / "a"))) == 0
    assert capsys.readouterr().out == "decisions  1, otherwise at 0 visits\n"


def test_the_first_difference_is_told_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(tmp_path / "a", granted_mm=0.02)
    assert mill("runs", "replay", str(path), "--json", str(tmp_path / "replay.json")) == 0
    out = capsys.readouterr().out
    assert "decisions  1, otherwise at 1 visits" in out
    assert "point 3: down to 0.020 mm then, down to 0.013 mm now" in out
    assert json.loads((tmp_path / "replay.json").read_text())["differences"][0]["point"] == 3


@pytest.mark.parametrize("policy", ["paper", "previous"])
def test_a_published_policy_is_compared_at_every_visit(
    policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert mill("runs", "replay", str(record(tmp_path / "a")), "--policy", policy) == 0
    assert "decisions  1, otherwise at 1 visits" in capsys.readouterr().out


def test_what_cannot_be_replayed_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paper = record(tmp_path / "paper", job=Job(n_points=8, policy="paper"))
    blind = record(tmp_path / "blind")
    for words, said in (
        ((str(paper),), "ran with policy 'paper'"),
        ((str(blind), "--weights", "no.onnx"), "ended before its ring was seen"),
        ((str(tmp_path / "none"),), "no such run"),
    ):
        assert mill("runs", "replay", *words) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
