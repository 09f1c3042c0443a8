"""The weights that come with mill, on specimens and rigs that no training saw."""

import numpy as np
import pytest

from firmware_sim.specimen import draw_specimen
from studies.datasets import SPLITS
from studies.scenes import completion_samples, landmark_samples, tip_samples
from vision.runtime import WEIGHTS, Network
from vision.tasks import task_named

SEED = 7


def unseen(samples, count, offset=0):
    """Stacked samples of ``count`` specimens of the test split."""
    rng = np.random.default_rng(SEED)
    drawn = [
        sample
        for index in range(count)
        for sample in samples(draw_specimen(SPLITS["test"].seed_of(offset + index, SEED)), rng)
    ]
    return {name: np.stack([sample[name] for sample in drawn]) for name in drawn[0]}


def figures(task, data):
    return task_named(task).judge(Network(WEIGHTS / f"{task}.onnx"), data)


@pytest.fixture(scope="module")
def tips():
    return unseen(tip_samples, 6)


def test_the_tip_is_found_to_half_a_pixel(tips):
    found = figures("tip", tips)
    assert found["tip_rmse_px"] < 0.5
    assert found["tip_missed"] < 0.05
    assert found["tip_normalized_error"] < 2.0


def test_no_tip_is_invented_where_there_is_none():
    data = unseen(landmark_samples, 4)
    data = {"pictures": data["pictures"][::4], "points": np.full((4, 1, 2), np.nan), "visible": np.zeros((4, 1), bool)}
    assert figures("tip", data)["tip_invented"] == 0.0


def test_bregma_and_lambda_are_found():
    found = figures("landmarks", unseen(landmark_samples, 6))
    for name in ("bregma", "lambda"):
        assert found[f"{name}_median_px"] < 2.5
        assert found[f"{name}_missed"] < 0.1


def test_completion_is_bounded_and_penetration_is_seen():
    found = figures("completion", unseen(completion_samples, 4))
    assert found["rmse"] < 0.12
    assert found["upper_bound_coverage"] > 0.95
    assert found["penetration_recall"] > 0.95
    assert found["bite_permitted_up_to_0.85"] > 0.9
    assert found["hidden_recall"] > 0.9
