"""What a controller has planned and not yet executed, as far as the host can know from its own lines and reports."""

import math
from collections import deque
from dataclasses import dataclass

from drivers.motion.interface import Vector

SHORTEST_MM = 0.0005
"""Half of what three decimals keep: the firmware plans no block for less."""


@dataclass(frozen=True)
class _Block:
    target_mm: Vector
    speed_mm_per_s: float
    duration_s: float


class BlockQueue:
    """Blocks in the order they were acknowledged; machine coordinates."""

    def __init__(self) -> None:
        self._blocks: deque[_Block] = deque()
        self._last: _Block | None = None

    def __len__(self) -> int:
        return len(self._blocks)

    @property
    def last_target_mm(self) -> Vector | None:
        """Where the last move ends; None where there was none, or the queue was dropped."""
        return self._last.target_mm if self._last else None

    def add(self, position_mm: Vector, target_mm: Vector, feed_mm_per_s: float, rates_mm_per_s: Vector) -> None:
        """An acknowledged move; it starts where the one before ends, or at ``position_mm`` if there is none.

        ``rates_mm_per_s`` are the greatest rates of the axes.
        """
        start_mm = self._last.target_mm if self._last else position_mm
        x, y, z = (to - at for to, at in zip(target_mm, start_mm, strict=True))
        length_mm = math.hypot(x, y, z)
        if length_mm < SHORTEST_MM:
            return
        speed_mm_per_s = min(
            feed_mm_per_s,
            *(rate * length_mm / abs(by) for rate, by in zip(rates_mm_per_s, (x, y, z), strict=True) if by != 0),
        )
        self._last = _Block(target_mm, speed_mm_per_s, length_mm / speed_mm_per_s)
        self._blocks.append(self._last)

    def keep_newest(self, count: int) -> None:
        """The controller has ``count`` blocks left, and it executes the oldest first."""
        while len(self._blocks) > max(0, count):
            self._blocks.popleft()

    def clear(self) -> None:
        """The queue was dropped, and where the axes stand is for the next report to say."""
        self._blocks.clear()
        self._last = None

    def duration_s(self, position_mm: Vector, *, standing: bool) -> float:
        """Seconds of motion left for axes at ``position_mm``, without acceleration."""
        if self._blocks:
            under_way = self._blocks[0]
        elif self._last is not None and not standing:
            under_way = self._last
        else:
            return 0.0
        rest_s = math.dist(position_mm, under_way.target_mm) / under_way.speed_mm_per_s
        return rest_s + sum(block.duration_s for block in list(self._blocks)[1:])
