"""The queue of straight blocks with look-ahead: how fast each may be entered so that every later stop is reachable.

Speeds in mm/s, along the path; accelerations in mm/s2.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

STEPS = tuple[int, int, int]
UNLIMITED = 1e6
MINIMUM_SPEED = 1 / 60


@dataclass(eq=False)
class Block:
    """A straight move of ``steps`` motor steps; ``remaining_mm`` of its length is not yet prepared for the motors.

    Jogs and homing keep their feed: the feed override does not touch them.
    """

    steps: STEPS
    length_mm: float
    unit: tuple[float, float, float]
    acceleration: float
    rapid_speed: float
    programmed_speed: float
    is_rapid: bool
    keeps_feed: bool
    junction_speed: float
    nominal_speed: float = 0.0
    max_entry_speed: float = 0.0
    entry_speed: float = 0.0
    remaining_mm: float = field(init=False)

    def __post_init__(self) -> None:
        self.remaining_mm = self.length_mm


@dataclass(frozen=True)
class Limits:
    """What the settings say about the axes."""

    steps_per_mm: tuple[float, float, float]
    max_speed: tuple[float, float, float]
    acceleration: tuple[float, float, float]
    junction_deviation_mm: float


def steps_of(position_mm: Sequence[float], steps_per_mm: Sequence[float]) -> STEPS:
    """Whole steps; a coordinate beyond what the firmware's numbers can hold counts as none."""
    x, y, z = (round(p * s) if math.isfinite(p) else 0 for p, s in zip(position_mm, steps_per_mm, strict=True))
    return x, y, z


def _limit_by_axis(limits: Sequence[float], unit: Sequence[float]) -> float:
    return min(limit / abs(u) if u else UNLIMITED for limit, u in zip(limits, unit, strict=True))


class Planner:
    """A bounded queue of blocks; the first may be under way."""

    def __init__(self, size: int, *, caps_feed_before_override: bool) -> None:
        self._size = size
        self._caps_first = caps_feed_before_override
        self.blocks: deque[Block] = deque()
        self.position: STEPS = (0, 0, 0)
        self.feed_override = 100
        self.rapid_override = 100
        self._last: Block | None = None

    @property
    def free(self) -> int:
        """Blocks that still fit."""
        return self._size - len(self.blocks)

    def reset(self) -> None:
        """Forget every block."""
        self.blocks.clear()
        self._last = None

    def add(
        self,
        target: STEPS,
        limits: Limits,
        *,
        speed: float,
        is_rapid: bool,
        keeps_feed: bool = False,
        inverse_time: bool = False,
        tail_speed: float = 0.0,
    ) -> bool:
        """Queue a move to ``target``; False when it has no length."""
        steps = (target[0] - self.position[0], target[1] - self.position[1], target[2] - self.position[2])
        if steps == (0, 0, 0):
            return False
        delta = [n / s for n, s in zip(steps, limits.steps_per_mm, strict=True)]
        length = math.sqrt(delta[0] ** 2 + delta[1] ** 2 + delta[2] ** 2)
        unit = (delta[0] / length, delta[1] / length, delta[2] / length)
        rapid = _limit_by_axis(limits.max_speed, unit)
        programmed = rapid if is_rapid else speed * length if inverse_time else speed
        acceleration = _limit_by_axis(limits.acceleration, unit)
        block = Block(steps, length, unit, acceleration, rapid, programmed, is_rapid, keeps_feed, junction_speed=0.0)
        if self.blocks and self._last is not None:
            block.junction_speed = _junction_speed(self._last.unit, unit, limits)
        self._set_nominal(block, self._last)
        self.blocks.append(block)
        self._last = block
        self.position = target
        self.recalculate(tail_speed)
        return True

    def _set_nominal(self, block: Block, previous: Block | None) -> None:
        if block.is_rapid:
            nominal = block.rapid_speed * self.rapid_override / 100
        elif block.keeps_feed:
            nominal = min(block.programmed_speed, block.rapid_speed)
        else:
            feed = min(block.programmed_speed, block.rapid_speed) if self._caps_first else block.programmed_speed
            nominal = min(feed * self.feed_override / 100, block.rapid_speed)
        block.nominal_speed = max(nominal, MINIMUM_SPEED)
        before = previous.nominal_speed if previous is not None else UNLIMITED
        block.max_entry_speed = min(block.junction_speed, block.nominal_speed, before)

    def apply_overrides(self, tail_speed: float) -> None:
        """Nominal speeds after a changed override."""
        previous: Block | None = None
        for block in self.blocks:
            self._set_nominal(block, previous)
            previous = block
        self.recalculate(tail_speed)

    def recalculate(self, tail_speed: float) -> None:
        """Entry speeds of all blocks, the first being entered (or under way) at ``tail_speed``."""
        blocks = self.blocks
        if not blocks:
            return
        exit_squared = 0.0
        for index in range(len(blocks) - 1, 0, -1):
            block = blocks[index]
            reachable = exit_squared + 2 * block.acceleration * block.remaining_mm
            exit_squared = min(block.max_entry_speed**2, reachable)
            block.entry_speed = math.sqrt(exit_squared)
        first = blocks[0]
        first.entry_speed = tail_speed
        before = first
        for index in range(1, len(blocks)):
            block = blocks[index]
            reachable = before.entry_speed**2 + 2 * before.acceleration * before.remaining_mm
            if block.entry_speed**2 > reachable:
                block.entry_speed = math.sqrt(reachable)
            before = block

    @property
    def exit_speed(self) -> float:
        """The speed at which the first block is left."""
        return self.blocks[1].entry_speed if len(self.blocks) > 1 else 0.0


def _junction_speed(before: Sequence[float], after: Sequence[float], limits: Limits) -> float:
    """Highest speed round a corner: that of a circle that leaves the corner by the junction deviation."""
    cosine = -sum(a * b for a, b in zip(before, after, strict=True))
    if cosine > 0.999999:
        return 0.0
    if cosine < -0.999999:
        return UNLIMITED
    turn = [b - a for a, b in zip(before, after, strict=True)]
    norm = math.sqrt(sum(t * t for t in turn))
    acceleration = _limit_by_axis(limits.acceleration, [t / norm for t in turn])
    half_sine = math.sqrt(0.5 * (1 - cosine))
    return math.sqrt(acceleration * limits.junction_deviation_mm * half_sine / (1 - half_sine))
