"""The benchmark compares what it says; how fast that is, no test asks."""

import pytest
import torch

from benchmarks import completion_speed
from benchmarks.completion_speed import PaperKind, measure


def test_rates_are_of_readings_that_find_the_kerf(monkeypatch):
    monkeypatch.setattr(completion_speed, "READINGS", 2)
    rates = measure(PaperKind(blocks=(1, 1, 1, 1), width=4))
    assert rates["ring_rate_hz"] > 0.0
    assert rates["speedup"] == pytest.approx(rates["frame_rate_hz"] / rates["paper_kind_rate_hz"])


def test_the_reference_looks_at_the_whole_picture():
    boxes, heat = PaperKind(blocks=(1, 1, 1, 1), width=4)(torch.zeros(1, 3, 540, 960))
    assert len(boxes) == 5
    assert heat.shape[2] >= 540
    assert heat.shape[3] >= 960


def test_the_reference_is_as_deep_as_resnet_101():
    layers = [m for m in PaperKind(width=4).stages.modules() if isinstance(m, torch.nn.Conv2d)]
    assert len(layers) == 3 * sum(completion_speed.BLOCKS) + 4  # the last four stand beside the first of each stage
