"""The page of results says what its inputs say."""

import pytest

from studies.results import page, wilson


def test_wilson_matches_the_published_interval_of_six_of_seven() -> None:
    low, high = wilson(6, 7)
    assert (low, high) == (pytest.approx(0.487, abs=0.001), pytest.approx(0.974, abs=0.001))


def test_a_held_run_is_no_success_even_with_a_free_flap() -> None:
    truth = {"success": True, "flap_free": True, "membrane_touched": False, "heat_rise_c": 8.0}
    runs = [
        {"seed": seed, "outcome": outcome, "milling_time_s": 150.0, "truth": truth}
        for seed, outcome in enumerate(("complete", "held"))
    ]
    text = page({"tip.onnx": {"held_out": {"tip_rmse_px": 0.4}}}, runs)
    assert "1 of 2" in text
    assert "| tip_rmse_px | 0.4 |" in text
    assert "simulation" in text
