"""Ledgers in the states that tests begin with, and bone that answers them."""

from dataclasses import dataclass, field

import numpy as np

from milling.limits import Limits
from milling.permission import Ledger
from milling.point import PointState
from milling.thickness import Thickness

LIMITS = Limits(neighbour_mm=9.0)
"""These tests dig at one point of a ring; the neighbours' rule has a test of its own."""
PITCH_MM = 0.4
BITE_MM = 0.013


def touched(n: int = 8, limits: Limits = LIMITS) -> Ledger:
    ledger = Ledger(n, limits, Thickness(n, limits, pitch_mm=PITCH_MM))
    for index in range(n):
        ledger.touched(index)
        ledger.seen(index, completion=0.0, upper=0.1, exposed_at_s=0.0)
    return ledger


def visit(
    ledger: Ledger,
    index: int,
    now_s: float,
    *,
    completion: float = 0.2,
    ratio: float | None = 1.0,
    alone: bool = False,
) -> float:
    """A whole visit with good evidence: a bite, the pass, its load, a picture of it; its neighbours are as deep."""
    grant = ledger.ask(index, bite_mm=BITE_MM, now_s=now_s, frame_at_s=now_s - 0.05)
    ledger.passed(index, depth_mm=grant.depth_mm, now_s=now_s + 0.1)
    if not alone:
        for beside in (index - 1, (index + 1) % len(ledger.points)):
            ledger.points[beside].cut_mm = max(ledger.points[beside].cut_mm, grant.depth_mm)
    if grant.deeper:
        ledger.felt(index, ratio=ratio, above_idle=True)
    ledger.seen(index, completion=completion, upper=min(completion + 0.1, 1.0), exposed_at_s=now_s + 0.2)
    return grant.depth_mm


def dig(ledger: Ledger, index: int, to_mm: float) -> float:
    """Good visits until a depth is reached; the time afterwards."""
    now_s = 1.0
    while ledger.cut_mm(index) < to_mm and ledger.points[index].state is PointState.OPEN:
        visit(ledger, index, now_s)
        now_s += 3.0
    return now_s


@dataclass
class Bone:
    """A ring of bone whose thickness is known, and cues as an ideal ball and an honest eye would give them.

    The load is that of a ball whose middle is in the hole: chords, not the table of ``milling.thickness``.
    """

    thickness_mm: list[float]
    load_noise: float = 0.08
    picture_noise_mm: float = 0.02
    picture_shift_mm: float = 0.0
    seed: int = 0
    ledger: Ledger = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.ledger = touched(len(self.thickness_mm), Limits())
        self.now_s = 1.0

    def ratio(self, index: int) -> float:
        deep_mm = self.ledger.cut_mm(index)
        # The bone gives way by some 15 um under the ball.
        past_mm = deep_mm - self.thickness_mm[index] - 0.015
        share = 1.0 if past_mm <= 0 else 1.0 - _chord(past_mm) / _chord(deep_mm)
        return share + self.load_noise * float(self.rng.normal())

    def completion(self, index: int) -> float:
        left_mm = self.thickness_mm[index] - self.ledger.cut_mm(index)
        left_mm += self.picture_shift_mm + self.picture_noise_mm * float(self.rng.normal())
        return min(max(1.0 - left_mm / self.thickness_mm[index], 0.0), 1.0)

    def lap(self) -> None:
        """One visit to every point."""
        for index in range(len(self.thickness_mm)):
            said, felt = self.completion(index), self.ratio(index)
            visit(self.ledger, index, self.now_s, completion=said, ratio=felt, alone=True)
        self.now_s += 3.0

    def mill(self) -> None:
        """Laps and looks until the ledger has no more to say."""
        for _ in range(8):
            while self.ledger.open_points:
                before = [point.cut_mm for point in self.ledger.points]
                self.lap()
                if [point.cut_mm for point in self.ledger.points] == before:
                    self.ledger.stall()
            for index in range(len(self.thickness_mm)):
                self.ledger.look(index)

    @property
    def excess_mm(self) -> list[float]:
        """Depth beyond the inner surface."""
        return [self.ledger.cut_mm(index) - thick for index, thick in enumerate(self.thickness_mm)]


def _chord(depth_mm: float, radius_mm: float = 0.5) -> float:
    return float(2 * np.sqrt(depth_mm * (2 * radius_mm - depth_mm)))


def wavy(n: int, seed: int) -> list[float]:
    """A thickness that changes by some 20 um from point to point."""
    rng = np.random.default_rng(seed)
    angle = np.arange(n) * 2 * np.pi / n
    wave = sum(
        0.02 * rng.normal() * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in range(1, 5)
    ) + 0.005 * rng.normal(size=n)
    return [float(t) for t in 0.37 + 0.05 * rng.uniform(-1, 1) + wave]
