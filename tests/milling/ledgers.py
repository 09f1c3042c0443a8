"""Ledgers in the states that tests begin with."""

from milling.limits import Limits
from milling.permission import Ledger
from milling.point import PointState

LIMITS = Limits(neighbour_mm=9.0, pit_mm=9.0)
"""These tests dig at one point of a ring; the neighbours' rule has a test of its own."""


def touched(n: int = 8, limits: Limits = LIMITS) -> Ledger:
    ledger = Ledger(n, limits)
    for index in range(n):
        ledger.touched(index)
        ledger.seen(index, completion=0.0, upper=0.1, exposed_at_s=0.0)
    return ledger


def visit(ledger: Ledger, index: int, now_s: float, *, upper: float = 0.3, ratio: float | None = 1.0) -> float:
    """A whole visit with good evidence: a bite, the pass, its load, a picture of it."""
    grant = ledger.ask(index, bite_mm=0.013, now_s=now_s, frame_at_s=now_s - 0.05)
    ledger.passed(index, depth_mm=grant.depth_mm, now_s=now_s + 0.1)
    if grant.deeper:
        ledger.felt(index, ratio=ratio, above_idle=True)
    ledger.seen(index, completion=max(upper - 0.1, 0.0), upper=upper, exposed_at_s=now_s + 0.2)
    return grant.depth_mm


def dig(ledger: Ledger, index: int, to_mm: float) -> float:
    """Good visits until a depth is reached; the time afterwards."""
    now_s = 1.0
    while ledger.cut_mm(index) < to_mm and ledger.points[index].state is PointState.OPEN:
        visit(ledger, index, now_s)
        now_s += 3.0
    return now_s


def holed(ledger: Ledger, at_s: float) -> None:
    """Two frames with a hole at point 0."""
    for after_s in (0.0, 0.05):
        ledger.seen(0, completion=0.998, upper=1.0, exposed_at_s=at_s + after_s)


def stopped_by_picture() -> Ledger:
    ledger = touched()
    dig(ledger, 0, 0.3)
    for at_s in (900.0, 903.0):
        visit(ledger, 0, at_s, ratio=None)
    holed(ledger, 1e3)
    assert ledger.points[0].state is PointState.STOPPED
    return ledger


def felt_through(ledger: Ledger, index: int, cut_mm: float) -> None:
    point = ledger.points[index]
    point.cut_mm, point.load_through, point.state = cut_mm, True, PointState.DONE


def tried(cut_mm: float) -> Ledger:
    """Point 2 of 8 after a whole trial, under a picture that still says "through"."""
    ledger = touched()
    point = ledger.points[2]
    point.cut_mm, point.picture_said_mm, point.state = cut_mm, cut_mm - LIMITS.trial_mm, PointState.STOPPED
    point.load_ratio = 0.95
    ledger.seen(2, completion=0.998, upper=1.0, exposed_at_s=1e3)
    return ledger
