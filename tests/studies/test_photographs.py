"""Photographs brought in: what goes where, and what is refused."""

import json

import cv2
import numpy as np
import pytest

from drivers.errors import ConfigError
from studies.photographs import bring_in, ensure_in
from vision.keypoints import letterboxed
from vision.samples import load_data
from vision.tasks import task_named

HEADER = "image,bregma_x_px,bregma_y_px,lambda_x_px,lambda_y_px"


def album(folder, count=20, size=(100, 100), header=HEADER, row=None):
    (folder / "images").mkdir(parents=True)
    rows = [header]
    for number in range(count):
        # Numbers of one and of two digits: sorted by number, not by letter.
        picture = np.full((size[1], size[0], 3), 10 * (number % 20), np.uint8)
        cv2.imwrite(str(folder / "images" / f"{number}.png"), picture)
        rows.append(f"{number}.png,50,20,50,80" if row is None else row.replace("#", str(number)))
    (folder / "keypoints.csv").write_text("\n".join(rows) + "\n")
    return folder


def silent(done, total):
    pass


def test_blocks_of_consecutive_numbers_and_a_card(tmp_path):
    counted = []
    task, counts = bring_in(album(tmp_path / "a"), tmp_path / "out", progress=lambda *step: counted.append(step))
    assert (task, counts) == ("landmarks", {"train": 16, "validation": 2, "test": 2})
    assert counted[-1] == (20, 20)
    card = json.loads((tmp_path / "out/card.json").read_text())
    assert card["task"] == "landmarks"
    assert (card["splits"]["train"]["first"], card["splits"]["train"]["last"]) == ("0.png", "15.png")
    assert (card["splits"]["test"]["first"], card["splits"]["test"]["last"]) == ("18.png", "19.png")
    test = load_data(tmp_path / "out", "test", "landmarks", task_named("landmarks").arrays)
    # A 100 x 100 px picture is 540 px high in the network's frame, in its middle, round the same pixel edges.
    assert test["points"][0, 0] == pytest.approx([480 - 0.5 + 5.4 * 0.5, 5.4 * 20.5 - 0.5])
    assert test["pictures"][0, 270, 480, 0] == 180
    assert test["pictures"][0, 270, 100].tolist() == [128, 128, 128]


def test_a_point_that_is_not_to_be_seen_is_left_empty(tmp_path):
    folder = album(tmp_path / "a", row="#.png,,,50,80")
    bring_in(folder, tmp_path / "out", only="test", progress=silent)
    data = load_data(tmp_path / "out", "test", "landmarks", task_named("landmarks").arrays)
    assert data["visible"].tolist() == [[False, True]] * 20


def test_a_table_of_tips_is_for_the_tip(tmp_path):
    folder = album(tmp_path / "a", header="image,tip_x_px,tip_y_px", row="#.png,5,6")
    assert bring_in(folder, tmp_path / "out", progress=silent)[0] == "tip"
    with pytest.raises(ConfigError, match="has the points of tip; those of landmarks are needed"):
        bring_in(folder, tmp_path / "other", "landmarks", progress=silent)


@pytest.mark.parametrize(
    ("break_it", "says"),
    [
        (lambda a: (a / "keypoints.csv").unlink(), "cannot be read"),
        (lambda a: (a / "keypoints.csv").write_text("image,x,y\n"), "found columns image,x,y; allowed: image,bregma"),
        (lambda a: (a / "keypoints.csv").write_text(""), "found columns none"),
        (lambda a: (a / "keypoints.csv").write_text(HEADER + "\n"), "found no rows"),
        (lambda a: (a / "keypoints.csv").write_text(HEADER + "\n0.png,1,2,3,4\n"), "1 photographs; at least 10"),
        (lambda a: rewrite(a, 3, "3.png,50,20,50,x"), "line 5: lambda is at 50,x; allowed: two numbers"),
        (lambda a: rewrite(a, 3, "3.png,50,,50,80"), "line 5: bregma is at 50,; allowed"),
        (lambda a: rewrite(a, 3, "3.png,inf,20,50,80"), "line 5: bregma is at inf,20"),
        (lambda a: rewrite(a, 3, "3.png,50,20,50,100"), "3.png: a point at 50,100 lies outside its 100x100 px"),
        (lambda a: rewrite(a, 3, "3.png,50,20,50,20"), "line 5: bregma and lambda are at the same place"),
        (lambda a: rewrite(a, 3, "2.png,50,20,50,80"), "line 5: 2.png stands twice"),
        (lambda a: rewrite(a, 3, "x.png,50,20,50,80"), "line 5: no picture .*x.png"),
        (lambda a: (a / "images/3.png").write_bytes(b"not a picture"), "3.png: is no picture"),
        (lambda a: cv2.imwrite(str(a / "images/3.png"), np.zeros((9, 9, 3), np.uint8)), "3.png: 9x9 px; allowed"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_is_left(break_it, says, tmp_path):
    folder = album(tmp_path / "a")
    break_it(folder)
    with pytest.raises(ConfigError, match=says):
        bring_in(folder, tmp_path / "out", progress=silent)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def rewrite(folder, index, row):
    table = folder / "keypoints.csv"
    lines = table.read_text().splitlines()
    lines[index + 1] = row
    table.write_text("\n".join(lines))


def test_a_killed_import_leaves_nothing_and_starts_anew(tmp_path):
    folder = album(tmp_path / "a")

    def kill(done, total):
        if done == 18:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ensure_in(folder, tmp_path / "out", "landmarks", progress=kill)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    ensure_in(folder, tmp_path / "out", "landmarks", progress=silent)
    ensure_in(folder, tmp_path / "out", "landmarks", progress=kill)
    rewrite(folder, 3, "3.png,51,20,50,80")
    with pytest.raises(ConfigError, match="holds another data set"):
        ensure_in(folder, tmp_path / "out", "landmarks", progress=silent)


def test_animals_in_folders_of_their_own_stay_together(tmp_path):
    folder = album(tmp_path / "a")
    table = folder / "keypoints.csv"
    for mouse in ("m1", "m2"):
        (folder / "images" / mouse).mkdir()
    rows = [HEADER]
    for number in range(20):
        name = f"m{1 + number % 2}/{number // 2}.png"
        (folder / f"images/{number}.png").rename(folder / "images" / name)
        rows.append(f"{name},50,20,50,80")
    table.write_text("\n".join(rows))
    bring_in(folder, tmp_path / "out", progress=silent)
    splits = json.loads((tmp_path / "out/card.json").read_text())["splits"]
    assert (splits["train"]["first"], splits["train"]["last"]) == ("m1/0.png", "m2/5.png")
    assert splits["test"]["first"] == "m2/8.png"
    table.write_text(table.read_text() + "\n./m1/0.png,50,20,50,80")
    with pytest.raises(ConfigError, match="stands twice"):
        bring_in(folder, tmp_path / "other", progress=silent)


def test_a_table_of_everything_serves_both(tmp_path):
    header = "image,bregma_x_px,bregma_y_px,lambda_x_px,lambda_y_px,tip_x_px,tip_y_px"
    folder = album(tmp_path / "a", header=header, row="#.png,50,20,50,80,10,10")
    assert bring_in(folder, tmp_path / "tips", "tip", progress=silent)[0] == "tip"
    assert bring_in(folder, tmp_path / "marks", "landmarks", progress=silent)[0] == "landmarks"


def test_a_data_set_that_is_there_is_kept(tmp_path):
    folder = album(tmp_path / "a")
    bring_in(folder, tmp_path / "out", progress=silent)
    with pytest.raises(ConfigError, match="is there already"):
        bring_in(folder, tmp_path / "out", progress=silent)
    assert len(np.load(tmp_path / "out/train/points.npy")) == 16


@pytest.mark.parametrize("size", [(640, 640), (1920, 1080), (320, 100), (960, 540)])
def test_a_point_of_any_picture_keeps_its_place(size):
    width, height = size
    picture = np.zeros((height, width, 3), np.uint8)
    column, row = width // 3, height // 4
    cv2.circle(picture, (column, row), max(3, height // 40), (255, 255, 255), -1)
    boxed, scale, corner = letterboxed(picture)
    assert boxed.shape == (540, 960, 3)
    bright = np.argwhere((boxed > 200).all(axis=2)).mean(axis=0)[::-1]
    assert bright == pytest.approx(np.array([column, row]) * scale + corner, abs=0.6)
