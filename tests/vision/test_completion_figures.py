"""The figures that the completion network is judged by, on readings whose truth is a formula."""

from typing import Any, cast

import numpy as np
import pytest

from vision.completion import CROP_PX
from vision.completion_training import KERF, STORED_PX, CompletionTask
from vision.networks import CELL_PX
from vision.runtime import Network

CELLS = round(CROP_PX / CELL_PX)
STORED_CELLS = round(STORED_PX / CELL_PX)
SPARE = (STORED_CELLS - CELLS) // 2
TRUTHS = np.array([0.0, 0.0, 0.04, 0.05, 0.4, 1.0, 0.8])
"""Of the points of every ring; the last one is hidden."""
ESTIMATE = 0.5


class SameEverywhere:
    """A network that reads one completion at every place, and a kerf in the left half of the crop."""

    constants: dict[str, float] = {}  # noqa: RUF012  (as a network's are, of the instance)

    def run(self, crops: np.ndarray) -> list[np.ndarray]:
        maps = np.full((1, 5, CELLS, CELLS), -9.0, np.float32)
        maps[:, 0], maps[:, 1] = ESTIMATE, 0.9
        maps[:, 2, :, : CELLS // 2] = 9.0
        return [maps]


def figures(kerf_columns: list[int]) -> dict[str, float]:
    """Judged on as many crops, of which each has its kerf in so many columns from the left."""
    count = len(kerf_columns)
    labels = np.zeros((count, STORED_CELLS, STORED_CELLS, 5), np.uint8)
    for index, columns in enumerate(kerf_columns):
        labels[index, :, SPARE : SPARE + columns, KERF] = 1
    data: dict[str, Any] = {
        "crops": np.zeros((count, STORED_PX, STORED_PX, 6), np.uint8),
        "labels": labels,
        "rings_px": np.full((count, len(TRUTHS), 2), STORED_PX / 2),
        "completions": np.tile(TRUTHS, (count, 1)),
        "hidden": np.tile([False] * (len(TRUTHS) - 1) + [True], (count, 1)),
    }
    return CompletionTask().judge(cast(Network, SameEverywhere()), data)


def test_erratum_8_the_relative_error_is_of_truths_from_its_mask_up_and_its_name_states_the_mask() -> None:
    begun = TRUTHS[:-1][TRUTHS[:-1] >= 0.05]
    wanted = np.mean(np.abs(ESTIMATE - begun) / begun)
    found = figures([CELLS // 2])
    assert found["mape_from_0.05"] == pytest.approx(wanted)
    assert not [name for name in found if "mape" in name and not name.startswith("mape_from_0.05")]


def test_erratum_8_no_average_precision_is_told_without_its_threshold() -> None:
    """The kerf is judged by the overlap itself, over the crops that show one; its box with the thresholds named."""
    found = figures([CELLS // 2, CELLS // 4, CELLS, 0])
    assert {name for name in found if "ap" in name.split("_") or "_ap" in name} == {"box_ap50", "box_ap50_95"}
    # Four boxes are found, all as sure, with overlaps of 1, 1/2, 1/2 and of nothing; three are there.
    assert found["box_ap50"] == pytest.approx(1.0)
    assert found["box_ap50_95"] < found["box_ap50"]
    assert found["kerf_iou"] == pytest.approx((1.0 + 0.5 + 0.5) / 3)
    assert not [name for name in found if name.lower().startswith(("map", "ap")) and not name.startswith("mape_from")]
