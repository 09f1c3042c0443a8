"""Slave mode of the emulated robot: a short buffer of set-points, of which one is taken every 8 ms."""

import math
from collections import deque
from typing import Final

PERIOD_S: Final = 0.008
DEPTH: Final = 3
GREATEST_STEP_MM: Final = 2.0
"""A quarter of a metre per second."""
GREATEST_TURN_DEG: Final = 0.5

S_OK: Final = 0
S_BUFFER_FULL: Final = 0x0F200501
E_BUFFER_FULL: Final = 0x83201483
E_LATE_OR_TOO_FAST: Final = 0x84201482
E_NOT_IN_SLAVE_MODE: Final = 0x83500121

Pose = tuple[float, ...]


class SlaveMotion:
    """Where the arm is, and where the set-points take it: straight from one to the next, within one period.

    Left out: the servo's own lag, limits of the joints, overwriting and synchronous slave mode.
    """

    def __init__(self, pose: Pose) -> None:
        self.pose = pose
        """X, Y, Z in mm, RX, RY, RZ in degrees, figure."""
        self.mode = 0
        self._buffer: deque[Pose] = deque()
        self._from = self._to = pose
        self._taken_s = 0.0
        self._has_begun = False

    @property
    def moving(self) -> bool:
        """Whether it is on its way from one set-point to another."""
        return self._from != self._to

    def enter(self, mode: int) -> None:
        """From where it stands; nothing is due before the first set-point."""
        self.stop()
        self.mode = mode

    def stop(self) -> None:
        """At once, out of slave mode."""
        self.mode = 0
        self._buffer.clear()
        self._from = self._to = self.pose
        self._has_begun = False

    def put(self, pose: Pose) -> int:
        """A set-point; the result says whether it was taken."""
        if not self.mode:
            return E_NOT_IN_SLAVE_MODE
        if len(self._buffer) >= DEPTH:
            return E_BUFFER_FULL
        self._buffer.append(pose)
        return S_BUFFER_FULL if len(self._buffer) == DEPTH else S_OK

    def advance_to(self, from_s: float, time_s: float) -> int:
        """Let time go on; what went wrong meanwhile, by which slave mode ends."""
        tick = math.floor(from_s / PERIOD_S + 1e-6) + 1
        while self.mode and tick * PERIOD_S <= time_s + 1e-9:
            self.pose = self._to
            if (error := self._take(tick * PERIOD_S)) != S_OK:
                self.stop()
                return error
            tick += 1
        if self.mode:
            part = min(1.0, max(0.0, (time_s - self._taken_s) / PERIOD_S))
            self.pose = (
                tuple(a + part * (b - a) for a, b in zip(self._from, self._to, strict=True)) if part < 1 else self._to
            )
        return S_OK

    def _take(self, time_s: float) -> int:
        if not self._buffer:
            return E_LATE_OR_TOO_FAST if self._has_begun else S_OK
        self._has_begun = True
        target = self._buffer.popleft()
        step_mm = math.dist(self._to[:3], target[:3])
        turn_deg = max(abs((a - b + 180.0) % 360.0 - 180.0) for a, b in zip(self._to[3:6], target[3:6], strict=True))
        if not (step_mm <= GREATEST_STEP_MM and turn_deg <= GREATEST_TURN_DEG):
            return E_LATE_OR_TOO_FAST
        self._from, self._to, self._taken_s = self._to, target, time_s
        return S_OK
