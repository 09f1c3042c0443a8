"""The figures that the completion network is judged by, on readings whose truth is a formula."""

from typing import Any, cast

import numpy as np
import pytest

from vision.completion_training import STORED_PX, CompletionTask
from vision.runtime import Network
from vision.strip import ALONG_PX, CELLS

TRUTHS = np.array([0.0, 0.0, 0.04, 0.05, 0.4, 1.0, 0.8, 0.3])
"""Of every eighth cell of the rings; the last of them is hidden."""
ESTIMATE = 0.5
RADIUS_PX, BALL_PX = 50.0, 12.5


class SameEverywhere:
    """A network that reads one completion at every place, and a kerf as wide as the ball."""

    constants: dict[str, float] = {}  # noqa: RUF012  (as a network's are, of the instance)

    def run(self, strips: np.ndarray) -> list[np.ndarray]:
        line = np.full((1, 4, CELLS[1]), -9.0, np.float32)
        line[:, 0], line[:, 1] = ESTIMATE, 0.9
        maps = np.full((1, 2, *CELLS), -9.0, np.float32)
        maps[:, 0, 6:18] = 9.0
        return [line, maps]


def figures(boxes_px: list[list[float]]) -> dict[str, float]:
    """Judged on as many rings, of which each has its kerf in such a box."""
    count = len(boxes_px)
    angles = np.arange(CELLS[1]) * 2 * np.pi / CELLS[1]
    data: dict[str, Any] = {
        "strips": np.zeros((count, STORED_PX, ALONG_PX, 6), np.uint8),
        "maps": np.zeros((count, STORED_PX, ALONG_PX), np.uint8),
        "completions": np.tile(np.repeat(TRUTHS, CELLS[1] // len(TRUTHS)), (count, 1)),
        "hidden": np.tile(np.repeat(TRUTHS[-1] == TRUTHS, CELLS[1] // len(TRUTHS)), (count, 1)),
        "rings_px": np.tile(200 + RADIUS_PX * np.stack([np.cos(angles), np.sin(angles)], axis=1), (count, 1, 1)),
        "balls_px": np.full(count, BALL_PX),
        "boxes_px": np.array(boxes_px),
    }
    return CompletionTask().judge(cast(Network, SameEverywhere()), data)


def box(half_px: float) -> list[float]:
    return [200 - half_px, 200 - half_px, 200 + half_px, 200 + half_px]


NO_BOX = [float("nan")] * 4


def test_erratum_8_the_relative_error_is_of_truths_from_its_mask_up_and_its_name_states_the_mask() -> None:
    begun = TRUTHS[:-1][TRUTHS[:-1] >= 0.05]
    wanted = np.mean(np.abs(ESTIMATE - begun) / begun)
    found = figures([box(62.0)])
    assert found["mape_from_0.05"] == pytest.approx(wanted)
    assert not [name for name in found if "mape" in name and not name.startswith("mape_from_0.05")]


def test_erratum_8_no_average_precision_is_told_without_its_threshold() -> None:
    found = figures([box(62.0), box(45.0), box(85.0), NO_BOX])
    assert {name for name in found if "ap" in name.split("_") or "_ap" in name} == {"box_ap50", "box_ap50_95"}
    # Four boxes are found, all as sure, with overlaps of 1, of a little more than 1/2 twice, and of nothing.
    assert found["box_ap50"] == pytest.approx(1.0)
    assert 0.3 < found["box_ap50_95"] < 0.6
    assert not [name for name in found if name.lower().startswith(("map", "ap")) and not name.startswith("mape_from")]
