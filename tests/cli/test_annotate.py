"""`mill annotate` in the terminal: what it tells, and what it refuses."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from mill_command import mill

from annotate.labels import Label, Notebook

PICTURES = [f"a-picture-with-a-long-name-{k}.png" for k in range(12)]


@pytest.fixture(autouse=True)
def _album(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("album/images").mkdir(parents=True)
    for name in PICTURES:
        cv2.imwrite(f"album/images/{name}", np.full((100, 120, 3), 90, np.uint8))


def label(annotator: str, off_px: float) -> None:
    with Notebook(Path("album"), annotator) as notebook:
        for k, name in enumerate(PICTURES):
            points = {
                "bregma": {"x_px": 50 + off_px, "y_px": 10 + k},
                "lambda": {"x_px": 50, "y_px": 52 + k},
            }
            notebook.put(name, Label.model_validate({"points": points}))


def test_two_people_are_compared_within_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    label("anna", 0.0)
    label("ben", 4.0)
    assert mill("annotate", "album", "--compare", "--json", "compare.json") == 0
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 80
    # 42 px are 4.2 mm, and a little more along the line that leans by the other's 4 px.
    assert "bregma  anna and ben  12  4.0      4.0    0.400    0.400" in said
    rows = {row["what"]: row for row in json.loads(Path("compare.json").read_text())["summary"]}
    assert rows["bregma"]["mean_mm"] == pytest.approx(0.4, abs=0.001)
    assert rows["lambda"]["mean_mm"] == 0.0
    assert mill("annotate", "album", "--compare", "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["command"] == "annotate compare"


def test_what_is_exported_is_what_is_imported(capsys: pytest.CaptureFixture[str]) -> None:
    label("anna", 0.0)
    label("ben", 4.0)
    assert mill("annotate", "album", "--export", "--annotator", "anna") == 0
    assert (
        "landmarks: 12 pictures; next: mill dataset import album --task landmarks --out SET" in capsys.readouterr().out
    )
    assert mill("dataset", "import", "album", "--task", "landmarks", "--out", "set") == 0
    card = json.loads(Path("set/card.json").read_text())
    assert card["splits"]["train"]["labels"] == {"annotators": ["anna"], "origins": {"hand": 24}, "apart": []}
    # A table that somebody has worked over is no longer what those people said.
    table = Path("album/keypoints.csv")
    table.write_text(table.read_text().replace("50,10", "50,11"))
    assert mill("dataset", "import", "album", "--out", "other") == 0
    assert "labels" not in json.loads(Path("other/card.json").read_text())["splits"]["train"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nowhere"], ["nowhere", "does not exist"]),
        (["empty"], ["empty/images", "found no pictures"]),
        (["album", "--annotator", "a/b"], ["'a/b'", "choose another name"]),
        (["album", "--annotator", "a", "--annotator", "b"], ["2 given", "one at a time"]),
        (["album", "--task", "mouse"], ["mouse", "landmarks"]),
        (["album", "--weights", "no.onnx"], ["--weights", "no.onnx", "does not exist"]),
        (["album", "--compare"], ["nobody has labelled anything", "mill annotate album"]),
        (["album", "--export"], ["nobody has labelled anything"]),
        (["album", "--export", "--compare"], ["exclude each other"]),
        (["album", "--json", "x.json"], ["--compare or --export"]),
    ],
)
def test_wrong_words_are_one_line(words: list[str], says: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("empty/images").mkdir(parents=True)
    assert mill("annotate", *words) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.strip().count("\n")) == ("", 0)
    for part in says:
        assert part in said.err


def test_one_person_alone_is_told_to_ask_another(capsys: pytest.CaptureFixture[str]) -> None:
    label("anna", 0.0)
    assert mill("annotate", "album", "--compare") == 2
    assert "only anna has labelled; let another do so: mill annotate album --annotator NAME" in capsys.readouterr().err
    assert mill("annotate", "album", "--export", "--annotator", "carl") == 2
    assert "nobody called carl; there are anna" in capsys.readouterr().err
