"""Straight segments as set-points, one for each period of the controller, with bounded acceleration along the way."""

import math
from collections import deque
from dataclasses import dataclass

from drivers.motion.interface import Vector

PERIOD_S = 0.008
"""How often an RC8 in slave mode takes a set-point."""
ACCELERATION_MM_PER_S2 = 500.0
_CHANGE_MM_PER_S = ACCELERATION_MM_PER_S2 * PERIOD_S
"""How much the velocity may change between two set-points, also round a corner."""
_SHORTEST_MM = 1e-6


@dataclass(frozen=True)
class _Segment:
    start_mm: Vector
    end_mm: Vector
    length_mm: float
    feed_mm_per_s: float

    @property
    def direction(self) -> Vector:
        x, y, z = ((b - a) / self.length_mm for a, b in zip(self.start_mm, self.end_mm, strict=True))
        return (x, y, z)

    def at(self, along_mm: float) -> Vector:
        part = along_mm / self.length_mm
        x, y, z = (a + part * (b - a) for a, b in zip(self.start_mm, self.end_mm, strict=True))
        return (x, y, z)


class Path:
    """What is still to be gone, and how fast it is being gone."""

    def __init__(self, position_mm: Vector = (0.0, 0.0, 0.0)) -> None:
        self._segments: deque[_Segment] = deque()
        self._along_mm = 0.0
        self._speed_mm_per_s = 0.0
        self._position_mm = position_mm

    @property
    def position_mm(self) -> Vector:
        """The last set-point."""
        return self._position_mm

    @property
    def finished(self) -> bool:
        """Whether nothing is left of it."""
        return not self._segments

    @property
    def duration_s(self) -> float:
        """Seconds that the rest takes at its feeds, without acceleration."""
        whole_s = sum(each.length_mm / each.feed_mm_per_s for each in self._segments)
        return whole_s - self._along_mm / self._segments[0].feed_mm_per_s if self._segments else 0.0

    def restart(self, position_mm: Vector) -> None:
        """Drop the rest, and stand at ``position_mm``."""
        self._segments.clear()
        self._along_mm = self._speed_mm_per_s = 0.0
        self._position_mm = position_mm

    def add(self, target_mm: Vector, feed_mm_per_s: float) -> None:
        """A segment behind the last one."""
        start_mm = self._segments[-1].end_mm if self._segments else self._position_mm
        length_mm = math.dist(start_mm, target_mm)
        if length_mm > _SHORTEST_MM:
            self._segments.append(_Segment(start_mm, target_mm, length_mm, feed_mm_per_s))

    def next(self, *, braking: bool) -> bool:
        """Go on by one period; whether that was a motion. ``braking`` slows down to standstill on the path."""
        wanted_mm_per_s = 0.0 if braking else self._allowed_mm_per_s()
        slowest, fastest = self._speed_mm_per_s - _CHANGE_MM_PER_S, self._speed_mm_per_s + _CHANGE_MM_PER_S
        self._speed_mm_per_s = max(0.0, slowest, min(wanted_mm_per_s, fastest))
        if self._speed_mm_per_s == 0.0 or not self._segments:
            self._speed_mm_per_s = 0.0
            return False
        self._along_mm += self._speed_mm_per_s * PERIOD_S
        while self._along_mm >= self._segments[0].length_mm - _SHORTEST_MM:
            gone = self._segments.popleft()
            self._along_mm = max(0.0, self._along_mm - gone.length_mm)
            self._position_mm = gone.end_mm
            if not self._segments:
                self._along_mm = self._speed_mm_per_s = 0.0
                return True
        self._position_mm = self._segments[0].at(self._along_mm)
        return True

    def _allowed_mm_per_s(self) -> float:
        """The feed, or what can still be slowed down from before each corner and the end."""
        if not self._segments:
            return 0.0
        allowed = self._segments[0].feed_mm_per_s
        ahead_mm = -self._along_mm
        before: _Segment | None = None
        for segment in self._segments:
            if before is not None:
                allowed = min(allowed, _before(ahead_mm, _corner_mm_per_s(before, segment)))
            ahead_mm += segment.length_mm
            before = segment
            if _before(ahead_mm, 0.0) >= allowed:
                # Whatever comes behind this can be slowed down for in time.
                return allowed
        return min(allowed, _before(ahead_mm, 0.0))


def _before(ahead_mm: float, then_mm_per_s: float) -> float:
    """The speed from which steps of one period can slow down to ``then_mm_per_s`` within ``ahead_mm``."""
    half = _CHANGE_MM_PER_S / 2
    slowing = math.sqrt(half**2 + then_mm_per_s**2 + 2 * ACCELERATION_MM_PER_S2 * max(0.0, ahead_mm)) - half
    return max(then_mm_per_s, slowing)


def _corner_mm_per_s(before: _Segment, after: _Segment) -> float:
    """The speed round a corner at which the velocity changes by no more than one period allows."""
    turn = math.dist(before.direction, after.direction)
    slower = min(before.feed_mm_per_s, after.feed_mm_per_s)
    return slower if turn * slower <= _CHANGE_MM_PER_S else _CHANGE_MM_PER_S / turn
