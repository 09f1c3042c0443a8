"""What the spindle feels: the load in the air, and at each pass of each point against what bone takes.

A ball of radius r_d lowered by a bite sweeps, per unit of path, the bite times the width of its contact with bone. As
long as there is bone below, that width is the chord at the depth cut; once the ball's lowest point is through, the
middle of the chord is missing: 13 um past the inner surface already costs about a quarter of the load. So the ratio of
measured to expected load falls at once at breakthrough, while the load itself only fades.
"""

from collections import deque
from dataclasses import dataclass
from math import sqrt
from statistics import fmean, median, pstdev

LEAST_SAMPLES = 3
_HISTORY = 12


@dataclass(frozen=True)
class Idle:
    """Torque of the drill turning in the air, as fractions of rated torque."""

    mean: float
    sigma: float

    @classmethod
    def of(cls, torques: list[float]) -> "Idle":
        """The baseline of at least ``LEAST_SAMPLES`` reports."""
        if len(torques) < LEAST_SAMPLES:
            raise ValueError(f"{len(torques)} torque reports, at least {LEAST_SAMPLES} are needed for a baseline")
        return cls(fmean(torques), max(pstdev(torques), 1e-5))

    def above(self, torques: list[float], sigmas: float) -> bool:
        """Whether the mean of some reports is above idle by so many of its own sigmas."""
        return bool(torques) and fmean(torques) > self.mean + sigmas * self.sigma / sqrt(len(torques))


def chord_mm(depth_mm: float, ball_radius_mm: float) -> float:
    """Width of a ball's contact at a depth below the surface; grows up to its diameter."""
    depth = min(max(depth_mm, 0.0), ball_radius_mm)
    return 2.0 * sqrt(depth * (2.0 * ball_radius_mm - depth))


@dataclass(frozen=True)
class Feeling:
    """One pass of one point: load per expected load, against bone; whether there was any; from how many reports."""

    ratio: float
    above_idle: bool
    samples: int


class LoadMeter:
    """Gathers reports near each point and compares each pass with the bone cut before it."""

    def __init__(self, n_points: int, idle: Idle, *, ball_radius_mm: float, sound_depth_mm: float) -> None:
        """Compare with passes that ended above ``sound_depth_mm``, where there must be bone below."""
        self.idle = idle
        self._ball_radius_mm = ball_radius_mm
        self._sound_depth_mm = sound_depth_mm
        self._torques: list[list[float]] = [[] for _ in range(n_points)]
        self._expected: list[list[float]] = [[] for _ in range(n_points)]
        self._sound: list[deque[float]] = [deque(maxlen=_HISTORY) for _ in range(n_points)]

    def report(self, index: int, torque: float, *, bite_mm: float, depth_mm: float) -> None:
        """One report taken while the ball was nearest to point ``index``; bite and depth where it was."""
        self._torques[index].append(torque)
        self._expected[index].append(bite_mm * chord_mm(depth_mm, self._ball_radius_mm))

    def leave(self, index: int, *, bite_mm: float, depth_mm: float) -> Feeling | None:
        """The tip has left the point: what this pass felt, None where it took no bite or was not measured."""
        torques, expected = self._torques[index], self._expected[index]
        self._torques[index], self._expected[index] = [], []
        if bite_mm <= 0 or len(torques) < LEAST_SAMPLES or sum(expected) <= 0:
            return None
        gain = (sum(torques) - len(torques) * self.idle.mean) / sum(expected)
        reference = self._reference(index)
        if depth_mm <= self._sound_depth_mm:
            self._sound[index].append(gain)
        ratio = gain / reference if reference is not None and reference > 0 else 1.0
        return Feeling(ratio, self.idle.above(torques, 3.0), len(torques))

    def _reference(self, index: int) -> float | None:
        """What bone took here so far, or round about while there is too little of it."""
        own = self._sound[index]
        if len(own) >= 4:
            return median(own)
        everywhere = [gain for gains in self._sound for gain in gains]
        return median(everywhere) if len(everywhere) >= 8 else None
