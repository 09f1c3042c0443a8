"""`mill dataset`: what it makes, and what it refuses."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from mill_command import mill

from studies.datasets import SPLITS
from vision.training import Recipe


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def album(folder: Path, count: int = 12) -> None:
    (folder / "images").mkdir(parents=True)
    rows = ["image,bregma_x_px,bregma_y_px,lambda_x_px,lambda_y_px"]
    for number in range(count):
        cv2.imwrite(str(folder / f"images/{number}.png"), np.full((90, 90, 3), number, np.uint8))
        rows.append(f"{number}.png,40,20,41,70")
    (folder / "keypoints.csv").write_text("\n".join(rows))


def test_rendered_pictures_and_their_card(monkeypatch: pytest.MonkeyPatch) -> None:
    for split in SPLITS.values():
        monkeypatch.setitem(split.specimens, "landmarks", 1)
    assert mill("dataset", "render", "landmarks", "--out", "new/set", "--seed", "2") == 0
    card = json.loads(Path("new/set/card.json").read_text())
    assert card["task"] == "landmarks"
    assert card["splits"]["test"] == {
        "specimens": 1,
        "samples": 4,
        "source": "renderings",
        "seed": 2,
        "first_specimen_seed": SPLITS["test"].seed_of(0, 2),
    }
    assert np.load("new/set/train/pictures.npy").shape == (4, 540, 960, 3)


def test_photographs_are_brought_in_and_measured(capsys: pytest.CaptureFixture[str]) -> None:
    album(Path("album"))
    assert mill("dataset", "import", "album", "--out", "set") == 0
    assert capsys.readouterr().out == "set: landmarks; train 10, validation 1, test 1\n"
    assert mill("evaluate", "landmarks", "--data", "album", "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["pictures"] == 12
    assert mill("evaluate", "landmarks", "--data", "set", "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["pictures"] == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["render", "mouse", "--out", "x"], ["mouse", "landmarks"]),
        (["render", "tip"], ["--out"]),
        (["import", "nowhere", "--out", "x"], ["nowhere", "does not exist"]),
        (["import", "empty", "--out", "x"], ["empty/keypoints.csv", "cannot be read"]),
        (["collect", "--out", "x"], ["--emulate", "--rig FILE"]),
        (["collect", "--rig", "nowhere.toml", "--out", "x"], ["nowhere.toml", "no such rig file"]),
    ],
)
def test_wrong_words_are_one_line(words: list[str], says: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("empty").mkdir()
    assert mill("dataset", *words) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.strip().count("\n")) == ("", 0)
    for part in says:
        assert part in said.err
    assert not any(path.is_file() for path in Path().rglob("*"))


def test_training_data_of_other_photographs_is_not_taken_for_these(capsys: pytest.CaptureFixture[str]) -> None:
    album(Path("album"))
    Path("x.data").mkdir()
    Path("x.data/card.json").write_text('{"task": "landmarks", "splits": {"train": {"source": "renderings"}}}')
    assert mill("train", "landmarks", "--data", "album", "--out", "x.onnx") == 2
    assert "x.data: holds another data set than album" in capsys.readouterr().err


def test_photographs_teach_and_are_not_judged_on_themselves(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Recipe, "steps_for", lambda recipe, samples: 2)
    album(Path("album"))
    assert mill("train", "landmarks", "--data", "album", "--out", "w/landmarks.onnx") == 0
    manifest = json.loads(Path("w/manifest.json").read_text())["landmarks.onnx"]
    assert manifest["data"]["train"]["samples"] == 10
    assert Path("w/landmarks.html").is_file()
    capsys.readouterr()
    assert mill("evaluate", "landmarks", "--data", "album", "--weights", "w/landmarks.onnx") == 2
    assert "learnt from these photographs" in capsys.readouterr().err
    assert mill("evaluate", "landmarks", "--data", "w/landmarks.data", "--weights", "w/landmarks.onnx") == 0
    assert mill("train", "landmarks", "--out", "w/landmarks.onnx") == 2
    assert "holds landmarks, train from photographs" in capsys.readouterr().err


def test_a_folder_that_is_no_data_set_is_not_rendered_into(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("missing", "empty"):
        if name == "empty":
            Path(name).mkdir()
        assert mill("train", "landmarks", "--data", name, "--out", "x.onnx") == 2
        assert f"{name}: neither a data set" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["empty"]
