import itertools

import numpy as np
import pytest

from drivers.errors import ConfigError
from firmware_sim.specimen import draw_specimen
from studies.datasets import SPLITS, ensure
from studies.scenes import completion_samples, landmark_samples
from vision.completion_training import HIDDEN, LEVELS, STORED_PX
from vision.strip import ALONG_PX, CELL_PX


def test_no_split_can_reach_a_seed_of_another():
    drawn = {
        name: {split.seed_of(index, seed) for index in (0, 1, 999) for seed in (0, 1, 99, 10**6)}
        for name, split in SPLITS.items()
    }
    for one, two in itertools.combinations(SPLITS, 2):
        assert not drawn[one] & drawn[two]
    for name, split in SPLITS.items():
        assert all(split.first <= seed < split.first + 1_000_000 for seed in drawn[name])


@pytest.mark.parametrize("task", ["tip", "landmarks", "completion"])
def test_erratum_7_the_split_is_by_specimen_before_any_picture_is_made(task, tmp_path, monkeypatch):
    """No augmented copy of a training picture can be tested on: not even its specimen can."""
    seen = {name: set() for name in SPLITS}
    for name in SPLITS:
        monkeypatch.setitem(SPLITS[name].specimens, task, 9)

        def samples(specimen, rng, name=name):
            seen[name].add((specimen.kind, specimen.seed))
            yield {"points": np.zeros(2)}

        monkeypatch.setitem(ensure.__globals__["_SAMPLES"], task, samples)
        ensure(task, name, tmp_path, seed=3, progress=lambda done, count: None)
    assert all(len(specimens) == 9 for specimens in seen.values())
    for one, two in itertools.combinations(SPLITS, 2):
        assert not seen[one] & seen[two]


def test_a_killed_rendering_goes_on_and_gives_the_same(tmp_path, monkeypatch):
    monkeypatch.setitem(SPLITS["test"].specimens, "tip", 3)

    def samples(specimen, rng):
        yield {"points": np.array([specimen.seed, rng.integers(1000)])}

    monkeypatch.setitem(ensure.__globals__["_SAMPLES"], "tip", samples)

    class KilledError(Exception):
        pass

    def kill(done, total):
        if done == 2:
            raise KilledError

    ensure("tip", "test", tmp_path / "whole", seed=4, progress=lambda done, total: None)
    with pytest.raises(KilledError):
        ensure("tip", "test", tmp_path / "killed", seed=4, progress=kill)
    seen = []
    ensure("tip", "test", tmp_path / "killed", seed=4, progress=lambda done, total: seen.append(done))
    assert seen == [3]
    whole, killed = (np.load(tmp_path / name / "test" / "points.npy") for name in ("whole", "killed"))
    assert (whole == killed).all()


def test_a_folder_without_specimens_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"no specimen files"):
        ensure("tip", "test", tmp_path / "out", seed=0, specimens=tmp_path, progress=lambda done, total: None)


def test_labels_of_a_ring_agree_with_its_completion():
    sample = next(completion_samples(draw_specimen(5), np.random.default_rng(3)))
    assert sample["strips"].shape == (STORED_PX, ALONG_PX, 6)
    # The floor of the kerf is seen a little aside of the ring on the unmilled surface: eyes look down at a slant.
    middle = slice(STORED_PX // 2 - 6, STORED_PX // 2 + 6)
    along = sample["maps"][middle, CELL_PX[1] // 2 :: CELL_PX[1]].astype(float)
    shown = (along != HIDDEN).all(axis=0)
    assert along.max(axis=0)[shown] / LEVELS == pytest.approx(sample["completions"][shown], abs=0.06)
    assert not sample["hidden"][shown].any()
    assert shown.mean() > 0.5


def test_an_eggshell_has_no_landmarks():
    for sample in landmark_samples(draw_specimen(5, kind="eggshell"), np.random.default_rng(3)):
        assert not sample["visible"].any()


def test_a_folder_of_something_else_is_not_gone_on_with(tmp_path, monkeypatch):
    for split in SPLITS.values():
        monkeypatch.setitem(split.specimens, "tip", 2)
        monkeypatch.setitem(split.specimens, "landmarks", 2)

    def samples(specimen, rng):
        yield {"points": np.zeros(2)}

    class KilledError(Exception):
        pass

    def kill(done, total):
        raise KilledError

    for task in ("tip", "landmarks"):
        monkeypatch.setitem(ensure.__globals__["_SAMPLES"], task, samples)
    with pytest.raises(KilledError):
        ensure("tip", "train", tmp_path, seed=4, progress=kill)
    with pytest.raises(ConfigError, match=r"train\.part: is of tip"):
        ensure("tip", "train", tmp_path, seed=5, progress=lambda done, total: None)
    ensure("tip", "train", tmp_path, seed=4, progress=lambda done, total: None)
    ensure("tip", "train", tmp_path, seed=4, progress=kill)
    for task, split, seed in (("tip", "train", 5), ("landmarks", "train", 4), ("landmarks", "test", 4)):
        with pytest.raises(ConfigError, match="holds tip"):
            ensure(task, split, tmp_path, seed=seed, progress=kill)
