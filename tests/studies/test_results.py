"""The page of results says what its inputs say."""

import pytest

from studies.results import page, wilson
from studies.virtual_runs import seeds_of


def test_wilson_matches_the_published_interval_of_six_of_seven() -> None:
    low, high = wilson(6, 7)
    assert (low, high) == (pytest.approx(0.487, abs=0.001), pytest.approx(0.974, abs=0.001))


def test_a_held_run_is_no_success_even_with_a_free_flap() -> None:
    truth = {"success": True, "flap_free": True, "membrane_touched": False, "heat_rise_c": 8.0}
    runs: list[dict[str, object]] = [
        {"command": "run", "seed": seed, "outcome": outcome, "milling_time_s": 150.0, "truth": truth}
        for seed, outcome in enumerate(("complete", "held"))
    ]
    runs.append({**runs[0], "command": "virtual run", "seed": 7})
    text = page({"tip.onnx": {"held_out": {"tip_rmse_px": 0.4}}}, runs)
    assert "1 of 2" in text
    assert "1 of 1" in text.partition("virtual clock")[2]
    assert "| tip_rmse_px | 0.4 |" in text
    assert "simulation" in text


def test_an_experiment_tells_its_command_its_count_and_its_intervals() -> None:
    ours = {"trials": 9, "failed": 0, "height_rmse_mm": 0.02, "height_rmse_mm_low": 0.015, "height_rmse_mm_high": 0.025}
    result = {
        "command": "experiment surface",
        "seed": 3,
        "recipes": ["default", "paper"],
        "default": {**ours, "within_2_sigma": 0.9},
        "paper": {"trials": 9, "failed": 9},
        "published": {"height_rmse_mm": 0.1},
        "trials": [{"seed": seed} for seed in range(3, 12)],
    }
    text = page({}, [result])
    assert "mill experiment surface --specimens-count 9 --seed 3" in text
    assert "| failed | 0 | 9 |  |" in text
    assert "| height_rmse_mm | 0.02 (0.015 to 0.025) | - | 0.1 |" in text
    assert "None were given" in text


def test_seeds_are_named_by_ranges() -> None:
    assert seeds_of("0-3,7") == [0, 1, 2, 3, 7]
