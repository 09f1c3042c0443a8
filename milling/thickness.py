"""How far down the bone goes under each point: load, picture and neighbours, weighed as one probability.

T is the depth below a point's own contact, as commanded, at which the ball's sphere comes through the inner surface;
bone gives way by some 10 um under a pass, so the hole itself opens a little later. Every cue says something about T,
and says it with a known error (decision 0044; ``python -m studies.cue_errors`` measures it):

- the load of a pass, against what bone takes, is 0.98 where a tenth of T is left, 0.95 at T, and 0.75 at 1.13 T: the
  hole opens the later the thicker the bone. Passes vary by 0.07, and all passes of one point may be wrong together by
  0.05. In a pit, deeper than its neighbours, the ball cuts its flanks as well: load is no evidence of bone there;
- the completion read from a picture is the share depth / T that is cut, to some 0.07, until there is a hole; a hole
  shows from 13 um past T on, to 12 um;
- bone changes its thickness by some 25 um (10 to 39) from one point to the next.

Each cue may also be plainly wrong (glare, blood, thin bone over a bed of its colour, a pit whose flanks are cut), so
none may ever weigh more than its floor lets it: where two contradict each other, the answer is "unknown".
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from math import hypot
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from milling.limits import Limits

Floats = npt.NDArray[np.float64]

GRID_MM = 0.005
LOWEST_MM = 0.05

LOAD_AT = (
    0.761, 0.821, 0.866, 0.91, 0.955, 0.985, 1.015, 1.045, 1.075, 1.104, 1.134, 1.17, 1.239, 1.358
)  # fmt: skip
LOAD = (
    1.0, 0.997, 0.99, 0.978, 0.965, 0.958, 0.948, 0.922, 0.866, 0.8, 0.745, 0.705, 0.65, 0.57
)  # fmt: skip
"""Load, as a share of what bone takes, at those shares depth / T."""
LOAD_SIGMA = 0.11
"""Of one pass; 0.07 was measured, more is used because errors of passes that follow each other are alike."""
POINT_SIGMA = 0.05
"""What all passes of one point may be wrong by together."""
LOAD_FLOOR = 1e-3
"""What all passes of a point together may weigh at most."""
BONE_PASSES = 48
"""Passes over what is bone for certain, whose median load counts as 1: the torque of the air drifts."""
BONE_PASSES_LEAST = 16
MOST_DRIFT = 0.1
DRIFT_A_PASS = 1.5e-4
"""9 % a minute, at ten passes a second. Were it quicker, pictures that are stuck and say "bone" at every point would
let the droop of all holes pass for drift."""
MOST_LOAD = 1.2
"""More than bone takes: something else is cut as well, and says nothing about what is below the ball."""
PIT_MM = 0.015
"""So much deeper than the mean of its neighbours a point is a pit. They are taken as they stand at the pass, where the
one ahead has not been passed in this lap: half a bite of a level ring counts as well."""
SETTLED_MM = 0.12
CERTAIN_MM = 0.02
CERTAIN = 0.05

COMPLETION = (
    0.043, 0.074, 0.149, 0.252, 0.35, 0.45, 0.554, 0.648, 0.725, 0.775, 0.826, 0.87, 0.909, 0.942, 0.964, 0.98, 0.99
)  # fmt: skip
SHARE = (
    0.037, 0.066, 0.138, 0.242, 0.344, 0.441, 0.542, 0.645, 0.723, 0.774, 0.83, 0.884, 0.929, 0.967, 0.98, 0.995, 1.017
)  # fmt: skip
SHARE_SIGMA = (
    0.018, 0.039, 0.059, 0.07, 0.078, 0.088, 0.094, 0.098, 0.095, 0.096, 0.092, 0.083, 0.078, 0.066, 0.064, 0.06, 0.056
)  # fmt: skip
"""The share depth / T that a completion tells of, and 1.3 times how well: pictures of neighbours err alike."""
HOLE = 0.993
"""From this completion on a picture says "through" and tells no more."""
HOLE_AT_MM, HOLE_SIGMA_MM = 0.013, 0.012
PICTURE_FLOOR = 0.03
PICTURES = 5
"""The newest readings of a point, whose median counts."""
FOLLOWS_OVER_MM, FOLLOWS = 0.05, 0.3
"""A picture that over so much depth changes by less than this share of what it should is stuck, and tells nothing. Of
16,000 healthy ones one in a thousand stays below 0.35."""

CONTACT_SIGMA_MM = 0.012
SLOPE = 0.09
"""Change of thickness per mm along the ring, one sigma."""
JUMP = 0.002
"""Weight of any change at all from one point to the next, against that of none."""
_HEARD_FROM = 12
"""Points away; once anything is cut, what is known farther off tells next to nothing of a thickness here."""
_SCALED_EVERY = 16
"""Points on the way round; a likelihood is never below the product of both floors, so that nothing underflows."""


class Thickness:
    """What is known of T at every point of a closed ring."""

    def __init__(self, n_points: int, limits: Limits, *, pitch_mm: float) -> None:
        """Begin with the thickness prior of ``limits``, two sigmas to either side; ``pitch_mm`` from point to point."""
        low_mm, high_mm = limits.thickness_low_mm, limits.thickness_high_mm
        self._n = n_points
        self._grid = np.arange(LOWEST_MM, high_mm + 0.15, GRID_MM)
        self._prior = np.exp(-0.5 * ((self._grid - (low_mm + high_mm) / 2) / ((high_mm - low_mm) / 4)) ** 2) + 0.01
        self._prior /= self._prior.sum()
        step_mm = hypot(CONTACT_SIGMA_MM, SLOPE * pitch_mm)
        change = np.exp(-0.5 * ((self._grid[:, None] - self._grid) / step_mm) ** 2) + JUMP
        self._change = change / change.sum(axis=1, keepdims=True)
        self._back = np.ascontiguousarray(self._change.T)
        self._misfit = np.zeros((2, n_points, len(self._grid)))
        """Of all passes: sums of measured less expected load, and of its square."""
        self._passes = np.zeros((n_points, 1))
        self._seen: list[deque[tuple[float, float]]] = [deque(maxlen=PICTURES) for _ in range(n_points)]
        self._bone_seen: list[tuple[float, float] | None] = [None] * n_points
        """The newest median reading that was not "through", and its depth."""
        self._medians: list[list[tuple[float, float]]] = [[] for _ in range(n_points)]
        """Median readings that were not "through", and their depths, which grow."""
        self._bone: deque[float] = deque(maxlen=BONE_PASSES)
        self._level, self._has_level = 1.0, False
        """What bone takes now, and whether enough passes have told."""
        self._below: Floats | None = None
        """(n, grid) probability that T is below; None where evidence came since."""

    def weighed(self, index: int, depth_mm: float, ratio: float, *, beside_mm: float) -> None:
        """A pass that ended at ``depth_mm``, its neighbours at ``beside_mm`` in the mean, took that ``ratio``."""
        if depth_mm > SETTLED_MM and self.through(index, depth_mm + CERTAIN_MM) < CERTAIN:
            self._follow_bone(ratio)
        ratio /= self._level
        if ratio > MOST_LOAD:
            return
        misfit = ratio - np.interp(depth_mm / self._grid, LOAD_AT, LOAD)
        if depth_mm > beside_mm + PIT_MM:
            misfit = np.minimum(misfit, 0.0)
        self._misfit[0, index] += misfit
        self._misfit[1, index] += misfit**2
        self._passes[index] += 1
        self._below = None

    def _follow_bone(self, ratio: float) -> None:
        """A pass over bone: the drift of the torque moves the level slowly, what droops faster is a hole."""
        self._bone.append(ratio)
        if len(self._bone) < BONE_PASSES_LEAST:
            return
        said = min(max(median(self._bone), 1 - MOST_DRIFT), 1 + MOST_DRIFT)
        most = DRIFT_A_PASS if self._has_level else MOST_DRIFT
        self._level += min(max(said - self._level, -most), most)
        self._has_level = True

    def pictured(self, index: int, depth_mm: float, completion: float) -> None:
        """A picture of the point, cut to ``depth_mm``, reads as ``completion``."""
        self._seen[index].append((completion, depth_mm))
        median_seen = self._newest(index)
        if median_seen[0] < HOLE:
            self._bone_seen[index] = median_seen
            medians = self._medians[index]
            if not medians or median_seen[1] > medians[-1][1]:
                medians.append(median_seen)
        self._below = None

    def forget_pictures(self, index: int) -> None:
        """What was seen of the point tells nothing."""
        if self._seen[index]:
            self._seen[index].clear()
            self._medians[index].clear()
            self._bone_seen[index] = None
            self._below = None

    def pictures(self, index: int) -> dict[str, Any]:
        """What was seen of the point, for a later run; as JSON."""
        return {
            "seen": list(self._seen[index]),
            "bone_seen": self._bone_seen[index],
            "medians": list(self._medians[index]),
        }

    def recall_pictures(self, index: int, kept: Mapping[str, Any]) -> None:
        """What an earlier run saw of the point."""
        self._seen[index] = deque(((c, depth) for c, depth in kept["seen"]), maxlen=PICTURES)
        self._bone_seen[index] = None if kept["bone_seen"] is None else (kept["bone_seen"][0], kept["bone_seen"][1])
        self._medians[index] = [(c, depth) for c, depth in kept["medians"]]
        self._below = None

    def through(self, index: int, depth_mm: float) -> float:
        """Probability that the ball, at ``depth_mm`` below contact, has come through: P(T < depth)."""
        if self._below is None:
            self._below = np.cumsum(self._posterior(), axis=1)
        # Asked a hundred times for each decision; the grid is even, so that no search is needed.
        place = (depth_mm - GRID_MM / 2 - LOWEST_MM) / GRID_MM
        if place < 0.0:
            return 0.0
        below, before = self._below[index], int(place)
        if before >= len(self._grid) - 1:
            return float(below[-1])
        return float(below[before] + (below[before + 1] - below[before]) * (place - before))

    def _posterior(self) -> Floats:
        return self._round_the_ring(self._loads() * self._pictures())

    def _loads(self) -> Floats:
        """(n, grid) likelihood of all passes, an error that they share being anything (Gaussian, marginalized)."""
        total, squares = self._misfit
        shared = POINT_SIGMA**2 / (LOAD_SIGMA**2 + self._passes * POINT_SIGMA**2)
        log = -0.5 * (squares - shared * total**2) / LOAD_SIGMA**2
        return np.asarray(np.maximum(np.exp(log - log.max(axis=1, keepdims=True)), LOAD_FLOOR))

    def _pictures(self) -> Floats:
        """(n, grid) likelihood of the newest pictures."""
        likelihood = np.ones((self._n, len(self._grid)))
        newest = {index: self._newest(index) for index in range(self._n) if self._seen[index]}
        shown = [index for index, seen in newest.items() if not self._is_stuck(index, *seen)]
        bone = [index for index in shown if newest[index][0] < HOLE]
        holes = [index for index in shown if newest[index][0] >= HOLE]
        if bone:
            likelihood[bone] = np.exp(-0.5 * self._sigmas_deeper([newest[index] for index in bone]) ** 2)
        if holes:
            # A hole may be any depth; what was seen before it says how deep at most.
            past_mm = np.array([newest[index][1] for index in holes])[:, None] - self._grid
            likelihood[holes] = ndtr((past_mm - HOLE_AT_MM) / HOLE_SIGMA_MM)
            before = {
                index: seen
                for index in holes
                if (seen := self._bone_seen[index]) is not None and not self._is_stuck(index, *seen)
            }
            if before:
                likelihood[list(before)] *= ndtr(-self._sigmas_deeper(list(before.values())))
        if shown:
            said = likelihood[shown]
            most = np.maximum(said.max(axis=1, keepdims=True), 1e-12)
            likelihood[shown] = np.maximum(said / most, PICTURE_FLOOR)
        return likelihood

    def _is_stuck(self, index: int, completion: float, depth_mm: float) -> bool:
        """Whether the picture of the point no longer changes as the point gets deeper."""
        medians = self._medians[index]
        earlier = bisect_right(medians, depth_mm - FOLLOWS_OVER_MM, key=lambda seen: seen[1])
        if not earlier or completion >= COMPLETION[-1]:
            return False
        before, before_mm = medians[earlier - 1]
        return _share(completion) < _share(before) * (1.0 + FOLLOWS * (depth_mm / before_mm - 1.0))

    def _sigmas_deeper(self, seen: list[tuple[float, float]]) -> Floats:
        """(m, grid) how much more of T each depth is than its picture tells, in sigmas, from completions and depths."""
        completion, depth_mm = np.array(seen).T[:, :, None]
        share, sigma = (np.interp(completion, COMPLETION, column) for column in (SHARE, SHARE_SIGMA))
        return np.asarray((depth_mm / self._grid - share) / sigma)

    def _newest(self, index: int) -> tuple[float, float]:
        """Median completion of the newest pictures, and its depth."""
        return sorted(self._seen[index])[len(self._seen[index]) // 2]

    def _round_the_ring(self, likelihood: Floats) -> Floats:
        """(n, grid) what each point knows together with its neighbours: sum-product, round in both directions."""
        forward = _messages(likelihood, self._prior, self._change, range(self._n))
        backward = _messages(likelihood, np.ones_like(self._prior), self._back, range(self._n - 1, -1, -1))
        posterior = forward * backward * likelihood
        return np.asarray(posterior / posterior.sum(axis=1, keepdims=True))


def _share(completion: float) -> float:
    """The share of T that a completion tells of; one number, many times quicker than by an array."""
    after = bisect_right(COMPLETION, completion)
    if after in (0, len(COMPLETION)):
        return SHARE[0 if after == 0 else -1]
    low, high = COMPLETION[after - 1], COMPLETION[after]
    return SHARE[after - 1] + (SHARE[after] - SHARE[after - 1]) * (completion - low) / (high - low)


def _messages(likelihood: Floats, start: Floats, change: Floats, order: Sequence[int]) -> Floats:
    """(n, grid) what arrives at each point from those before it in ``order``, but for a factor."""
    arrived = np.empty_like(likelihood)
    message, weighed = start.copy(), np.empty_like(start)
    for number, index in enumerate((*order[-_HEARD_FROM:], *order)):
        arrived[index] = message
        np.multiply(message, likelihood[index], out=weighed)
        np.dot(weighed, change, out=message)
        if number % _SCALED_EVERY == 0:
            message *= 1.0 / message.sum()
    return arrived
