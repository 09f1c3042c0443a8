"""Eyes for thousands of runs: pictures hold numbers in place of light, wrong by what full pixels were measured to be.

Drill, landmarks and surface are where they truly are, plus errors of the sizes that ``mill experiment calibration`` and
``mill experiment surface`` measured; completion is drawn from recorded readings (``studies.perception``). Everything
else of a run is real: drivers, wires, boards, mechanics, calibration, surface fit, loop.

Left out: a picture that misses the drill or a landmark altogether, films and drops, and points near the drill that the
network withholds though the drill's place does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from firmware_sim.bench import Bench
from firmware_sim.optics import draw_eyes
from firmware_sim.skull import smooth_noise
from milling.equipment import Finders
from studies.perception import Donor
from studies.ring_truth import RingTruth
from studies.virtual_runs import SIZE_PX
from vision.disparity import Matches
from vision.keypoints import Keypoint

Floats = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

TIP_SIGMA_PX: Final = (0.25, 0.34)
"""Of x and y of the drill tip: `mill experiment calibration`."""
LANDMARK_SIGMA_PX: Final = (0.85, 0.6)
"""Of a coordinate of bregma and of lambda: `mill experiment surface`."""
SURFACE_BIAS_MM: Final = 0.008
SURFACE_RELIEF_MM: Final = 0.009
"""Of the height at the ring, common to a specimen and changing over 1 mm: together 0.0127 mm RMS, as measured there."""
MATCHED_EVERY_MM: Final = 0.12
MATCHED_ROUND_MM: Final = 5.0
_NUMBERS: Final = 256


@dataclass(frozen=True)
class Reading:
    """Completion, its upper bound and visibility, (n,) each."""

    completion: Floats
    upper: Floats
    visible: npt.NDArray[np.bool_]


class NumberEyes:
    """Takes the place of the microscope and of every network of one bench."""

    def __init__(self, bench: Bench, donors: Sequence[Donor], *, seed: int) -> None:
        """``seed`` draws the donor and every error."""
        self._bench = bench
        self._eyes = draw_eyes(bench.specimen.rig)
        self._rng = np.random.default_rng([seed, 31337])
        self.donor = int(self._rng.integers(len(donors)))
        """Number of the run that lends its readings."""
        self._donor = donors[self.donor]
        self._turned = float(self._rng.random())
        skull = bench.machine.skull
        self._marks = [
            eye.project(np.stack([skull.bregma_mm, skull.lambda_mm]))
            + self._rng.normal(0.0, 1.0, (2, 2)) * np.array(LANDMARK_SIGMA_PX)[:, None]
            for eye in self._eyes
        ]
        self._ring: RingTruth | None = None

    def finders(self) -> Finders:
        """All of it, as a run is given it."""
        return Finders(self.find_tip, self.find_landmarks, self, self.match)

    # What stands where the cameras are.

    def render(self, time_s: float) -> tuple[Image, Image]:
        """Both pictures of this moment."""
        ball = self._bench.machine.ball_center_mm[None]
        excess = np.zeros(0) if self._ring is None else self._ring.excess_mm()
        left, right = (
            _picture(np.concatenate([[side, time_s], eye.project(ball)[0], excess]))
            for side, eye in enumerate(self._eyes)
        )
        return left, right

    # What stands where the networks are.

    def find_tip(self, image: Image) -> Keypoint:
        """The ball's centre, where it is within the picture."""
        x, y = _numbers(image)[2:4] + self._rng.normal(0.0, TIP_SIGMA_PX)
        inside = 0.0 <= x < SIZE_PX[0] and 0.0 <= y < SIZE_PX[1]
        return Keypoint(float(x), float(y), 0.3, 1.0, bool(inside))

    def find_landmarks(self, image: Image) -> tuple[Keypoint, Keypoint]:
        """Bregma and lambda of the eye that took the picture."""
        bregma, lambda_ = (
            Keypoint(float(x), float(y), 1.0, 1.0, True) for x, y in self._marks[int(_numbers(image)[0])]
        )
        return bregma, lambda_

    def match(
        self,
        lefts: Sequence[Image],
        rights: Sequence[Image],
        *,
        right_from_left: Floats,
        region: tuple[float, float, float, float],
    ) -> Matches:
        """Places of the outer surface in the region, as high as they are read."""
        del lefts, rights, right_from_left
        skull, rng = self._bench.machine.skull, self._rng
        x0, y0, _ = self._bench.specimen.skull.center_mm
        side = np.arange(-MATCHED_ROUND_MM, MATCHED_ROUND_MM, MATCHED_EVERY_MM)
        shape = (len(side), len(side))
        error_mm = rng.normal(0.0, SURFACE_BIAS_MM) + SURFACE_RELIEF_MM * smooth_noise(
            rng, shape, MATCHED_EVERY_MM, 1.0
        )
        dx, dy = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
        z = skull.grid.sample(skull.outer_z, x0 + dx, y0 + dy) + error_mm.ravel()
        points = np.column_stack([x0 + dx, y0 + dy, z])[np.isfinite(z)]
        left, right = (eye.project(points) for eye in self._eyes)
        low, high = np.array(region[:2]), np.array(region[2:])
        inside = ((left >= low) & (left <= high)).all(axis=1)
        return Matches(left[inside], right[inside], np.full(int(inside.sum()), 0.1))

    def over(self, ring_px: Floats, ball_px: float, *, reference: Image | None) -> "NumberEyes":
        """Reads this ring from now on."""
        del ball_px, reference
        self._ring = RingTruth(self._bench, ring_px)
        return self

    def read(self, image: Image) -> Reading:
        """As the donor's network read its own ring where it was cut as deep."""
        excess = _numbers(image)[4:]
        n = 0 if self._ring is None else len(self._ring.xy_mm)
        if len(excess) != n:
            # Taken before the ring was chosen: nothing is known of it.
            return Reading(np.zeros(n), np.ones(n), np.zeros(n, dtype=bool))
        at = self._turned + np.arange(n) / n
        completion, upper = self._donor.read(at, excess, self._rng)
        return Reading(completion, upper, np.ones(n, dtype=bool))


def _picture(numbers: Floats) -> Image:
    """Numbers as a picture of the size that the driver expects: their count and their bytes in its first rows."""
    picture = np.zeros((SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    held = np.concatenate([[len(numbers)], numbers])
    picture.reshape(-1)[: 8 * len(held)] = np.frombuffer(held.astype(np.float64).tobytes(), np.uint8)
    return picture


def _numbers(image: Image) -> Floats:
    held = np.frombuffer(image.reshape(-1)[: 8 * (1 + _NUMBERS)].tobytes(), np.float64)
    return held[1 : 1 + int(held[0])]
