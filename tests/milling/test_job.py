"""A job refuses by name, with what was found and what is allowed."""

from typing import Any

import pytest

from drivers.errors import ConfigError
from milling.job import Job


def test_defaults_are_the_papers() -> None:
    job = Job()
    assert (job.radius_mm, job.n_points, job.ball_radius_mm, job.safety_offset_mm) == (2.0, 32, 0.5, 0.5)
    assert job.landmark_ratio == pytest.approx(1 / 3)
    assert (job.detection_gate_px, job.calibration_gate_mm) == (10.0, 1.0)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"radius_mm": 1.9}, ["radius_mm", "1.9", "2 to 4"]),
        ({"radius_mm": 4.01}, ["radius_mm", "4.01", "2 to 4"]),
        ({"feed_mm_s": 5.1}, ["feed_mm_s", "5.1", "0.2 to 5"]),
        ({"removal_rate_mm2_s": 0.07}, ["removal_rate_mm2_s", "0.065"]),
        ({"bite_mm": 0.06}, ["bite_mm", "0.05"]),
        ({"late_bite_mm": 0.02}, ["late_bite_mm", "0.015"]),
        ({"n_points": 31.5}, ["n_points", "31.5", "whole"]),
        ({"n_points": True}, ["n_points", "whole"]),
        ({"safety_offset_mm": float("nan")}, ["safety_offset_mm", "nan"]),
        ({"radius_mm": "two"}, ["radius_mm", "two", "number"]),
        ({"policy": "brave"}, ["policy", "brave", "default, paper, previous"]),
        ({"radius": 2.0}, ["radius", "unknown", "radius_mm"]),
        ({"thickness_low_mm": 0.6}, ["thickness_low_mm", "0.6", "thickness_high_mm"]),
        ({"safety_offset_mm": 1.8}, ["max_safety_offset_mm", "safety_offset_mm", "1.8"]),
    ],
)
def test_refusals(table: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigError) as refused:
        Job.from_table(table)
    for word in words:
        assert word in str(refused.value)


def test_a_given_centre_stands_for_landmarks() -> None:
    assert Job().center_mm is None
    assert Job.from_table({"center_mm": [5.0, -10.0, -2.5]}).center_mm == (5.0, -10.0, -2.5)
    for wrong in ([1.0, 2.0], [1.0, 2.0, "3"], "here", [1.0, 2.0, float("nan")], [1.0, 2.0, True]):
        with pytest.raises(ConfigError, match=r"center_mm: found .*, needs three numbers of mm"):
            Job.from_table({"center_mm": wrong})
