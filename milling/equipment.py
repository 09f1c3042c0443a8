"""What a run is given: open devices, and what looks at pictures."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from drivers.camera.interface import Image, StereoCamera
from drivers.clock import Clock
from drivers.motion.interface import MotionController, Vector
from drivers.spindle.interface import Spindle
from milling.eyes import CompletionReader


class Keypoint(Protocol):
    """A place in a picture; see ``vision.keypoints``."""

    @property
    def x_px(self) -> float:
        """To the right."""

    @property
    def y_px(self) -> float:
        """Downwards."""

    @property
    def sigma_px(self) -> float:
        """Of each coordinate."""

    @property
    def visible(self) -> bool:
        """Whether the place means anything."""


FindTip = Callable[[Image], Keypoint]
FindLandmarks = Callable[[Image], tuple[Keypoint, Keypoint]]


@dataclass(frozen=True)
class Rig:
    """The devices and what the rig file says about them."""

    motion: MotionController
    spindle: Spindle
    camera: StereoCamera
    clock: Clock
    center_from_tip_mm: Vector
    park_mm: Vector


@dataclass(frozen=True)
class Finders:
    """What looks at pictures: ``TipFinder.find``, ``LandmarkFinder.find``, and a ``CompletionReader``."""

    find_tip: FindTip
    find_landmarks: FindLandmarks
    completion: CompletionReader
