"""`mill train` and `mill evaluate`, at the smallest size that still makes a network and measures it."""

import json
from pathlib import Path

import pytest
from mill_command import mill

from studies.datasets import SPLITS
from vision.completion_training import CompletionTask
from vision.training import Recipe


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in; a specimen for each split and two steps of training."""
    monkeypatch.chdir(tmp_path)
    for split in SPLITS.values():
        monkeypatch.setitem(split.specimens, "completion", 1)
    monkeypatch.setattr(CompletionTask, "recipes", {"default": Recipe(steps=2, batch=2, learning_rate=1e-3)})
    return tmp_path


def test_a_network_is_trained_measured_and_measured_again(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("train", "completion", "--out", "new/completion.onnx", "--seed", "3") == 0
    said = capsys.readouterr()
    assert said.out == ""
    for part in ("new/completion.onnx", "upper_bound_coverage"):
        assert part in said.err
    manifest = json.loads((tiny / "new/manifest.json").read_text())["completion.onnx"]
    assert (manifest["task"], manifest["seed"], manifest["steps"]) == ("completion", 3, 2)
    made = sorted(path.name for path in (tiny / "new").iterdir())
    assert made == ["completion.card.html", "completion.data", "completion.html", "completion.onnx", "manifest.json"]
    page = (tiny / "new/completion.html").read_text()
    for part in ("upper_bound_coverage", "data:image/jpeg", "validation pictures", "polyline"):
        assert part in page
    card = (tiny / "new/completion.card.html").read_text()
    for part in (manifest["sha256"], "none of it says anything about tissue", "penetration_recall"):
        assert part in card

    again = [
        "evaluate",
        "completion",
        "--weights",
        "new/completion.onnx",
        "--data",
        "new/completion.data",
        "--json",
        "-",
    ]
    assert mill(*again) == 0
    results = json.loads(capsys.readouterr().out)
    assert results["command"] == "evaluate completion"
    assert results["weights_sha256"] == manifest["sha256"]
    for name in ("rmse", "upper_bound_coverage"):
        assert results[name] == manifest["held_out"][name]
    assert [results["rmse_low"], results["rmse_high"]] == manifest["held_out_95"]["rmse"]
    assert results["rmse_low"] < results["rmse"] < results["rmse_high"]

    (tiny / "new/completion.onnx").write_bytes(b"another network")
    assert mill(*again) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert manifest["sha256"] in said.err


def test_mills_own_network_is_measured_on_a_specimen_of_a_file(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tiny / "specimens").mkdir()
    (tiny / "specimens/one.toml").write_text("schema = 1\nseed = 30000001\n")
    assert mill("evaluate", "tip", "--specimens", "specimens", "--json", "-") == 0
    results = json.loads(capsys.readouterr().out)
    assert results["pictures"] > 0
    assert 0.0 < results["tip_rmse_px"] < 10.0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["train", "mouse", "--out", "x.onnx"], ["TASK", "mouse", "landmarks", "mill train --help"]),
        (["train", "tip"], ["--out"]),
        (["train", "tip", "--recipe", "mine", "--out", "x.onnx"], ["--recipe", "mine", "paper", "default"]),
        (["train", "tip", "--out", "file/x.onnx"], ["file", "name another place"]),
        (["train", "tip", "--out", "."], ["--out", "directory"]),
        (["evaluate", "mouse"], ["TASK", "mouse", "landmarks", "mill evaluate --help"]),
        (["evaluate", "tip", "--weights", "nowhere.onnx"], ["--weights", "nowhere.onnx", "does not exist"]),
        (["evaluate", "tip", "--weights", "file"], ["file", "SHA-256", "manifest.json"]),
        (["evaluate", "tip", "--data", "nowhere"], ["--data", "nowhere", "does not exist"]),
        (["evaluate", "tip", "--data", "empty"], ["empty/test", "no .npy"]),
        (["evaluate", "tip", "--specimens", "empty"], ["empty", "no specimen files"]),
        (["evaluate", "tip", "--specimens", "empty", "--data", "empty"], ["--data and --specimens"]),
        (["evaluate", "tip", "--json", "no/folder/x.json"], ["no/folder", "--json"]),
    ],
)
def test_wrong_words_are_one_line_and_make_nothing(
    words: list[str], says: list[str], tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tiny / "file").write_text("no folder and no network")
    (tiny / "empty").mkdir()
    assert mill(*words) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.strip().count("\n")) == ("", 0)
    for part in says:
        assert part in said.err
    assert sorted(path.name for path in tiny.rglob("*")) == ["empty", "file"]
