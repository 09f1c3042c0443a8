"""Feeds a controller in slave mode with set-points, a few ahead of what it executes, and never waits.

Slave mode lasts as long as a motion. It is entered before the first set-point, and left when the arm has stood at the
last one: a buffer that runs empty is an error of the controller, and by it a host that dies stops the arm.
"""

import math
from collections.abc import Callable

from drivers.clock import Clock
from drivers.motion.bcap.path import PERIOD_S, Path
from drivers.motion.bcap.results import E_BUF_FULL, S_BUF_FULL, failed, result_words
from drivers.motion.bcap.robot import POSE_BUFFERED, Pose, Robot
from drivers.motion.bcap.session import BcapSession, Call
from drivers.motion.interface import Vector

BUFFERED = 3
"""How many set-points wait in the controller."""
RESTS = BUFFERED + 1
"""So many set-points at one place have pushed the last moving one out of the buffer."""
MOST_RESTS = 40
"""The arm itself follows a little later; longer than this it is not waited for."""
SETTLED_MM = 0.005
FILLED_S = 0.1
"""Nobody is kept longer by a controller that never says that its buffer is full."""
RETRY_S = PERIOD_S / 2
"""A reply is due after one or two milliseconds, and what is lost must be made good before the buffer is empty."""
_SLAVE_MODE, _MOVE = "slvChangeMode", "slvMove"


class Feeder:
    """The set-points of one arm. Only ``held`` may be written by another thread."""

    def __init__(self, session: BcapSession, clock: Clock, robot: Robot, pose_of: Callable[[Vector], Pose]) -> None:
        """``pose_of`` makes a pose of the robot's frame from a point of {R}."""
        self._session = session
        self._clock = clock
        self._robot = robot
        self._pose_of = pose_of
        self._call: Call | None = None
        self._leaving = False
        self._unsent: Pose | None = None
        self._due_s = 0.0
        self._rests = 0
        self._seen: Pose | None = None
        self._has_been_full = False
        self.path = Path()
        self.is_on = False
        """Whether the controller is in slave mode, as far as known."""
        self.held = False
        """Whether to slow down to standstill on the path, and wait there."""

    def enter(self, position_mm: Vector) -> None:
        """Enter slave mode; the arm stands at ``position_mm``."""
        while self._leaving:
            self._session.poll(PERIOD_S / 4)
            self.feed()
        if self.is_on:
            return
        if self.path.finished:
            self.path.restart(position_mm)
        self._robot.execute(_SLAVE_MODE, POSE_BUFFERED)
        self._call = self._unsent = self._seen = None
        self._rests, self._due_s, self.is_on = 0, self._clock.now_s(), True
        self._has_been_full = False

    def fill(self) -> None:
        """Send the first set-points without a pause: only a full buffer lets anybody ask for anything else."""
        deadline_s = self._clock.now_s() + FILLED_S
        while self.is_on and not self._has_been_full and not self._leaving and self._clock.now_s() < deadline_s:
            self.feed()
            self._session.poll(PERIOD_S / 8)

    def forget(self) -> None:
        """The controller has left slave mode, or will be told to: nothing is left to feed."""
        self._call = self._unsent = None
        self._leaving = self.is_on = self.held = False
        self.path.restart(self.path.position_mm)

    def leave_at_once(self) -> None:
        """Out of slave mode, wherever the arm is."""
        self._robot.execute(_SLAVE_MODE, 0)
        self.is_on = False

    def feed(self) -> None:
        """Take in the reply of the last set-point, and send the next one if it is due."""
        if not self.is_on or self._session.is_waiting or self._session.is_lost:
            return
        self._session.poll(0.0)
        if self._call is not None:
            if not self._call.is_over:
                return
            call, self._call = self._call, None
            self._hear(call)
        if self.is_on and self._session.fault is None and self._clock.now_s() >= self._due_s:
            self._send()

    def _send(self) -> None:
        if self._unsent is None:
            if self._is_at_rest:
                self._leaving = True
                self._call = self._robot.begin(_SLAVE_MODE, 0, retry_s=RETRY_S)
                return
            self._rests = 0 if self.path.next(braking=self.held) else self._rests + 1
            self._unsent = self._pose_of(self.path.position_mm)
        self._call = self._robot.begin(_MOVE, (*self._unsent, 0.0), retry_s=RETRY_S)

    @property
    def _is_at_rest(self) -> bool:
        if self._rests < RESTS or not (self.held or self.path.finished):
            return False
        end = self._pose_of(self.path.position_mm)
        off_mm = 0.0 if self._seen is None else math.dist(self._seen[:3], end[:3])
        return off_mm <= SETTLED_MM or self._rests >= MOST_RESTS

    def _hear(self, call: Call) -> None:
        now_s = self._clock.now_s()
        result = call.result
        if call.error is not None or result is None:
            self._stop(str(call.error).removeprefix(f"{self._session.name}: "))
        elif result == E_BUF_FULL:
            self._has_been_full = True
            self._due_s = now_s + PERIOD_S / 2
        elif failed(result):
            self._stop(result_words(result))
        elif self._leaving:
            self._leaving = self.is_on = False
        else:
            self._unsent = None
            self._has_been_full |= result == S_BUF_FULL
            # A little early, so that the buffer stays full whatever the two clocks make of 8 ms.
            self._due_s = now_s + 0.75 * PERIOD_S if result == S_BUF_FULL else now_s
            if isinstance(call.value, tuple) and all(isinstance(each, float) for each in call.value[:3]):
                self._seen = tuple(float(each) for each in call.value[:3] if isinstance(each, float))

    def _stop(self, words: str) -> None:
        self.is_on = self._leaving = False
        self._unsent = None
        self._session.latch(f"motion stopped: {words}")
