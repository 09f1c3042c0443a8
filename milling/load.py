"""What the spindle feels: the load in the air, and at each pass of each point against what bone takes.

A ball of radius r_d lowered by a bite sweeps, per unit of path, the bite times the width of its contact with bone. As
long as there is bone below, that width is the chord at the depth cut; once the ball's lowest point is through, the
middle of the chord is missing: 13 um past the inner surface already costs about a quarter of the load. So the ratio of
measured to expected load falls at once at breakthrough, while the load itself only fades.

Along the path the ball touches behind its lowest point where it goes down, and ahead of it where it comes up. So while
it crosses a dip the contact covers more than the ball's way, by the share radius x curvature, and less over a hump:
points left shallower than their neighbours would read as a breakthrough, and pits as bone.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import fmean, median, pstdev

from drivers.errors import ConfigError
from drivers.spindle.interface import Spindle

LEAST_SAMPLES = 3
SETTLED_MM = 0.06
"""Depth below contact from which the load follows the chord: above it, contact's uncertainty rules."""
COMPLIANCE = 0.9
"""How far bone gives way under a pass, as a share of what the pass cuts: 15 N/mm at published feed and removal rate."""
LONG_PAUSE = 2
"""Passes without a bite."""
BEND = 0.8
"""Share of radius x curvature that the points' depths alone give: between them the path is rounder (measured)."""
LEAST_BEND, MOST_BEND = 0.4, 2.5
FLAP_SOFTENING = 1.0
"""How much more it gives way once the flap is free all round."""
_HISTORY = 8
_OWN = 4
_STRANGERS_SHARE = 0.8
"""Points differ by slope and neighbours: what bone took elsewhere is only expected here with this discount."""
_CRAWL = 0.5
_STEADY = 0.15
"""What the time stamps of two position reports make of a steady feed."""


def require_load(spindle: Spindle) -> None:
    """Refuse a drill that cannot feel bone, before anything moves.

    Raises:
        ConfigError: its torque is not known.
    """
    if not spindle.feels_load:
        raise ConfigError(
            f"spindle: {spindle.identity}: tells no torque, so that it cannot feel bone, and mill goes deeper on "
            "nothing less; mill with a drive that tells its torque or current (docs/rig.md); calibrate, jog and doctor "
            "work with this one"
        )


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
    """One pass of one point: load against what bone takes, None while unknown; whether there was any; its reports."""

    ratio: float | None
    above_idle: bool
    samples: int
    sound: float | None = None
    """Load by swept area, where there must have been bone below: what later passes are compared with."""


class LoadMeter:
    """Gathers reports near each point and compares each pass with the bone cut before it.

    Bone is a spring: what it gave way by under the last pass, the next one cuts as well. A pass that follows one
    without a bite therefore cuts less than it was lowered by; not to expect that would read as a breakthrough.
    """

    def __init__(
        self, top_z_mm: Sequence[float], idle: Idle, *, pitch_mm: float, ball_radius_mm: float, sound_depth_mm: float
    ) -> None:
        """Compare with passes that ended above ``sound_depth_mm``, where there must be bone below.

        Args:
            top_z_mm: (n,) height of the path at depth zero at each point.
            idle: torque of the air.
            pitch_mm: from point to point.
            ball_radius_mm: the cutter's ball.
            sound_depth_mm: the least thickness of bone.
        """
        self.idle = idle
        self._top_z_mm = list(top_z_mm)
        self._n = n_points = len(self._top_z_mm)
        self._pitch_mm = pitch_mm
        self._ball_radius_mm = ball_radius_mm
        self._sound_depth_mm = sound_depth_mm
        self._reports: list[list[tuple[float, float, float]]] = [[] for _ in range(n_points)]
        self._cut_mm = [0.0] * n_points
        """What the newest pass of each point cut, as far as the spring tells."""
        self._before_mm = [0.0] * n_points
        """The same of the pass before."""
        self._bitten = [0] * n_points
        """Passes in a row that took a bite."""
        self._paused = [0] * n_points
        """Passes without a bite before those."""
        self._sound: list[deque[float]] = [deque(maxlen=_HISTORY) for _ in range(n_points)]

    def recall(self, index: int, sound: float) -> None:
        """What a pass over bone took at this point in an earlier run of the same window."""
        self._sound[index].append(sound)

    def report(self, index: int, torque: float, *, offset: float, speed: float) -> None:
        """One report taken near a point.

        Args:
            index: the point.
            torque: as the drive reports it.
            offset: how far past the point the ball was, in points (-0.5 to 0.5).
            speed: of the ball, as a share of the feed. A ball that crawls cuts too little to tell anything.
        """
        if speed >= _CRAWL:
            self._reports[index].append((torque, offset, 1.0 if abs(speed - 1.0) < _STEADY else speed))

    def leave(
        self, index: int, *, bite_mm: Sequence[float], depth_mm: Sequence[float], freed: float = 0.0
    ) -> Feeling | None:
        """The tip has left the point: what this pass felt, None where it took no bite or was not measured.

        Args:
            index: the point left.
            bite_mm: (n,) bites of the newest visits, that of the next point included.
            depth_mm: (n,) depths of the same.
            freed: share of the ring that is through.
        """
        compliance = COMPLIANCE * (1.0 + FLAP_SOFTENING * freed)
        before, after = (index - 1) % self._n, (index + 1) % self._n
        self._before_mm[index] = self._cut_mm[index]
        self._cut_mm[index] = _spring(bite_mm[index], self._before_mm[index], compliance)
        sweep = {
            where: cut * chord_mm(depth_mm[where], self._ball_radius_mm) * self._bend(where, depth_mm)
            for where, cut in (
                (before, self._cut_mm[before]),
                (index, self._cut_mm[index]),
                (after, _spring(bite_mm[after], self._cut_mm[after], compliance)),
            )
        }
        reports, self._reports[index] = self._reports[index], []
        torques = [torque for torque, _, _ in reports]
        expected = sum(
            speed * ((1 - abs(offset)) * sweep[index] + abs(offset) * sweep[after if offset > 0 else before])
            for _, offset, speed in reports
        )
        if bite_mm[index] <= 0:
            self._paused[index] = 1 if self._bitten[index] else self._paused[index] + 1
            self._bitten[index] = 0
            return None
        if len(torques) < LEAST_SAMPLES or expected <= 0:
            return None
        gain = (sum(torques) - len(torques) * self.idle.mean) / expected
        reference = self._reference(index)
        settled = depth_mm[index] >= SETTLED_MM
        # The first passes after a pause tell more of the spring than of the bone.
        long = self._paused[index] >= LONG_PAUSE
        steady = self._bitten[index] >= (2 if long else 1)
        self._bitten[index] += 1
        sound = gain if settled and steady and depth_mm[index] <= self._sound_depth_mm else None
        if sound is not None:
            self._sound[index].append(sound)
        ratio = gain / reference if settled and steady and reference is not None else None
        return Feeling(ratio, self.idle.above(torques, 3.0), len(torques), sound)

    def _bend(self, index: int, depth_mm: Sequence[float]) -> float:
        """How much more than its length a pass cuts here."""
        z = [self._top_z_mm[k % self._n] - depth_mm[k % self._n] for k in (index - 1, index, index + 1)]
        curvature = (z[0] - 2.0 * z[1] + z[2]) / self._pitch_mm**2
        return min(max(1.0 + BEND * self._ball_radius_mm * curvature, LEAST_BEND), MOST_BEND)

    def _reference(self, index: int) -> float | None:
        """What bone took here so far, or all round while that is too little; None while that is too little as well."""
        own = self._sound[index]
        share = 1.0
        if len(own) < _OWN:
            own, share = deque(gain for gains in self._sound for gain in gains), _STRANGERS_SHARE
        reference = share * median(own) if len(own) >= _OWN else 0.0
        return reference if reference > 0 else None


def _spring(bite_mm: float, before_mm: float, compliance: float) -> float:
    """What a pass cuts: its bite and what the bone gave way by before, less what it gives way by now."""
    return (bite_mm + compliance * before_mm) / (1.0 + compliance)
