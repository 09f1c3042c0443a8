"""What the emulated g2core board moves: blocks planned and played, feed holds, homing.

The S-curves of g2core are replaced by constant accelerations that need the same time; junctions are those of the
planner of ``grbl_planner``.
"""

import math
from collections.abc import Callable, Generator

from firmware_sim.grbl_planner import Limits, Planner, steps_of
from firmware_sim.grbl_stepper import Stepper
from firmware_sim.tinyg_settings import AXES, Axes, Settings

BUFFERS = 48
"""Blocks that the planner holds."""
HEADROOM = 4
"""Free blocks without which no line is read."""
BLOCK_TIMEOUT_S = 0.030
"""From rest, motion waits this long for another block (BLOCK_TIMEOUT_MS)."""
_SEGMENTS = 3
_JUNCTION_DEVIATION_MM = 0.02
_HOMING_ORDER = (2, 0, 1)

Switches = Callable[[], tuple[bool, bool, bool]]
Homing = Generator[None, None, bool]
"""Yields while a move lasts; whether all axes were homed."""


class Motion:
    """Planner and motors. Positions in machine coordinates, mm; the motors stand at zero at power-up."""

    def __init__(self, settings: Settings, switches: Switches) -> None:
        self._settings = settings
        self._switches = switches
        self._planner = Planner(BUFFERS, caps_feed_before_override=False)
        self.stepper = Stepper(self._planner, _SEGMENTS)
        self._origin_steps = [0, 0, 0]
        self._starts_at_s = 0.0
        self._homing: Homing | None = None
        self.held = False
        """At standstill in a feed hold."""
        self.homed = [False, False, False]
        self.target_mm: Axes = (0.0, 0.0, 0.0)
        """Where the last block ends."""

    # --- what is told ----------------------------------------------------------------------------------------------

    @property
    def position_mm(self) -> Axes:
        """Of the motors, now."""
        spm = self._settings.steps_per_mm
        x, y, z = (n / s for n, s in zip(self._machine_steps, spm, strict=True))
        return x, y, z

    @property
    def buffers_free(self) -> int:
        """Room in the planner; the block under way takes one."""
        under_way = self.stepper.running and not self._planner.blocks
        return self._planner.free - int(under_way)

    @property
    def busy(self) -> bool:
        """Whether anything moves, or is planned."""
        return self.stepper.running or bool(self._planner.blocks)

    @property
    def slowing(self) -> bool:
        """In a feed hold that has not come to rest."""
        return self.stepper.holding

    @property
    def is_homing(self) -> bool:
        """In a homing cycle."""
        return self._homing is not None

    # --- what is asked ---------------------------------------------------------------------------------------------

    def add(self, target_mm: Axes, feed_mm_min: float | None, now_s: float) -> None:
        """Queue a straight move; no feed is as fast as the axes go."""
        if not self.busy:
            self._starts_at_s = now_s + BLOCK_TIMEOUT_S
        rates = self._settings.axes("vm" if feed_mm_min is None else "fr")
        self._planner.add(
            steps_of(target_mm, self._settings.steps_per_mm),
            self._limits(rates),
            speed=(feed_mm_min or 0.0) / 60,
            is_rapid=feed_mm_min is None,
            tail_speed=self.stepper.speed,
        )
        self.target_mm = target_mm
        self.stepper.replan()

    def hold(self) -> None:
        """Slow down on the path; what does not move cannot be held."""
        if self.stepper.running and not self.held:
            self.stepper.hold()

    def resume(self, now_s: float) -> None:
        """Go on after a hold."""
        self.held = False
        self._starts_at_s = now_s

    def drop_queue(self) -> None:
        """Forget all blocks; the motors stand where they stand."""
        self._homing = None
        self.held = False
        self._planner.reset()
        self.stepper.reset()
        self._plan_from_here()

    def lose_everything(self) -> None:
        """A reset: stop dead, and count from here."""
        self.drop_queue()
        self._origin_steps = [-round(position) for position in self.stepper.position]
        self._plan_from_here()
        self.homed = [False, False, False]

    def start_homing(self, axes: set[str]) -> None:
        """Begin a homing cycle of these axes."""
        self._homing = self._home([axis for axis in _HOMING_ORDER if AXES[axis].upper() in axes])

    # --- time ------------------------------------------------------------------------------------------------------

    def advance(self, now_s: float) -> bool | None:
        """Move on to ``now_s``; whether homing succeeded, where it has just ended."""
        stepper = self.stepper
        if stepper.running:
            stepper.prepare()
            stepper.advance(now_s)
        if stepper.holding and not stepper.running:
            self._stand()
        elif not stepper.running and self._planner.blocks and not self.held and now_s >= self._starts_at_s:
            stepper.prepare()
            stepper.wake_up(now_s)
        if self._homing is None:
            return None
        try:
            next(self._homing)
        except StopIteration as end:
            self.drop_queue()
            return bool(end.value)
        return None

    def _stand(self) -> None:
        self.stepper.release()
        self._planner.recalculate(0.0)
        self.held = True

    # --- homing ----------------------------------------------------------------------------------------------------

    def _home(self, axes: list[int]) -> Homing:
        """Off the switch if it is pressed; to it; off it; slowly to it; off it by the pull-off (cycle of G28.2)."""
        settings = self._settings
        for axis in axes:
            name = AXES[axis]
            self.homed[axis] = False
            sign = 1.0 if settings[f"{name}hd"] else -1.0
            search, latch = settings[f"{name}sv"], settings[f"{name}lv"]
            backoff, pull_off = abs(settings[f"{name}lb"]), max(0.0, settings[f"{name}zb"])
            travel = abs(settings[f"{name}tm"] - settings[f"{name}tn"]) + backoff
            if self._switches()[axis]:
                yield from self._move(axis, -sign * backoff, search)
            for distance, speed in ((sign * travel, search), (-sign * backoff, search), (sign * 1.5 * backoff, latch)):
                towards = distance * sign > 0
                touched = yield from self._move(axis, distance, speed, until_pressed=towards)
                if towards and not touched:
                    return False
            yield from self._move(axis, -sign * pull_off, search)
            end_mm = settings[f"{name}tm"] if sign > 0 else settings[f"{name}tn"]
            steps = round(end_mm * settings.steps_per_mm[axis])
            self._origin_steps[axis] = steps - round(self.stepper.position[axis])
            self._plan_from_here()
            self.homed[axis] = True
        return True

    def _move(self, axis: int, by_mm: float, feed: float, *, until_pressed: bool = False) -> Homing:
        """Move one axis; whether its switch stopped it."""
        target = list(self.position_mm)
        target[axis] += by_mm
        self.add((target[0], target[1], target[2]), feed, -BLOCK_TIMEOUT_S)
        while self.busy:
            yield
            if until_pressed and self._switches()[axis]:
                self._planner.reset()
                self.stepper.reset()
                self._plan_from_here()
                return True
        self._plan_from_here()
        return False

    # --- inner -----------------------------------------------------------------------------------------------------

    @property
    def _machine_steps(self) -> tuple[int, int, int]:
        x, y, z = (round(p) + o for p, o in zip(self.stepper.position, self._origin_steps, strict=True))
        return x, y, z

    def _plan_from_here(self) -> None:
        self._planner.position = self._machine_steps
        self.target_mm = self.position_mm

    def _limits(self, rates: Axes) -> Limits:
        x, y, z = (rate / 60 for rate in rates)
        settings = self._settings
        return Limits(settings.steps_per_mm, (x, y, z), settings.acceleration, _JUNCTION_DEVIATION_MM)


def beyond(target_mm: Axes, settings: Settings, homed: list[bool]) -> int | None:
    """Which soft limit a target exceeds: twice the axis, plus one at the high end; axes are checked once homed."""
    for axis, name in enumerate(AXES):
        low, high = settings[f"{name}tn"], settings[f"{name}tm"]
        if not homed[axis] or math.isclose(low, high) or max(abs(low), abs(high)) > 1e6:
            continue
        if target_mm[axis] < low - 1e-6:
            return 2 * axis
        if target_mm[axis] > high + 1e-6:
            return 2 * axis + 1
    return None
