"""From blocks to motor positions: short segments of constant speed are prepared ahead and then played in time."""

import math
from collections import deque
from dataclasses import dataclass

from firmware_sim.grbl_planner import Block, Planner

SEGMENT_S = 0.01
TICK_S = 0.002
_KEPT_SEGMENTS = 2
_TINY_MM = 1e-9


@dataclass
class _Segment:
    """Motion already committed; the block's state after it, so that prepared motion can be taken back."""

    duration_s: float
    steps: tuple[float, float, float]
    block: Block
    remaining_mm: float
    speed: float


class Stepper:
    """Plays segments. ``position`` counts motor steps since power-up, as floats while between two steps."""

    def __init__(self, planner: Planner, capacity: int) -> None:
        self._planner = planner
        self._capacity = capacity
        self._segments: deque[_Segment] = deque()
        self._profile: deque[tuple[float, float, float]] = deque()
        self._stale = True
        self._segment_start_s = 0.0
        self._played = 0.0
        self.position = [0.0, 0.0, 0.0]
        self.moves_axis = [True, True, True]
        self.running = False
        self.speed = 0.0
        """At the end of what is prepared: what the firmware reports as F."""
        self.holding = False
        self.ended = False
        """A hold has been prepared down to standstill: nothing more is prepared."""

    def reset(self) -> None:
        """Stop dead and forget what was prepared."""
        self._segments.clear()
        self._profile.clear()
        self._stale = True
        self._played = 0.0
        self.running = False
        self.speed = 0.0
        self.holding = False
        self.ended = False
        self.moves_axis = [True, True, True]
        self.position = [float(round(p)) for p in self.position]

    def replan(self) -> None:
        """The blocks' speeds have changed."""
        self._stale = True

    def hold(self) -> None:
        """From the next prepared segment on, slow down to standstill."""
        self.holding = True
        self._stale = True

    def release(self) -> None:
        """Normal operation after a hold."""
        self.holding = False
        self.ended = False
        self._stale = True

    def drop_prepared(self) -> None:
        """Take back all prepared segments but the one being played and the next."""
        planner = self._planner
        while len(self._segments) > _KEPT_SEGMENTS:
            segment = self._segments.pop()
            if not planner.blocks or planner.blocks[0] is not segment.block:
                planner.blocks.appendleft(segment.block)
            segment.block.remaining_mm += self._length(segment)
        if self._segments:
            current = self._segments[-1]
            current.block.remaining_mm = current.remaining_mm
            if current.remaining_mm > _TINY_MM and (not planner.blocks or planner.blocks[0] is not current.block):
                planner.blocks.appendleft(current.block)
            self.speed = current.speed
        planner.recalculate(self.speed)
        self._stale = True

    @staticmethod
    def _length(segment: _Segment) -> float:
        block = segment.block
        axis = max(range(3), key=lambda i: abs(block.steps[i]))
        return segment.steps[axis] / block.steps[axis] * block.length_mm

    # --- preparing -------------------------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Fill the segment buffer."""
        planner = self._planner
        while len(self._segments) < self._capacity and not self.ended and planner.blocks:
            block = planner.blocks[0]
            if self._stale:
                self._plan_profile(block)
            if self.holding and not self._profile:
                self.ended = True
                return
            self._prepare_segment(block)
            if block.remaining_mm <= _TINY_MM:
                planner.blocks.popleft()
                self._stale = True
            elif self.holding and not self._profile:
                self.ended = True

    def _prepare_segment(self, block: Block) -> None:
        left_s = SEGMENT_S
        travel = 0.0
        while left_s > 1e-9 and self._profile:
            start, end, distance = self._profile.popleft()
            duration = 2 * distance / (start + end)
            if duration <= left_s:
                travel += distance
                left_s -= duration
                self.speed = end
            else:
                self.speed = start + (end - start) * left_s / duration
                part = (start + self.speed) / 2 * left_s
                travel += part
                if distance - part > _TINY_MM:
                    self._profile.appendleft((self.speed, end, distance - part))
                else:
                    self.speed = end
                left_s = 0.0
        if not self._profile and not self.holding:
            travel = block.remaining_mm
        share = travel / block.length_mm
        block.remaining_mm -= travel
        steps = (block.steps[0] * share, block.steps[1] * share, block.steps[2] * share)
        self._segments.append(_Segment(SEGMENT_S - left_s, steps, block, block.remaining_mm, self.speed))

    def _plan_profile(self, block: Block) -> None:
        """Phases (start speed, end speed, distance) of what is left of a block."""
        self._stale = False
        start, distance, twice = self.speed, block.remaining_mm, 2 * block.acceleration
        if self.holding:
            stop = start**2 / twice
            if stop <= distance:
                phases = [(start, 0.0, stop)]
            else:
                phases = [(start, math.sqrt(start**2 - twice * distance), distance)]
        else:
            phases = _trapezoid(start, block.nominal_speed, self._planner.exit_speed, distance, twice)
        self._profile = deque(phase for phase in phases if phase[2] > _TINY_MM)

    # --- playing ---------------------------------------------------------------------------------------------------

    def wake_up(self, now_s: float) -> None:
        """Start to play."""
        if not self.running:
            self.running = True
            self._segment_start_s = now_s
            self._played = 0.0

    @property
    def next_time_s(self) -> float:
        """When the segment being played ends."""
        if not self.running:
            return math.inf
        if not self._segments:
            return self._segment_start_s
        return self._segment_start_s + self._segments[0].duration_s

    def advance(self, now_s: float) -> bool:
        """Play up to ``now_s``; True when a segment was finished. Stops running when there is none left."""
        finished = False
        while self.running:
            if not self._segments:
                self.running = False
                return True
            segment = self._segments[0]
            share = min(1.0, (now_s - self._segment_start_s) / segment.duration_s)
            if now_s >= self._segment_start_s + segment.duration_s - 1e-9:
                share = 1.0
            part = share - self._played
            moves, position, (x, y, z) = self.moves_axis, self.position, segment.steps
            if moves[0]:
                position[0] += x * part
            if moves[1]:
                position[1] += y * part
            if moves[2]:
                position[2] += z * part
            self._played = share
            if share < 1.0:
                break
            finished = True
            self._segments.popleft()
            self._segment_start_s += segment.duration_s
            self._played = 0.0
            if not self._segments and now_s < self._segment_start_s + 1e-9:
                break
        return finished


def _trapezoid(
    start: float, cruise: float, end: float, distance: float, twice: float
) -> list[tuple[float, float, float]]:
    """Constant acceleration ``twice``/2 from ``start`` towards ``cruise`` and on to ``end``, as far as reachable."""
    first = abs(cruise**2 - start**2) / twice
    last = (cruise**2 - end**2) / twice
    if first + last <= distance:
        return [(start, cruise, first), (cruise, cruise, distance - first - last), (cruise, end, last)]
    if start > cruise:
        return [(start, math.sqrt(max(start**2 - twice * distance, 0.0)), distance)]
    peak_squared = (start**2 + end**2 + twice * distance) / 2
    if peak_squared <= start**2:
        return [(start, math.sqrt(max(start**2 - twice * distance, end**2)), distance)]
    if peak_squared <= end**2:
        return [(start, math.sqrt(start**2 + twice * distance), distance)]
    peak = math.sqrt(peak_squared)
    up = (peak_squared - start**2) / twice
    return [(start, peak, up), (peak, end, distance - up)]
