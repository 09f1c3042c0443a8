"""What a person can get wrong: one clear line, exit code 2, no traceback, nothing opened or moved."""

import json
import shutil
from pathlib import Path

import pytest
from mill_command import mill
from rig_file import GOOD

import vision.runtime


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A rig file whose devices do not exist: touching one would be another error than the one that is expected."""
    path = tmp_path / "rig.toml"
    path.write_text(GOOD)
    return path


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("command", ["run", "calibrate"])
def test_missing_weights_of_ones_own_are_named(command: str, rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig.write_text(GOOD + '\n[weights]\ntip = "mine.onnx"\n')
    assert mill(command, "--rig", "rig.toml") == 2
    said = capsys.readouterr().err
    for part in ("mine.onnx", "no such weights", "mill train tip"):
        assert part in said


@pytest.mark.parametrize(
    ("command", "words", "says"),
    [
        ("doctor", ["--rig", "nowhere.toml"], ["nowhere.toml", "no such rig file", "mill emulate"]),
        ("run", ["--rig", "rig.toml", "--radius", "9"], ["radius_mm", "9", "2 to 4"]),
        ("run", ["--rig", "rig.toml", "--feed", "50"], ["feed_mm_s", "50", "5"]),
        ("run", ["--rig", "rig.toml"], ["calibrations", "no such calibration file", "mill calibrate"]),
        ("run", ["--rig", "rig.toml", "--calibration", "rig.toml"], ["rig.toml", "not a calibration file"]),
        ("calibrate", ["--rig", "rig.toml", "--verify"], ["no such calibration file", "mill calibrate"]),
        ("calibrate", ["--rig", "rig.toml", "--json", "no/folder/x.json"], ["no/folder", "make it", "--json"]),
        ("emulate", ["--seed", "-1"], ["--seed", "-1"]),
        ("emulate", ["--specimen", "nowhere.toml"], ["nowhere.toml"]),
        ("emulate", ["--rig-out", "no/folder/rig.toml"], ["no/folder", "make it"]),
        ("run", ["--emulate", "--specimen", "nowhere.toml"], ["nowhere.toml", "no such specimen file"]),
        ("run", [], ["--emulate", "--rig FILE"]),
        ("run", ["--emulate", "--rig", "rig.toml"], ["--emulate", "--rig FILE"]),
        ("doctor", ["--rig", "rig.toml", "--specimen", "x.toml"], ["--specimen belongs to --emulate"]),
        ("jog", ["--rig", "rig.toml", "--to", "0", "0", "0", "--by", "0", "0", "1"], ["--to and --by"]),
        ("stop", [], ["--rig FILE"]),
    ],
)
def test_wrong_words_are_named(
    command: str,
    words: list[str],
    says: list[str],
    rig: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert mill(command, *words) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    for part in says:
        assert part in said
    assert sorted(path.name for path in rig.parent.iterdir()) == ["rig.toml"]


def test_an_unknown_key_of_a_specimen_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mouse.toml").write_text("schema = 1\n[skull]\nthickness = 3\n")
    assert mill("emulate", "--specimen", "mouse.toml") == 2
    said = capsys.readouterr().err
    for part in ("mouse.toml", "skull.thickness", "thickness_mm"):
        assert part in said
    assert said.count("\n") == 1


def test_an_absent_device_names_path_reason_and_next_step(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("jog", "--rig", str(rig), "--home") == 3
    said = capsys.readouterr().err
    for part in ("/dev/mill-motion", "no such", "mill devices"):
        assert part.lower() in said.lower()


def test_doctor_goes_on_to_the_next_device(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    results = tmp_path / "doctor.json"
    assert mill("doctor", "--rig", str(rig), "--json", str(results)) == 1
    checks = json.loads(results.read_text())["checks"]
    devices = [check for check in checks if not check["name"].startswith("computer: ")]
    assert [(check["name"], check["verdict"]) for check in devices] == [
        ("motion: answers", "fail"),
        ("spindle: answers", "fail"),
        ("camera: answers", "fail"),
    ]
    assert "/dev/mill-spindle" in devices[1]["value"]
    assert f"3 of {len(checks)} checks failed" in capsys.readouterr().out


def test_stop_tries_both_devices_and_names_what_it_could_not_stop(
    rig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert mill("stop", "--rig", str(rig)) == 3
    said = capsys.readouterr().err
    for part in ("motion: /dev/mill-motion", "spindle: /dev/mill-spindle", "emergency stop"):
        assert part in said


def test_a_record_is_never_written_over(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    events = tmp_path / "old" / "events.jsonl"
    events.parent.mkdir()
    events.write_text("kept")
    assert mill("run", "--rig", str(rig), "--record", str(events.parent)) == 2
    assert "old: holds a run already" in capsys.readouterr().err
    assert events.read_text() == "kept"


@pytest.mark.parametrize("name", ["tip.onnx", "landmarks.onnx", "completion.onnx"])
def test_missing_weights_are_named_before_anything_is_opened(
    name: str,
    rig: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from vision.completion import CompletionReader
    from vision.keypoints import LandmarkFinder, TipFinder

    folder = tmp_path / "weights"
    shutil.copytree(vision.runtime.WEIGHTS, folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    (folder / name).unlink()
    for finder in (TipFinder, LandmarkFinder, CompletionReader):
        monkeypatch.setattr(finder, "weights", folder / finder.weights.name)
    assert mill("run", "--rig", str(rig)) == 2
    said = capsys.readouterr().err
    for part in (str(folder / name), "no such weights", "mill train"):
        assert part in said
