"""A window is complete only where next to nothing may still hold the flap."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pytest

from milling.conclusion import conclude
from milling.limits import Limits
from milling.permission import Ledger
from milling.point import PointState

DEPTH_MM = 0.4
LIMITS = Limits()


@dataclass
class Told:
    """An estimate that gives every point its probability of a bridge, and that there is more left than nothing."""

    bridge: list[float]

    def through(self, index: int, depth_mm: float) -> float:
        return 1.0 - self.bridge[index] if depth_mm >= DEPTH_MM + LIMITS.bridge_mm else 0.0

    def weighed(self, index: int, depth_mm: float, ratio: float, *, beside_mm: float) -> None: ...
    def pictured(self, index: int, depth_mm: float, completion: float) -> None: ...
    def forget_pictures(self, index: int) -> None: ...
    def recall_pictures(self, index: int, kept: Mapping[str, Any]) -> None: ...
    def pictures(self, index: int) -> dict[str, Any]:
        return {}


def milled(left: list[float]) -> Ledger:
    """32 finished points, but for some that stopped, whose probability of a bridge is ``left``."""
    bridge = [0.01] * 32
    for index, probability in enumerate(left):
        bridge[5 * index] = probability
    ledger = Ledger(32, LIMITS, Told(bridge))
    for index, point in enumerate(ledger.points):
        point.cut_mm = DEPTH_MM
        point.state = PointState.STOPPED if index % 5 == 0 and index // 5 < len(left) else PointState.DONE
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
