"""How far down the bone goes under each point: load, picture and neighbours, weighed as one probability.

T is the depth, below a point's own contact, at which the ball comes through. Every cue says something about the
excess x = depth - T, and says it with a known error (decision 0025; ``python -m studies.cue_errors`` measures both):

- the load of a pass, against what bone takes, falls from 0.97 at x = -15 um to 0.73 at x = +57 um;
- the completion read from a picture is 0.9 at x = -20 um and 0.98 at x = +15 um, shifted by some 20 um for a whole
  specimen, and by 70 um in bad light;
- bone does not change its thickness much from one point to the next.

Each cue may also be plainly wrong (glare, blood, thin bone over a bed of its colour, a pit whose flanks are cut), so
none may ever weigh more than its floor lets it: where two contradict each other, the answer is "unknown".
"""

from collections import deque
from collections.abc import Mapping, Sequence
from math import hypot
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

Floats = npt.NDArray[np.float64]

GRID_MM = 0.005
LOWEST_MM = 0.05

LOAD_AT_MM = (-0.05, -0.015, -0.005, 0.005, 0.015, 0.025, 0.035, 0.045, 0.057, 0.08, 0.12)
LOAD = (1.0, 0.97, 0.96, 0.95, 0.94, 0.89, 0.845, 0.79, 0.725, 0.66, 0.58)
"""Load, as a share of what bone takes, at those excesses."""
LOAD_SIGMA = 0.11
"""Of one pass; 0.08 to 0.1 was measured, more is used because errors of passes that follow each other are alike."""
LOAD_FLOOR = 3e-4
"""What all passes of a point together may weigh at most."""
BONE_PASSES = 48
"""Passes over what is bone for certain, whose median load counts as 1: the torque of the air drifts."""
BONE_PASSES_LEAST = 16
MOST_DRIFT = 0.1
MOST_LOAD = 1.2
"""More than bone takes: something else is cut as well, and says nothing about what is below the ball."""
SETTLED_MM = 0.12
CERTAIN_MM = 0.02
CERTAIN = 0.05

COMPLETION = (0.5, 0.55, 0.65, 0.725, 0.775, 0.825, 0.875, 0.915, 0.945, 0.97, 0.985)
COMPLETION_AT_MM = (-0.18, -0.16, -0.122, -0.097, -0.075, -0.053, -0.031, -0.014, 0.0, 0.011, 0.02)
COMPLETION_SIGMA_MM = (0.06, 0.055, 0.045, 0.035, 0.03, 0.027, 0.025, 0.024, 0.024, 0.024, 0.024)
"""The excess that a completion tells of, and how well."""
HOLE_AT_MM, HOLE_SIGMA_MM = 0.005, 0.025
"""From there on a picture says "through" and tells no more."""
PICTURE_FLOOR = 0.03
PICTURES = 5
"""The newest readings of a point, whose median counts."""
SHIFTS_MM = tuple(0.02 * step for step in range(-4, 5))
SHIFT_SIGMA_MM = 0.025
"""What all pictures of one specimen may be wrong by together."""

CONTACT_SIGMA_MM = 0.012
SLOPE = 0.045
"""Change of thickness per mm along the ring, one sigma."""
JUMP = 0.002
"""Weight of any change at all from one point to the next, against that of none."""


class Thickness:
    """What is known of T at every point of a closed ring."""

    def __init__(self, n_points: int, *, low_mm: float, high_mm: float, pitch_mm: float) -> None:
        """Begin with the prior.

        Args:
            n_points: points on the ring.
            low_mm: two sigmas below the middle of the thickness prior.
            high_mm: two sigmas above it.
            pitch_mm: from point to point.
        """
        self._n = n_points
        self._grid = np.arange(LOWEST_MM, high_mm + 0.15, GRID_MM)
        self._prior = np.exp(-0.5 * ((self._grid - (low_mm + high_mm) / 2) / ((high_mm - low_mm) / 4)) ** 2) + 0.01
        self._prior /= self._prior.sum()
        step_mm = hypot(CONTACT_SIGMA_MM, SLOPE * pitch_mm)
        change = np.exp(-0.5 * ((self._grid[:, None] - self._grid) / step_mm) ** 2) + JUMP
        self._change = change / change.sum(axis=1, keepdims=True)
        self._load = np.zeros((n_points, len(self._grid)))
        """Log-likelihood of all passes."""
        self._seen: list[deque[tuple[float, float]]] = [deque(maxlen=PICTURES) for _ in range(n_points)]
        self._bone_seen: list[tuple[float, float] | None] = [None] * n_points
        """The newest median reading that was not "through", and its depth."""
        self._bone: deque[float] = deque(maxlen=BONE_PASSES)
        self._below: Floats | None = None
        """(n, grid) probability that T is below; None where evidence came since."""

    def weighed(self, index: int, depth_mm: float, ratio: float) -> None:
        """A pass that ended at ``depth_mm`` took ``ratio`` of what bone takes."""
        if depth_mm > SETTLED_MM and self.through(index, depth_mm + CERTAIN_MM) < CERTAIN:
            self._bone.append(ratio)
        level = 1.0
        if len(self._bone) >= BONE_PASSES_LEAST:
            level = min(max(median(self._bone), 1 - MOST_DRIFT), 1 + MOST_DRIFT)
        if ratio / level > MOST_LOAD:
            return
        expected = np.interp(depth_mm - self._grid, LOAD_AT_MM, LOAD)
        # A little more load than bone takes is no more bone.
        self._load[index] -= 0.5 * ((min(ratio / level, 1.0) - expected) / LOAD_SIGMA) ** 2
        self._below = None

    def pictured(self, index: int, depth_mm: float, completion: float) -> None:
        """A picture of the point, cut to ``depth_mm``, reads as ``completion``."""
        self._seen[index].append((completion, depth_mm))
        median_seen = self._newest(index)
        if median_seen[0] < COMPLETION[-1]:
            self._bone_seen[index] = median_seen
        self._below = None

    def forget_pictures(self, index: int) -> None:
        """What was seen of the point tells nothing."""
        if self._seen[index]:
            self._seen[index].clear()
            self._bone_seen[index] = None
            self._below = None

    def pictures(self, index: int) -> dict[str, Any]:
        """What was seen of the point, for a later run; as JSON."""
        return {"seen": list(self._seen[index]), "bone_seen": self._bone_seen[index]}

    def recall_pictures(self, index: int, kept: Mapping[str, Any]) -> None:
        """What an earlier run saw of the point."""
        self._seen[index] = deque(((c, depth) for c, depth in kept["seen"]), maxlen=PICTURES)
        self._bone_seen[index] = None if kept["bone_seen"] is None else (kept["bone_seen"][0], kept["bone_seen"][1])
        self._below = None

    def through(self, index: int, depth_mm: float) -> float:
        """Probability that the ball, at ``depth_mm`` below contact, has come through: P(T < depth)."""
        if self._below is None:
            self._below = np.cumsum(self._posterior(), axis=1)
        return float(np.interp(depth_mm - GRID_MM / 2, self._grid, self._below[index], left=0.0))

    def _posterior(self) -> Floats:
        load = np.maximum(np.exp(self._load - self._load.max(axis=1, keepdims=True)), LOAD_FLOOR)
        shifted = self._pictures()
        evidence = np.log((shifted * load * self._prior).sum(axis=2)).sum(axis=1)
        evidence -= 0.5 * (np.asarray(SHIFTS_MM) / SHIFT_SIGMA_MM) ** 2
        weight = np.exp(evidence - evidence.max())
        return self._round_the_ring(load * np.tensordot(weight / weight.sum(), shifted, axes=1))

    def _pictures(self) -> Floats:
        """(shifts, n, grid) likelihood of the newest pictures, if all of them are wrong by each shift."""
        likelihood = np.ones((len(SHIFTS_MM), *self._load.shape))
        shown = [index for index in range(self._n) if self._seen[index]]
        if not shown:
            return likelihood
        completion, depth_mm = np.array([self._newest(index) for index in shown]).T[:, :, None]
        excess_mm = depth_mm - self._grid - np.asarray(SHIFTS_MM)[:, None, None]
        at_mm = np.interp(completion, COMPLETION, COMPLETION_AT_MM)
        sigmas = (excess_mm - at_mm) / np.interp(completion, COMPLETION, COMPLETION_SIGMA_MM)
        said = np.exp(-0.5 * sigmas**2)
        # Below half it only says that there is bone, from the other end on only that there is a hole.
        bone, hole = completion[:, 0] < COMPLETION[0], completion[:, 0] >= COMPLETION[-1]
        said[:, bone] = ndtr(-sigmas[:, bone])
        said[:, hole] = ndtr((excess_mm[:, hole] - HOLE_AT_MM) / HOLE_SIGMA_MM)
        # A hole may be any depth; what was seen before it says how deep at most.
        for place, index in enumerate(shown):
            before = self._bone_seen[index]
            if hole[place] and before is not None:
                at_before_mm = before[1] - self._grid - np.asarray(SHIFTS_MM)[:, None]
                at_before_mm = at_before_mm - np.interp(before[0], COMPLETION, COMPLETION_AT_MM)
                said[:, place] *= ndtr(-at_before_mm / float(np.interp(before[0], COMPLETION, COMPLETION_SIGMA_MM)))
        said /= np.maximum(said.max(axis=2, keepdims=True), 1e-12)
        likelihood[:, shown] = np.maximum(said, PICTURE_FLOOR)
        return likelihood

    def _newest(self, index: int) -> tuple[float, float]:
        """Median completion of the newest pictures, and its depth."""
        return sorted(self._seen[index])[len(self._seen[index]) // 2]

    def _round_the_ring(self, likelihood: Floats) -> Floats:
        """(n, grid) what each point knows together with its neighbours: sum-product, twice round in both directions."""
        forward = _messages(likelihood, self._prior, self._change, range(self._n))
        backward = _messages(likelihood, np.ones_like(self._prior), self._change.T, range(self._n - 1, -1, -1))
        posterior = forward * backward * likelihood
        return np.asarray(posterior / posterior.sum(axis=1, keepdims=True))


def _messages(likelihood: Floats, start: Floats, change: Floats, order: Sequence[int]) -> Floats:
    arrived = np.empty_like(likelihood)
    message = start
    for _ in range(2):
        for index in order:
            arrived[index] = message
            message = (message * likelihood[index]) @ change
            message = message / message.sum()
    return arrived
