"""Labels: kept through a kill, compared in px and mm, exported as they were said, and refused in words."""

import csv
import json
import multiprocessing
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

from annotate.compare import differences, summary
from annotate.desk import Desk
from annotate.export import export
from annotate.labels import Label, Notebook, Place, Ring, annotators_of, read_labels
from annotate.suggest import Suggester
from drivers.errors import ConfigError

PICTURES = [f"{k}.png" for k in range(1, 13)]


@pytest.fixture
def album(tmp_path: Path) -> Path:
    (tmp_path / "album/images").mkdir(parents=True)
    for name in PICTURES:
        cv2.imwrite(str(tmp_path / "album/images" / name), np.full((100, 120, 3), 90, np.uint8))
    return tmp_path / "album"


def marks(bregma: tuple[float, float], lambda_: tuple[float, float], **more: object) -> Label:
    (a, b), (c, d) = bregma, lambda_
    return Label.model_validate(
        {"points": {"bregma": {"x_px": a, "y_px": b}, "lambda": {"x_px": c, "y_px": d}, **more}}
    )


def say(album: Path, annotator: str, said: dict[str, Label]) -> None:
    with Notebook(album, annotator) as notebook:
        for picture, label in said.items():
            notebook.put(picture, label)


def label_for_ever(album: Path, told: "multiprocessing.connection.Connection") -> None:
    with Notebook(album, "anna") as notebook:
        for k in range(10_000):
            notebook.put(PICTURES[k % 12], marks((1 + k % 90, 1), (1, 90)))
            told.send(k)


def test_a_kill_at_any_moment_loses_nothing_that_was_answered(album: Path) -> None:
    near, far = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=label_for_ever, args=(album, far))
    process.start()
    far.close()
    answered = 0
    while answered < 40:
        answered = near.recv()
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    while near.poll():
        try:
            answered = near.recv()
        except EOFError:
            break
    with Notebook(album, "anna") as notebook:
        place = notebook.labels[PICTURES[answered % 12]].points["bregma"]
        assert isinstance(place, Place)
        # The one that was under way may be there as well.
        assert place.x_px in {1 + answered % 90, 1 + (answered + 12) % 90}
        assert len(notebook.labels) == 12


def test_one_process_at_a_time_has_a_notebook(album: Path) -> None:
    with Notebook(album, "anna"), pytest.raises(ConfigError, match="another `mill annotate` has it"):
        Notebook(album, "anna")
    Notebook(album, "anna").close()
    assert annotators_of(album) == []


@pytest.mark.parametrize("name", ["", "../x", "a/b", "exported", "-x", "a" * 41, ".hidden", "a b"])
def test_a_name_that_is_no_file_is_refused(album: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="choose another name"):
        Notebook(album, name)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "cannot be read"),
        ("[]", "cannot be read"),
        ('{"schema": 2, "labels": {}}', "schema 2 found, 1 expected"),
        ('{"schema": 1, "labels": {"1.png": {"point": {}}}}', "point: Extra inputs are not permitted"),
        ('{"schema": 1, "labels": {"1.png": {"points": {"nose": "unseen"}}}}', "points.nose"),
    ],
)
def test_a_damaged_notebook_is_named_and_kept(album: Path, text: str, says: str) -> None:
    (album / "annotations").mkdir()
    (album / "annotations/anna.json").write_text(text)
    with pytest.raises(ConfigError, match=says):
        Notebook(album, "anna")
    assert (album / "annotations/anna.json").read_text() == text


def test_two_people_differ_by_px_and_by_mm_along_and_across_the_midline(album: Path) -> None:
    # 42 px from bregma to lambda: a pixel is 0.1 mm.
    say(album, "anna", {"1.png": marks((50, 20), (50, 62)), "2.png": marks((50, 20), (50, 62), tip="unseen")})
    say(
        album,
        "ben",
        {"1.png": marks((53, 24), (53, 66)), "2.png": marks((50, 20), (50, 62), tip={"x_px": 1, "y_px": 1})},
    )
    found = differences({name: read_labels(album / f"annotations/{name}.json") for name in ("anna", "ben")})
    first = next(each for each in found if (each.picture, each.what) == ("1.png", "bregma"))
    assert (first.px, first.mm) == (pytest.approx(5.0), pytest.approx(0.5))
    assert (first.along_mm, first.across_mm) == (pytest.approx(0.4), pytest.approx(0.3))
    rows = {row["what"]: row for row in summary(found)}
    assert (rows["bregma"]["n"], rows["bregma"]["mean_mm"]) == (2, pytest.approx(0.25))
    assert (rows["tip"]["n"], rows["tip"]["one_alone"], rows["tip"]["mean_px"]) == (0, 1, None)


def ring(completion: list[float | None], x: float = 60.0) -> Label:
    return Label(ring=Ring(center_x_px=x, center_y_px=50, radius_px=30, ball_px=8, completion=tuple(completion)))


def test_rings_differ_in_place_and_completion_and_what_one_could_not_tell_is_not_told(album: Path) -> None:
    say(album, "anna", {"1.png": ring([0.0, 0.5, None, 1.0]), "2.png": ring([0.5] * 4)})
    say(album, "ben", {"1.png": ring([0.2, 0.5, 0.5, None], 63.0), "2.png": ring([0.5] * 4, 69.0)})
    found = differences({name: read_labels(album / f"annotations/{name}.json") for name in ("anna", "ben")})
    assert [(each.px, each.completion) for each in found] == [
        (pytest.approx(3.0), pytest.approx(0.1)),
        (pytest.approx(9.0), pytest.approx(0.0)),
    ]
    done = export(album)
    assert done.unsettled == ("2.png: its ring is another for each of anna, ben",)
    (row,) = csv.DictReader((album / "rings.csv").read_text().splitlines())
    assert (row["center_x_px"], row["completion"]) == ("60", "0.1 0.5 ? ?")


def test_the_tables_hold_the_mean_and_neither_what_is_open_nor_what_is_contradicted(album: Path) -> None:
    far = marks((50, 20), (50, 75))
    say(album, "anna", {"1.png": marks((50, 20), (50, 62)), "2.png": far, "3.png": Label(points={"tip": "unseen"})})
    say(album, "ben", {"1.png": marks((51, 20), (50, 62)), "2.png": marks((50, 20), (50, 62))})
    say(album, "cara", {"9.png": Label(points={"bregma": Place(x_px=1, y_px=1)})})
    done = export(album)
    assert done.rows == {"landmarks": 1, "tip": 1}
    assert done.unsettled == ("2.png: lambda lies 1.1 mm apart, more than 1",)
    assert (album / "keypoints.csv").read_text().splitlines() == [
        "image,bregma_x_px,bregma_y_px,lambda_x_px,lambda_y_px,tip_x_px,tip_y_px",
        "1.png,50.5,20,50,62,?,?",
        "3.png,?,?,?,?,,",
    ]
    about = json.loads((album / "annotations/exported.json").read_text())["keypoints.csv"]["labels"]["landmarks"]
    assert about["annotators"] == ["anna", "ben", "cara"]
    assert about["origins"] == {"hand": 9}


def test_a_table_of_somebody_else_is_not_written_over(album: Path) -> None:
    say(album, "anna", {"1.png": marks((50, 20), (50, 62))})
    (album / "keypoints.csv").write_text("image,tip_x_px,tip_y_px\n")
    with pytest.raises(ConfigError, match="not as `mill annotate` wrote it"):
        export(album)
    assert (album / "keypoints.csv").read_text() == "image,tip_x_px,tip_y_px\n"
    (album / "keypoints.csv").unlink()
    export(album)
    say(album, "anna", {"2.png": marks((50, 20), (50, 62))})
    assert export(album).rows == {"landmarks": 2}


def put(**label: object) -> str:
    return json.dumps({"do": "put", "picture": "1.png", "label": label})


def put_ring(**change: object) -> str:
    ring = {"center_x_px": 60, "center_y_px": 50, "radius_px": 20, "ball_px": 8, "completion": [1, 1, 1]}
    return put(ring={**ring, **change})


@pytest.mark.parametrize(
    ("message", "says"),
    [
        ("{", "Invalid JSON"),
        ('{"do": "dig"}', "dig"),
        ('{"do": "put", "picture": "../1.png", "label": {}}', "no picture ../1.png"),
        ('{"do": "put", "picture": "1.png", "label": {}, "as": "root"}', "as: Extra inputs"),
        (put(points={"tip": {"x_px": 119.5, "y_px": 1}}), "tip at 119.5,1 does not lie inside the 120x100 px"),
        (put(points={"tip": {"x_px": float("nan"), "y_px": 1}}), "finite"),
        (put(points={"tip": "perhaps"}), "points.tip"),
        (put(points={"nose": "unseen"}), "points.nose"),
        (put_ring(radius_px=55), "ring at 60,50 does not lie inside"),
        (put_ring(completion=[1, 2, 1]), "less than or equal to 1"),
        (put_ring(completion=[1, 1]), "at least 3"),
        (put_ring(reference="../1.png"), "no picture ../1.png in"),
        ('{"do": "suggest", "picture": "1.png", "task": "completion"}', "a ring is needed"),
        ('{"do": "export"}', "nobody has labelled anything"),
    ],
)
def test_what_cannot_be_done_is_refused_in_words_and_changes_nothing(album: Path, message: str, says: str) -> None:
    with Notebook(album, "anna") as notebook:
        answer = Desk(album, notebook, ["tip"], Suggester()).answer(message)
    assert answer["kind"] == "refused"
    assert says in answer["why"]
    assert not (album / "annotations/anna.json").exists()


def test_weights_must_say_what_they_are_for(tmp_path: Path) -> None:
    (tmp_path / "mine.onnx").write_bytes(b"x")
    with pytest.raises(ConfigError, match="for what it was trained is not known"):
        Suggester([tmp_path / "mine.onnx"])
    (tmp_path / "tip.onnx").write_bytes(b"x")
    with pytest.raises(ConfigError, match="SHA-256"):
        Suggester([tmp_path / "tip.onnx"])
