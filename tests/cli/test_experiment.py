"""`mill experiment`: what it takes, tells and refuses; what is measured is tested in tests/studies."""

import json
from pathlib import Path

import pytest
from mill_command import mill

from studies import completion_trials
from vision.runtime import write_manifest


@pytest.fixture
def short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in; two moments of a run, seen clean, and no time for speed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(completion_trials, "STAGES", 2)
    monkeypatch.setattr(completion_trials, "SHIFTS", ("clean", "gamma"))
    monkeypatch.setattr("benchmarks.completion_speed.measure", lambda: {"ring_rate_hz": 5.0})
    return tmp_path


def test_completion_is_told_by_recipe_and_nothing_is_kept_unasked(
    short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (short / "mice").mkdir()
    (short / "mice/dry.toml").write_text("[appearance]\nwetness = 0.0\n")
    words = ["--specimens", "mice", "--workers", "1", "--json", "-"]
    assert mill("experiment", "completion", *words) == 0
    said = capsys.readouterr()
    results = json.loads(said.out)
    assert results["recipes"] == ["default"]
    assert results["default"]["trials"] == 1
    assert results["default"]["ring_rate_hz"] == 5.0
    assert set(results["default"]["shifts"]) == {"gamma"}
    assert results["published"]["mape"] == 0.2432
    assert "by shift" in said.err
    assert [path.name for path in short.iterdir()] == ["mice"]


def test_a_study_with_a_folder_leaves_a_report(short: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--specimens-count", "1", "--seed", "4", "--workers", "1", "--out", "study"]
    assert mill("experiment", "completion", *words) == 0
    assert "report: study/report.html" in capsys.readouterr().out
    assert {path.name for path in (short / "study").iterdir()} == {
        "specimen-4-default-clean.json",
        "specimen-4-default-gamma.json",
        "report.html",
    }


def test_a_folder_without_specimens_is_refused(short: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (short / "empty").mkdir()
    assert mill("experiment", "surface", "--specimens", "empty") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "no specimen files" in said


def test_weights_of_another_recipe_are_not_the_papers(short: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from vision.completion import CompletionReader

    mine = short / "mine.onnx"
    mine.write_bytes(CompletionReader.weights.read_bytes())
    write_manifest(mine, {"task": "completion", "recipe": "default"})
    assert mill("experiment", "completion", "--paper-weights", str(mine)) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for part in ("mine.onnx", "'paper' is needed", "--recipe paper"):
        assert part in said
