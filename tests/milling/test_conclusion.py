"""A window is complete only where next to nothing may still hold the flap."""

import pytest
from ledgers import PITCH_MM

from milling.conclusion import conclude
from milling.limits import Limits
from milling.permission import Ledger
from milling.point import PointState
from milling.thickness import Thickness


def milled(left: list[float]) -> Ledger:
    """32 finished points, but for some whose probability of a bridge is ``left``."""
    ledger = Ledger(32, Limits(), Thickness(32, Limits(), pitch_mm=PITCH_MM))
    for point in ledger.points:
        point.state, point.left_probability = PointState.DONE, 0.01
    for index, probability in enumerate(left):
        ledger.points[5 * index].state, ledger.points[5 * index].left_probability = PointState.STOPPED, probability
    return ledger


@pytest.mark.parametrize(
    ("left", "outcome"),
    [([], "complete"), ([0.1, 0.2, 0.1], "complete"), ([0.9], "complete"), ([0.9, 0.5], "held"), ([0.3] * 5, "held")],
    ids=["none", "few and thin", "one bridge", "two bridges", "many that may be"],
)
def test_hardly_a_bridge(left: list[float], outcome: str) -> None:
    found, reason = conclude(milled(left))
    assert found == outcome
    assert all(str(5 * index + 1) in reason for index in range(len(left)))
