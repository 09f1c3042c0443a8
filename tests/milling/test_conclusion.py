"""A window is complete only where next to nothing may still hold the flap."""

import pytest

from milling.conclusion import conclude
from milling.limits import Limits
from milling.permission import Ledger
from milling.point import PointState


def milled(undecided: list[int], *, completion: float, depth_mm: float) -> Ledger:
    """32 points felt to be through at 0.35 mm, but for some."""
    ledger = Ledger(32, Limits())
    for index, point in enumerate(ledger.points):
        point.cut_mm, point.load_through, point.state, point.completion = 0.35, True, PointState.DONE, 1.0
        if index in undecided:
            point.cut_mm, point.load_through, point.state = depth_mm, False, PointState.STOPPED
            point.completion = completion
    return ledger


@pytest.mark.parametrize(
    ("undecided", "completion", "depth_mm", "outcome"),
    [
        ([4, 9, 20], 0.95, 0.34, "complete"),
        ([4, 9, 20, 21], 0.95, 0.34, "held"),
        ([4], 0.5, 0.34, "complete"),
        ([4, 9], 0.5, 0.34, "held"),
        ([4, 9], 0.95, 0.25, "held"),
    ],
    ids=["few", "too many", "one bridge", "two by the picture", "two by their neighbours"],
)
def test_few_undecided_points_and_hardly_a_bridge(
    undecided: list[int], completion: float, depth_mm: float, outcome: str
) -> None:
    found, reason = conclude(milled(undecided, completion=completion, depth_mm=depth_mm))
    assert found == outcome
    assert all(str(index + 1) in reason for index in undecided)
