"""The benchmark mills what experiments mill; how fast that is, no test asks."""

import pytest

from studies.bench_speed import measure


def test_it_tells_both_stages_of_a_mouse():
    figures = measure("statistical", until_s=0.0)
    assert 20.0 < figures["calibration_virtual_s"] < 40.0
    for stage in ("calibration", "run"):
        virtual_s, cpu_s = figures[f"{stage}_virtual_s"], figures[f"{stage}_cpu_s"]
        assert figures[f"{stage}_virtual_s_per_cpu_s"] == pytest.approx(virtual_s / cpu_s)
