"""Where the bone begins, at each point: felt by the spindle, not believed from the pictures.

The tip goes down in single steps of 10 um. Each next step is permitted by the load of the one before it being that of
air, so contact overruns by one step. What air takes is learned on the way, within bounds: bone must not pass for drift.
Two steps with load in a row are contact, or up to four where all are faint, as the torque has whims of two steps: bone
is felt more with each. What the first points teach about the surface's error lets the later ones start close above it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import fmean

from drivers.errors import PlanError, SafetyStop
from drivers.motion.interface import Vector
from drivers.spindle.interface import SpindleStatus
from milling.hands import TRAVEL_FEED_MM_S, Hands
from milling.load import Idle

STEP_MM = 0.01
FEED_MM_S = 0.4
NEAR_MM = 0.03
"""Start above the predicted contact, once the surface's error is known."""
SIGMAS = 4.0
SURE_SIGMAS = 6.5
"""Of 384 second steps into bone, 2 % were fainter; chance touches are."""
FAINT_STEPS = 4
SETTLE_S = 0.5
"""After the run-up, until the drive's speed loop has come to rest."""
BETWEEN_MM = 0.08
"""Lift before going to the next point."""
APPROACH_FEED_MM_S = 2.0
IDLE_AGAIN_S = 0.25
MOST_IDLE_DRIFT = 0.05
AIR_WEIGHT = 0.5
AIR_STEP = 0.25
"""Sigmas that the torque of the air may change by on the way from one point to the next, and at a step down. A drive's
zero drifts by a tenth of that; bone, should it be met on the way across, would be a hundred times more."""
AIR_DESCENT = 0.5
"""Sigmas that it may rise by in all steps down at one place: bone that is met softly must not be learned as air."""


@dataclass
class ContactFinder:
    """Finds the contact under given places, one after the other round the ring."""

    hands: Hands
    idle: Idle
    """Torque of the air; kept up to date on the way from point to point."""
    floor_z_mm: float
    """No tip height below this is ever asked for."""
    _torques: list[float] = field(default_factory=list)
    _lowest_z_mm: float = float("-inf")
    _in_kerf: bool = False
    _error_mm: float | None = None
    _first: Idle = field(init=False)

    def __post_init__(self) -> None:
        self._first = self.idle

    def find_all(
        self,
        xy_mm: list[tuple[float, float]],
        start_z_mm: list[float],
        predicted_z_mm: list[float],
        told: Callable[[int, float], None],
        *,
        across_z_mm: float | None = None,
        lowest_z_mm: list[float] | None = None,
    ) -> list[float]:
        """Heights of the tip at contact, (n,) mm in {R}.

        Args:
            xy_mm: where.
            start_z_mm: heights that should be in the air.
            predicted_z_mm: where contact should be.
            told: each point's index and height, as it is found.
            across_z_mm: height on the way from place to place; close above the last one, where left out.
            lowest_z_mm: heights at which to give up; the floor, where left out.

        Raises:
            PlanError: no bone down to the floor, or bone above the start.
        """
        self.hands.on_torque.append(self._hear)
        found: list[float] = []
        try:
            for index, (x, y) in enumerate(xy_mm):
                start = start_z_mm[index]
                if self._error_mm is not None:
                    start = min(start, predicted_z_mm[index] + self._error_mm + NEAR_MM)
                clear = max(start, found[-1] if found else start) + BETWEEN_MM
                self._in_kerf = across_z_mm is not None
                clear = clear if across_z_mm is None else max(clear, across_z_mm)
                self._lowest_z_mm = self.floor_z_mm if lowest_z_mm is None else lowest_z_mm[index]
                height = self._find(index, (x, y), start, clear, start_z_mm[index])
                self._error_mm = height - predicted_z_mm[index]
                found.append(height)
                told(index, height)
        finally:
            self.hands.on_torque.remove(self._hear)
        return found

    def _find(self, index: int, xy: tuple[float, float], start: float, clear: float, highest: float) -> float:
        x, y = xy
        position = self.hands.motion.status().position_mm
        if position[2] < clear:
            self.hands.travel((position[0], position[1], clear), TRAVEL_FEED_MM_S)
        self._torques.clear()
        self.hands.travel((x, y, clear), TRAVEL_FEED_MM_S)
        if self._in_kerf:
            # Cut before: air. Felt over so long a way, the least drift of its torque would count as bone.
            self.hands.travel((x, y, start + BETWEEN_MM), APPROACH_FEED_MM_S)
        self._follow_air()
        met = False
        while True:
            self._torques.clear()
            self.hands.travel((x, y, start), APPROACH_FEED_MM_S)
            if not self._felt():
                height = self._descend(index, x, y, start)
                if height is not None:
                    return height
            # Bone was met at the very start: this place is higher than thought.
            if start >= highest and met:
                raise PlanError(
                    f"point {index + 1}: bone at or above z = {start:.3f} mm, where there should be air; "
                    "look what lies there, and calibrate again"
                )
            # Or the torque had a whim, as it has at one place in two hundred; where it matters, air is felt once more.
            met = start >= highest
            start = min(start + NEAR_MM, highest)
            self.hands.go((x, y, start + BETWEEN_MM), TRAVEL_FEED_MM_S)
            if met:
                self._torques.clear()
                self.hands.watch(IDLE_AGAIN_S)
                self._follow_air()

    def _descend(self, index: int, x: float, y: float, start: float) -> float | None:
        """Step down from the air; None where bone is met in the first step already."""
        z, touched_at = start, None
        most = self.idle.mean + AIR_DESCENT * self.idle.sigma
        while True:
            z -= STEP_MM
            if z < max(self.floor_z_mm, self._lowest_z_mm):
                raise PlanError(
                    f"point {index + 1}: no bone felt down to z = {z + STEP_MM:.3f} mm, the lowest that is "
                    "permitted there; check that the drill turns and that it is bone"
                )
            if not self._loaded((x, y, z)):
                touched_at = None
                self._follow_air(most)
            elif touched_at is None:
                if z > start - 1.5 * STEP_MM:
                    return None
                touched_at = z
            elif self.idle.above(self._torques, SURE_SIGMAS) or touched_at - z > (FAINT_STEPS - 1.5) * STEP_MM:
                # The first step with load began in the air: contact lies within it.
                return touched_at + STEP_MM / 2

    def _follow_air(self, most: float = float("inf")) -> None:
        """The zero of the torque drifts while points are felt for, by more than a touch within half a minute.

        Raises:
            SafetyStop: it is too far from what it was when the first point was felt for.
        """
        if self._torques:
            by = AIR_WEIGHT * (fmean(self._torques) - self.idle.mean)
            step = AIR_STEP * self.idle.sigma
            self.idle = Idle(min(self.idle.mean + min(max(by, -step), step), most), self.idle.sigma)
            _require_near(self._first, self.idle)

    def _loaded(self, target: Vector) -> bool:
        """Step there, and tell whether the drill felt anything on the way."""
        self._torques.clear()
        self.hands.go(target, FEED_MM_S)
        return self._felt()

    def _felt(self) -> bool:
        return bool(self._torques) and self.idle.above(self._torques, SIGMAS)

    def _hear(self, status: SpindleStatus) -> None:
        self._torques.append(status.torque_fraction)


def measure_idle(hands: Hands, *, settle_s: float = SETTLE_S, duration_s: float = 0.6) -> Idle:
    """Torque of the drill turning in the air.

    Raises:
        SafetyStop: the drive tells too little, or its torque wanders too much to feel bone by.
    """
    hands.watch(settle_s)
    torques: list[float] = []

    def hear(status: SpindleStatus) -> None:
        torques.append(status.torque_fraction)

    hands.on_torque.append(hear)
    try:
        hands.watch(duration_s)
    finally:
        hands.on_torque.remove(hear)
    if len(torques) < 10:
        raise SafetyStop(f"the spindle reported its torque {len(torques)} times in {duration_s:g} s, 10 are needed")
    idle = Idle.of(torques)
    if idle.sigma > 0.1:
        raise SafetyStop(
            f"the idle torque varies by {idle.sigma:.3f} of rated torque, allowed 0.1: bone cannot be felt"
        )
    return idle


def measure_idle_again(hands: Hands, before: Idle) -> Idle:
    """The torque of the air now: a drive's zero drifts, and one that does not come back to it feels no bone.

    Raises:
        SafetyStop: it is too far from what it was.
    """
    idle = measure_idle(hands, settle_s=IDLE_AGAIN_S, duration_s=IDLE_AGAIN_S)
    hands.recorder.event("idle", torque=idle.mean, sigma=idle.sigma)
    _require_near(before, idle)
    return idle


def _require_near(before: Idle, now: Idle) -> None:
    if abs(now.mean - before.mean) > MOST_IDLE_DRIFT:
        raise SafetyStop(
            f"the drill takes {now.mean:.3f} of rated torque in the air, {before.mean:.3f} before, allowed is a "
            f"change of {MOST_IDLE_DRIFT:g}: bone cannot be felt; look at drill and chuck"
        )
