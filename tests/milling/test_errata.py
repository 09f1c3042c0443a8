"""Errata 8 and 9 of the paper, as the loop answers them; 10, 11 and 14 are held where the trajectory is tested."""

import numpy as np
import pytest

from milling.eyes import RingView, Watch
from milling.job import Job
from milling.limits import Limits
from milling.permission import Ledger
from milling.point import PointState
from milling.thickness import Thickness


def test_erratum_8_no_percentage_of_a_completion_of_zero_enters_the_loop() -> None:
    """A point with a true completion of 0 is milled by its upper bound and its depth: nothing divides by it."""
    ledger = Ledger(1, Limits(), Thickness(1, Limits(), pitch_mm=0.4))
    ledger.touched(0)
    ledger.seen(0, completion=0.0, upper=0.0, exposed_at_s=0.5)
    assert ledger.ask(0, bite_mm=0.01, now_s=1.0, frame_at_s=1.0).deeper
    for depth_mm in (0.01, 0.02):
        ledger.ask(0, bite_mm=0.01, now_s=1.0, frame_at_s=1.0)
        ledger.passed(0, depth_mm=depth_mm, now_s=1.1)
        ledger.seen(0, completion=0.0, upper=0.0, exposed_at_s=1.2)
        assert np.isfinite(ledger.points[0].left_probability)
        ledger.stall()
        ledger.look(0)


def test_erratum_9_the_stop_rule_has_a_threshold_below_one() -> None:
    assert Job().completion_threshold < 1.0
    ledger = Ledger(1, Limits(), Thickness(1, Limits(), pitch_mm=0.4))
    ledger.touched(0)
    for frame in range(Limits().frames):
        ledger.seen(0, completion=0.9, upper=Job().completion_threshold, exposed_at_s=1.0 + frame)
    assert ledger.points[0].said_mm is not None
    now_s = 10.0
    for _ in range(60):
        grant = ledger.ask(0, bite_mm=0.013, now_s=now_s, frame_at_s=now_s)
        ledger.passed(0, depth_mm=grant.depth_mm, now_s=now_s + 0.1)
        ledger.felt(0, ratio=1.0, above_idle=True)
        ledger.seen(0, completion=0.9, upper=Job().completion_threshold, exposed_at_s=now_s + 0.2)
        now_s += 3.0
    assert ledger.cut_mm(0) <= Limits().thickness_low_mm + Limits().said_mm + 1e-9
    assert ledger.points[0].state is PointState.STOPPED


def test_erratum_9_there_is_a_depth_limit_under_a_picture_that_never_says_done() -> None:
    """The paper's one failure: the network reads 0.3 for ever. The load alone ends it; without load the prior does."""
    ledger = Ledger(1, Limits(), Thickness(1, Limits(), pitch_mm=0.4))
    ledger.touched(0)
    now_s = 1.0
    for _ in range(500):
        ledger.seen(0, completion=0.3, upper=0.4, exposed_at_s=now_s)
        grant = ledger.ask(0, bite_mm=0.05, now_s=now_s + 0.05, frame_at_s=now_s)
        ledger.passed(0, depth_mm=grant.depth_mm, now_s=now_s + 0.1)
        ledger.felt(0, ratio=1.0, above_idle=True)
        ledger.look(0)
        now_s += 3.0
    assert ledger.cut_mm(0) <= Limits().thickness_high_mm
    assert not ledger.ask(0, bite_mm=0.05, now_s=now_s, frame_at_s=now_s).deeper


def test_erratum_9_there_is_a_rule_for_disagreement() -> None:
    """Load gone, picture of bone: at most one small bite more, then no further until a look with the drill lifted."""
    limits = Limits()
    ledger = Ledger(1, limits, Thickness(1, limits, pitch_mm=0.4))
    ledger.touched(0)
    now_s = 1.0
    lost_at_mm = None
    for _ in range(60):
        ledger.seen(0, completion=0.3, upper=0.4, exposed_at_s=now_s)
        grant = ledger.ask(0, bite_mm=0.013, now_s=now_s + 0.05, frame_at_s=now_s)
        ledger.passed(0, depth_mm=grant.depth_mm, now_s=now_s + 0.1)
        gone = ledger.cut_mm(0) > 0.2
        if gone and lost_at_mm is None:
            lost_at_mm = ledger.cut_mm(0)
        ledger.felt(0, ratio=0.5 if gone else 1.0, above_idle=True)
        now_s += 3.0
    assert lost_at_mm is not None
    assert ledger.cut_mm(0) - lost_at_mm <= 0.02
    assert ledger.points[0].state is PointState.STOPPED


@pytest.mark.parametrize("name", ["Watch", "RingView"])
def test_erratum_10_pictures_show_the_balls_centre(name: str) -> None:
    """The drill hides the ring round its ball and along its shank, not round its tip."""
    assert {"Watch": Watch, "RingView": RingView}[name]

    class FromAbove:
        def project(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            pixels = 25.0 * points_mm[:, [1, 0]] + [730.0, 145.0]
            return pixels, pixels

    theta = 2 * np.pi * np.arange(1, 33) / 32
    ring = np.column_stack([5 + 2 * np.cos(theta), -10 + 2 * np.sin(theta), np.full(32, -2.5)])
    offset = 0.5 * np.array([np.sin(np.radians(40)), 0.0, np.cos(np.radians(40))])
    view = RingView(FromAbove(), ring, 0.5, offset)
    hidden = view.hidden(ring[15] - offset)
    assert hidden[15]
    assert hidden[31], "the shank leans over the far side of the ring"
    assert not hidden[7]
    assert not hidden[23]
