"""The whole walk, small: pictures of the virtual bench, labelled through the page's own door, taught, carded."""

import csv
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "cli"))

from bench_album import Known, bench_album
from mill_command import mill

from annotate.labels import Label, Notebook
from studies.annotation_walk import walk
from studies.photographs import bring_in
from vision.completion_training import HIDDEN, CompletionTask
from vision.samples import load_data
from vision.strip import CELLS
from vision.training import Recipe

COUNT = 12


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Known]:
    folder = tmp_path_factory.mktemp("bench") / "album"
    (known,) = bench_album(folder, 1)
    return folder / "images", known


@pytest.fixture(autouse=True)
def _hardly_any_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Recipe, "steps_for", lambda recipe, samples: 1)
    monkeypatch.setattr("vision.training.CHECK_BATCHES", 1)


def views(folder: Path, source: Path, known: Known) -> list[tuple[str, int, int]]:
    """An album of parts of one picture, and where each begins."""
    (folder / "images").mkdir(parents=True)
    parts = [(f"{k}.png", 3 * k, 2 * k) for k in range(COUNT)]
    for number, (name, x, y) in enumerate(parts):
        for kind in ("", "before-"):
            file = source / (known.name.replace(".png", "-before.png") if kind else known.name)
            picture = cv2.imread(str(file))
            assert picture is not None
            cv2.imwrite(str(folder / "images" / f"{kind}{name}"), picture[y : y + 500, x : x + 900])
        assert number < COUNT
    return parts


def run(*words: object) -> None:
    assert mill(*map(str, words)) == 0, words


@pytest.mark.slow
def test_from_pictures_to_a_model_card(bench: tuple[Path, Known], tmp_path: Path) -> None:
    source, known = bench
    album = tmp_path / "known"
    parts = views(album, source, known)
    with (album / "keypoints.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["image", "bregma_x_px", "bregma_y_px", "lambda_x_px", "lambda_y_px"])
        rows.writerows(
            [name, *np.round(np.array([*known.bregma, *known.lambda_]) - [x, y, x, y], 2)] for name, x, y in parts
        )
    figures = walk(album, tmp_path / "out", run)
    assert (figures["pictures"], figures["killed_after"], figures["kept_after_kill"]) == (COUNT, COUNT // 2, COUNT // 2)
    assert figures["exported_off_by_px"] == pytest.approx(0.0, abs=1e-9)
    assert [(row["what"], row["n"], row["mean_px"]) for row in figures["compared"]] == [
        ("bregma", COUNT, pytest.approx(5.0)),
        ("lambda", COUNT, pytest.approx(5.0)),
    ]
    assert figures["after"]["weights_sha256"] == figures["sha256"]
    assert figures["after"]["pictures"] == 1
    card = Path(figures["model_card"]).read_text()
    for part in (
        figures["sha256"],
        "Labelled by anna",
        "24 placed by hand",
        "One person&#39;s labels",
        "up to 95% of others",
    ):
        assert part in card
    manifest = json.loads((tmp_path / "out/weights/manifest.json").read_text())["landmarks.onnx"]
    assert manifest["data"]["train"]["labels"]["annotators"] == ["anna"]


def test_painted_rings_and_tips_teach_as_well(
    bench: tuple[Path, Known], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source, known = bench
    monkeypatch.chdir(tmp_path)
    album = tmp_path / "album"
    parts = views(album, source, known)
    with Notebook(album, "anna") as notebook:
        for name, x, y in parts:
            middle = {"center_x_px": known.ring["center_x_px"] - x, "center_y_px": known.ring["center_y_px"] - y}
            told = [None if k in (3, 4) else share for k, share in enumerate(known.completion)]
            ring = {**known.ring, **middle, "reference": f"before-{name}", "completion": told}
            tip = {"tip": {"x_px": 100 + x, "y_px": 60}} if x else {"tip": "unseen"}
            notebook.put(name, Label.model_validate({"points": tip, "ring": ring}))
    run("annotate", "album", "--export")
    for task in ("completion", "tip"):
        run("dataset", "import", "album", "--task", task, "--out", task)
        run("train", task, "--data", "album", "--out", f"w/{task}.onnx")
        assert "Labelled by anna" in Path(f"w/{task}.card.html").read_text()
    assert mill("evaluate", "completion", "--data", "album", "--weights", "w/completion.onnx") == 2
    assert "learnt from these photographs" in capsys.readouterr().err
    data = load_data(Path("completion"), "train", "completion", CompletionTask.arrays)
    assert len(data["strips"]) == 10
    # Point k of 32 is cell 2.5 k; cells that lie beside an unknown point are unknown.
    hidden = np.flatnonzero(data["hidden"][0])
    assert (hidden.min(), hidden.max()) == (6, 12)
    assert data["completions"][0, 20] == pytest.approx(known.completion[8], abs=1e-3)
    maps = data["maps"][0].reshape(64, CELLS[1], 4)[:, 20, 0]
    assert maps[32] == round(250 * known.completion[8])
    assert (maps[0], maps[22], maps[63]) == (0, HIDDEN, 0)
    assert (data["maps"][0].reshape(64, CELLS[1], 4)[:, hidden] == HIDDEN).all()
    # Where it is milled most, the strip looks least like what it was.
    change = np.abs(data["strips"][0, 20:44, :, :3].astype(float) - data["strips"][0, 20:44, :, 3:]).mean(axis=(0, 2))
    deep, shallow = np.argmax(data["completions"][0]), 4 * 61
    assert change[4 * deep : 4 * deep + 4].mean() > 2 * change[shallow : shallow + 4].mean()


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("x.png,60,50,30,8,,1 1 1", "no picture .*x.png"),
        ("1.png,60,50,30,8,y.png,1 1 1", "no picture .*y.png"),
        ("1.png,60,50,0,8,,1 1 1", "radius_px 0 and ball_px 8; allowed: above 0"),
        ("1.png,60,50,x,8,,1 1 1", "radius_px is x; allowed: a number"),
        ("1.png,60,50,30,8,,1 1", "completion at 2 points; allowed: 3 to 360"),
        ("1.png,60,50,30,8,,1 1 1.5", "allowed: 0 to 1"),
        ("1.png,60,50,70,8,,1 1 1", "does not lie inside its 120x100 px"),
        ("1.png,60,50,30,8,,1 1 1\n1.png,60,50,30,8,,1 1 1", "stands twice"),
    ],
)
def test_a_wrong_row_of_rings_is_named(tmp_path: Path, row: str, says: str) -> None:
    from drivers.errors import ConfigError

    (tmp_path / "a/images").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "a/images/1.png"), np.zeros((100, 120, 3), np.uint8))
    head = "image,center_x_px,center_y_px,radius_px,ball_px,reference,completion\n"
    (tmp_path / "a/rings.csv").write_text(head + row + "\n")
    with pytest.raises(ConfigError, match=says):
        bring_in(tmp_path / "a", tmp_path / "out", only="test", progress=lambda done, total: None)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
