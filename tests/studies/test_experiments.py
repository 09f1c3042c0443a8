"""The paper's experiments, one trial each: that they score what they say, and that recipes differ as they should."""

import numpy as np
import pytest

from studies import calibration_trials, surface_trials
from studies.trials import Figures


@pytest.fixture(scope="module")
def rig() -> dict[str, Figures]:
    return {recipe: calibration_trials.calibrate_one(3, recipe) for recipe in calibration_trials.RECIPES}


def test_a_calibration_is_scored_in_the_box(rig):
    ours = rig["default"]
    assert ours["failed"] is None
    assert ours["setpoints_seen"] >= 15
    assert 0.0 < ours["rmse_center_mm"] < 0.3
    assert 10.0 < ours["duration_s"] < 120.0
    assert ours["tip_rmse_px"] <= ours["tip_worst_px"] < 5.0


def test_the_papers_recipe_is_worse_on_the_same_rig(rig):
    assert rig["default"]["rmse_mm"] < rig["paper"]["rmse_mm"]
    # The error of the tip is the eyes' and not the finder's that the recipe was given.
    assert rig["paper 3.18 px"]["tip_rmse_px"] == pytest.approx(3.18, rel=0.3)


def test_the_summary_counts_what_failed(rig):
    failed = {"seed": 4, "recipe": "default", "failed": "calibration: nothing seen"}
    figures = calibration_trials.summary({**rig, "other": failed})
    assert (figures["default"]["trials"], figures["default"]["failed"]) == (2, 1)
    assert figures["default"]["rmse_mm"] == pytest.approx(rig["default"]["rmse_mm"])


def test_one_rig_is_asked_for_the_same_places_by_every_recipe():
    names = calibration_trials.trials_of(2, 5)
    assert set(names.values()) == {(rig, recipe) for rig in (5, 6) for recipe in calibration_trials.RECIPES}


@pytest.fixture(scope="module")
def bone() -> dict[str, Figures]:
    return {recipe: surface_trials.reconstruct_one(1, recipe) for recipe in surface_trials.RECIPES}


def test_a_surface_is_scored_at_the_ring(bone):
    ours = bone["default"]
    assert ours["failed"] is None
    assert ours["height_rmse_mm"] < 0.06
    assert ours["normal_rmse_deg"] < 8.0
    assert abs(ours["height_bias_mm"]) <= ours["height_rmse_mm"]
    again = surface_trials.reconstruct_one(1, "default")
    assert again == ours


def test_the_papers_matcher_is_worse(bone):
    assert bone["paper"]["failed"] is None
    assert bone["default"]["height_rmse_mm"] < bone["paper"]["height_rmse_mm"]
    figures = surface_trials.summary(bone)
    assert figures["paper"]["trials"] == 1


def test_planes_have_their_normals():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1, 1, (1, 40, 2))
    patch = np.concatenate([xy, (0.2 * xy[..., :1] - 0.1 * xy[..., 1:])], axis=2)
    expected = np.array([-0.2, 0.1, 1.0]) / np.linalg.norm([-0.2, 0.1, 1.0])
    assert surface_trials._plane_normals(patch)[0] == pytest.approx(expected)
