"""What a run is given: open devices, and what looks at pictures."""

from collections.abc import Callable
from dataclasses import dataclass

from calib.procedure import FindTip, Keypoint
from drivers.camera.interface import Image, StereoCamera
from drivers.clock import Clock
from drivers.motion.interface import MotionController, Vector
from drivers.spindle.interface import Spindle
from milling.eyes import CompletionReader

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
