"""Tiny trainings on drawn pictures: that it learns, repeats, resumes, and exports what it learned."""

import cv2
import numpy as np
import pytest
import torch

from drivers.errors import ConfigError, MillError
from vision.completion import CompletionReader
from vision.completion_training import LEVELS, STORED_PX, CompletionTask
from vision.keypoint_training import KeypointTask
from vision.keypoints import decode
from vision.paper_completion import PaperCompletionTask
from vision.paper_recipe import PaperNet, PaperTask
from vision.runtime import Network
from vision.samples import load_data
from vision.strip import ALONG_PX, CELLS
from vision.training import Recipe, export, finish, train

TINY = Recipe(steps=12, batch=2, learning_rate=3e-3, patience=99)
"""Judged after each step: it would end before it had begun."""


def quiet(step, steps, loss):
    pass


@pytest.fixture(scope="module")
def discs():
    rng = np.random.default_rng(0)
    pictures, points = [], []
    for _ in range(4):
        picture = np.full((540, 960, 3), 180, np.uint8)
        point = rng.uniform((100, 100), (860, 440))
        cv2.circle(picture, tuple(int(v) for v in point), 12, (60, 60, 70), -1, cv2.LINE_AA)
        pictures.append(picture)
        points.append([np.floor(point)])
    return {"pictures": np.stack(pictures), "points": np.array(points), "visible": np.ones((4, 1), bool)}


@pytest.fixture(scope="module")
def rings():
    """Kerfs of one grey, the darker the deeper."""
    strips, maps, depths = [], [], []
    kerf = slice(STORED_PX // 2 - 12, STORED_PX // 2 + 12)
    for depth in (0.0, 0.3, 0.6, 1.0):
        before = np.full((STORED_PX, ALONG_PX, 3), 200, np.uint8)
        now, map_ = before.copy(), np.zeros((STORED_PX, ALONG_PX), np.uint8)
        now[kerf] = int(200 - 120 * depth)
        map_[kerf] = round(LEVELS * depth)
        strips.append(np.concatenate([now, before], axis=2))
        maps.append(map_)
        depths.append(np.full(CELLS[1], depth))
    return {
        "strips": np.stack(strips),
        "maps": np.stack(maps),
        "completions": np.array(depths),
        "hidden": np.zeros((4, CELLS[1]), bool),
        "rings_px": np.stack([circle(50.0, count=CELLS[1])] * 4),
        "balls_px": np.full(4, 12.5),
        "boxes_px": np.array([[np.nan] * 4, *[[418.0, 188.0, 542.0, 312.0]] * 3]),
    }


def circle(radius, *, center=(480.0, 250.0), count=32):
    angles = np.arange(count) * 2 * np.pi / count
    return np.array(center) + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def losses_of(task, data, tmp_path, steps=TINY):
    seen = []
    train(task, data, data, steps, seed=1, checkpoint=tmp_path / "c", progress=lambda step, of, loss: seen.append(loss))
    return seen


def test_keypoints_learn_the_same_way_twice(discs, tmp_path):
    task = KeypointTask("tip", ("tip",), steps=1)
    first = losses_of(task, discs, tmp_path)
    assert first == losses_of(task, discs, tmp_path)
    assert np.mean(first[-3:]) < 0.9 * np.mean(first[:3])


def test_completion_learns(rings, tmp_path):
    losses = losses_of(CompletionTask(), rings, tmp_path, Recipe(steps=50, batch=4, learning_rate=3e-3, patience=99))
    assert np.mean(losses[-5:]) < 0.85 * np.mean(losses[:5])


def test_a_killed_training_ends_where_it_would_have_ended(rings, tmp_path, monkeypatch):
    monkeypatch.setattr("vision.training.CHECKPOINT_STEPS", 5)

    class KilledError(Exception):
        pass

    def kill(step, steps, loss):
        if step == 7:
            raise KilledError

    whole, _ = train(CompletionTask(), rings, rings, TINY, seed=2, checkpoint=tmp_path / "whole", progress=quiet)
    with pytest.raises(KilledError):
        train(CompletionTask(), rings, rings, TINY, seed=2, checkpoint=tmp_path / "killed", progress=kill)
    resumed, _ = train(CompletionTask(), rings, rings, TINY, seed=2, checkpoint=tmp_path / "killed", progress=quiet)
    for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        assert a.equal(b)


def test_a_checkpoint_of_another_training_is_refused(rings, tmp_path, monkeypatch):
    monkeypatch.setattr("vision.training.CHECKPOINT_STEPS", 1)
    one = Recipe(steps=4, batch=2, learning_rate=1e-3)
    train(CompletionTask(), rings, rings, one, seed=2, checkpoint=tmp_path / "c", progress=quiet)
    with pytest.raises(ConfigError, match=r"delete it to start anew"):
        train(CompletionTask(), rings, rings, one, seed=3, checkpoint=tmp_path / "c", progress=quiet)


def test_a_training_that_gains_nothing_more_ends_early(rings, tmp_path, monkeypatch):
    held_out = iter([3.0, 1.0, *[2.0] * 20])
    monkeypatch.setattr("vision.training._held_out_loss", lambda *_: next(held_out))
    recipe = Recipe(steps=40, batch=2, learning_rate=1e-3)
    _, history = train(CompletionTask(), rings, rings, recipe, seed=2, checkpoint=tmp_path / "c", progress=quiet)
    assert history.checks[:3] == ((2, 3.0), (4, 1.0), (6, 2.0))
    assert len(history.losses) == 4 + 2 * 8


def test_the_best_on_the_way_comes_back(rings, tmp_path, monkeypatch):
    """Where the first check is the best, what is learnt after it does not count; where the last is, all of it does."""
    recipe = Recipe(steps=20, batch=2, learning_rate=1e-3, patience=99)
    biases = []
    for name, held_out in (("rising", iter(range(99))), ("falling", iter(range(99, 0, -1)))):
        monkeypatch.setattr("vision.training._held_out_loss", lambda *_, held_out=held_out: next(held_out))
        best, _ = train(CompletionTask(), rings, rings, recipe, seed=2, checkpoint=tmp_path / name, progress=quiet)
        biases.append(best.line.bias.detach())
    torch.manual_seed(2)
    fresh = CompletionTask().network().line.bias.detach()
    assert 0 < (biases[0] - fresh).abs().sum() < (biases[1] - fresh).abs().sum()


def test_a_loss_that_is_no_number_ends_the_training(rings, tmp_path):
    class Sick(CompletionTask):
        def loss(self, network, batch):
            return super().loss(network, batch) * float("nan")

    with pytest.raises(ConfigError, match="not a number at step 1"):
        train(Sick(), rings, rings, TINY, seed=2, checkpoint=tmp_path / "c", progress=quiet)


def test_a_damaged_checkpoint_is_named(rings, tmp_path):
    (tmp_path / "c").write_bytes(b"no checkpoint")
    with pytest.raises(ConfigError, match=r"c: is no checkpoint of a training; delete it to start anew"):
        train(CompletionTask(), rings, rings, TINY, seed=2, checkpoint=tmp_path / "c", progress=quiet)


def test_a_network_that_is_not_fit_leaves_the_old_one_in_place(rings, tmp_path, monkeypatch):
    task, path = CompletionTask(), tmp_path / "completion.onnx"
    finish(task, task.network(), path, rings, rings, {"seed": 1})
    good, manifest = path.read_bytes(), (tmp_path / "manifest.json").read_bytes()
    sick = task.network()
    sick.line.weight.data[:] = float("nan")
    with pytest.raises(MillError, match="NaN"):
        finish(task, sick, path, rings, rings, {"seed": 2})
    assert path.read_bytes() == good
    assert (tmp_path / "manifest.json").read_bytes() == manifest
    assert sorted(file.name for file in tmp_path.iterdir()) == ["completion.onnx", "manifest.json"]


def test_the_papers_recipe_learns_and_serves_the_same_finder(discs, tmp_path):
    task = PaperTask("tip", ("tip",), widths=(4, 8))
    recipe = Recipe(epochs=3, batch=2, learning_rate=1e-3, plan="three-rates", patience=99)
    assert recipe.steps_for(4) == 6
    network, history = train(task, discs, discs, recipe, seed=1, checkpoint=tmp_path / "c", progress=quiet)
    assert len(history.losses) == 6
    export(task, network, tmp_path / "tip.onnx", discs)
    assert set(task.judge(Network(tmp_path / "tip.onnx"), discs)) >= {"tip_rmse_px", "tip_missed"}


def test_the_papers_peak_is_the_place():
    network = PaperNet(1, widths=(4, 8)).eval()
    confidence = torch.zeros(1, 1, 540, 960)
    confidence[0, 0, 123, 456] = 0.9
    network.maps = lambda pictures: confidence
    corners, maps = network(torch.zeros(540, 960, 3, dtype=torch.uint8))
    found = decode(maps[0].numpy(), corners[0].numpy())
    assert (found.x_px, found.y_px, found.visible) == (pytest.approx(456), pytest.approx(123), True)


def test_exported_keypoints_answer_in_pixels_of_the_picture(discs, tmp_path):
    task = KeypointTask("tip", ("tip",), steps=1)
    path = tmp_path / "tip.onnx"
    export(task, task.network(), path, discs)
    corners, maps = Network(path).run(picture=discs["pictures"][0])
    assert corners.shape == (1, 2)
    assert maps.shape == (1, 3, 64, 64)
    figures = task.judge(Network(path), discs)
    assert set(figures) >= {"tip_rmse_px", "tip_missed", "tip_invented"}


def test_exported_completion_reads_a_ring_of_any_radius(rings, tmp_path):
    task = CompletionTask()
    path = tmp_path / "completion.onnx"
    export(task, task.network(), path, rings)
    reader = CompletionReader(Network(path))
    image = np.full((540, 960, 3), 120, np.uint8)
    for radius in (50.0, 101.0):
        ring = circle(radius)
        for reference in (image, None):
            reading = reader.over(ring, 12.5, reference=reference).read(image)
            assert reading.completion.shape == (32,)
            assert (reading.upper >= reading.completion).all()
            assert (reading.upper <= 1).all()
            assert reading.heat_map.shape == (540, 960)
    assert set(task.judge(Network(path), rings)) >= {"rmse", "upper_bound_coverage", "penetration_recall"}


def test_a_ring_that_leaves_the_picture_is_not_visible_there(rings, tmp_path):
    task = CompletionTask()
    path = tmp_path / "completion.onnx"
    export(task, task.network(), path, rings)
    ring = circle(50.0, center=(930.0, 250.0))
    reader = CompletionReader(Network(path)).over(ring, 12.5, reference=None)
    assert not reader.read(np.zeros((540, 960, 3), np.uint8)).visible[ring[:, 0] > 959].any()


def test_the_papers_completion_learns_and_serves_the_same_reader(rings, tmp_path):
    task = PaperCompletionTask(widths=(4, 8))
    recipe = Recipe(steps=40, batch=4, learning_rate=3e-3, plan="three-rates", patience=99)
    losses = losses_of(task, rings, tmp_path, recipe)
    assert np.mean(losses[-5:]) < 0.85 * np.mean(losses[:5])
    export(task, task.network(), tmp_path / "completion.onnx", rings)
    reading = CompletionReader(Network(tmp_path / "completion.onnx")).over(circle(50.0), 12.5, reference=None)
    read = reading.read(np.full((540, 960, 3), 120, np.uint8))
    assert read.visible.all()
    assert (read.upper >= read.completion).all()


def test_missing_data_names_the_folder(tmp_path):
    with pytest.raises(ConfigError, match=r"found no \.npy arrays"):
        load_data(tmp_path, "train", "completion", CompletionTask.arrays)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda folder: (folder / "visible.npy").unlink(), r"no visible\.npy; is this a data set for tip"),
        (lambda folder: (folder / "points.npy").write_bytes(b"damaged"), r"points\.npy: cannot be read"),
        (lambda folder: np.save(folder / "points.npy", np.zeros((4, 2, 2))), r"takes \(N, 1, 2\)"),
        (lambda folder: np.save(folder / "pictures.npy", np.zeros((4, 540, 960, 3))), "float64 of shape"),
        (lambda folder: np.save(folder / "points.npy", np.zeros((3, 1, 2))), r"arrays of \[3, 4\] samples"),
    ],
)
def test_data_of_another_kind_is_refused(discs, tmp_path, spoil, says):
    (tmp_path / "train").mkdir()
    for name, values in discs.items():
        np.save(tmp_path / "train" / f"{name}.npy", values)
    task = KeypointTask("tip", ("tip",), steps=1)
    assert load_data(tmp_path, "train", "tip", task.arrays)["points"].shape == (4, 1, 2)
    spoil(tmp_path / "train")
    with pytest.raises(ConfigError, match=says):
        load_data(tmp_path, "train", "tip", task.arrays)
