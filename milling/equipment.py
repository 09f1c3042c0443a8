"""What a run is given: open devices, and what looks at pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from calib.procedure import FindTip, Keypoint
from drivers.camera.interface import Image, StereoCamera
from drivers.clock import Clock
from drivers.motion.interface import MotionController, Vector
from drivers.spindle.interface import Spindle
from milling.eyes import CompletionReader

Floats = npt.NDArray[np.float64]

FindLandmarks = Callable[[Image], tuple[Keypoint, Keypoint]]


class Matches(Protocol):
    """Places that show the same points, (n, 2) pixels each; see ``vision.disparity``."""

    @property
    def left_px(self) -> Floats:
        """In the left picture."""

    @property
    def right_px(self) -> Floats:
        """In the right picture."""


class Match(Protocol):
    """Finds them in a region of several pairs of pictures of one scene; see ``vision.disparity.match``."""

    def __call__(
        self,
        lefts: Sequence[Image],
        rights: Sequence[Image],
        *,
        right_from_left: Floats,
        region: tuple[float, float, float, float],
    ) -> Matches:
        """``right_from_left`` (2, 3) takes left pixels to right ones near the surface; ``region`` is in left pixels."""


class Guard(Protocol):
    """Who stops the motion when this process falls silent; see ``milling.guard``."""

    def arm(self) -> None:
        """From now on silence stops the motion."""

    def disarm(self) -> None:
        """From now on silence is allowed."""

    def beat(self) -> None:
        """A sign of life."""

    def stopped(self) -> str | None:
        """Why it has stopped the motion, once it is done; None while it watches."""


@dataclass(frozen=True)
class Rig:
    """The devices and what the rig file says about them."""

    motion: MotionController
    spindle: Spindle
    camera: StereoCamera
    clock: Clock
    center_from_tip_mm: Vector
    park_mm: Vector
    guard: Guard | None = None
    """None where no other process can reach the motion's wire, as on the virtual clock."""


@dataclass(frozen=True)
class Finders:
    """What looks at pictures: ``TipFinder.find``, ``LandmarkFinder.find``, a ``CompletionReader``, and ``match``."""

    find_tip: FindTip
    find_landmarks: FindLandmarks
    completion: CompletionReader
    match: Match
