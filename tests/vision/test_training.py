"""Tiny trainings on drawn pictures: that it learns, repeats, resumes, and exports what it learned."""

import cv2
import numpy as np
import pytest
import torch

from drivers.errors import ConfigError, MillError
from vision.completion import CompletionReader
from vision.completion_training import STORED_PX, CompletionTask, paint_labels
from vision.keypoint_training import KeypointTask
from vision.keypoints import decode
from vision.paper_recipe import PaperNet, PaperTask
from vision.runtime import Network
from vision.samples import load_data
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
    angles = np.arange(32) * 2 * np.pi / 32
    middle = (STORED_PX - 1) / 2
    ring = np.stack([middle + 48 * np.cos(angles), middle + 48 * np.sin(angles)], axis=1)
    crops, labels, depths = [], [], []
    for depth in (0.0, 0.3, 0.6, 1.0):
        before = np.full((STORED_PX, STORED_PX, 3), 200, np.uint8)
        now = before.copy()
        cv2.circle(now, (96, 96), 48, (int(200 - 120 * depth),) * 3, 10)
        crops.append(np.concatenate([now, before], axis=2))
        kerf = np.zeros((STORED_PX // 2, STORED_PX // 2), np.float32)
        cv2.circle(kerf, (48, 48), 24, depth, 5)
        labels.append(paint_labels(ring, np.full(32, depth), kerf, np.zeros(kerf.shape, bool)))
        depths.append(np.full(32, depth))
    return {
        "crops": np.stack(crops),
        "labels": np.stack(labels),
        "rings_px": np.stack([ring] * 4),
        "completions": np.array(depths),
        "hidden": np.zeros((4, 32), bool),
    }


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
        biases.append(best.body.head.bias.detach())
    torch.manual_seed(2)
    fresh = CompletionTask().network().body.head.bias.detach()
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
    sick.body.head.weight.data[:] = float("nan")
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
    angles = np.arange(32) * 2 * np.pi / 32
    for radius in (50.0, 101.0):
        ring = np.stack([480 + radius * np.cos(angles), 250 + 0.95 * radius * np.sin(angles)], axis=1)
        reading = reader.read(image, ring, radius, reference=image)
        assert (reading.upper >= reading.completion).all()
        assert (reading.upper <= 1).all()
        center = reading.image_from_heat @ np.array([39.5, 39.5, 1.0])
        assert center == pytest.approx([480, 250], abs=1e-6)
        assert reader.read(image, ring, radius, reference=None).completion.shape == (32,)
    assert set(task.judge(Network(path), rings)) >= {"rmse", "upper_bound_coverage", "penetration_recall"}


def test_a_ring_that_leaves_the_picture_is_not_visible_there(rings, tmp_path):
    task = CompletionTask()
    path = tmp_path / "completion.onnx"
    export(task, task.network(), path, rings)
    angles = np.arange(32) * 2 * np.pi / 32
    ring = np.stack([930 + 50 * np.cos(angles), 250 + 50 * np.sin(angles)], axis=1)
    reading = CompletionReader(Network(path)).read(np.zeros((540, 960, 3), np.uint8), ring, 50.0, reference=None)
    assert not reading.visible[ring[:, 0] > 959].any()


def test_paint_follows_the_ring_and_leaves_the_rest(rings):
    ring = rings["rings_px"][0]
    along = np.linspace(0, 1, 32)
    label = paint_labels(ring, along, np.zeros((96, 96), np.float32), np.zeros((96, 96), bool))
    for k in range(0, 32, 5):
        column, row = np.round((ring[k] - 0.5) / 2).astype(int)
        assert label[row, column, 0] == round(250 * along[k])
        assert label[row, column, 1] == 1
    assert label[48, 48].tolist() == [0, 0, 0, 0, 0]


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
