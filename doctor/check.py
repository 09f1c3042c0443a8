"""One finding, and what is examined."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from drivers.camera.interface import StereoCamera
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceError
from drivers.motion.interface import MotionController, Vector
from drivers.recorder import NullRecorder, Recorder
from drivers.spindle.interface import Spindle

if TYPE_CHECKING:
    from calib.procedure import FindTip
    from doctor.certificate import Certificate


@dataclass(frozen=True)
class Check:
    """One finding: what was measured, in which unit, against which limit, and what to do where it failed."""

    name: str
    value: float | str
    unit: str
    limit: str
    passed: bool
    advice: str = ""

    @property
    def shown(self) -> str:
        """The value for people, with its unit."""
        if not isinstance(self.value, float):
            return f"{self.value} {self.unit}".strip()
        number = f"{self.value:.0f}" if abs(self.value) >= 1000 else f"{self.value:.4g}"
        return f"{number} {self.unit}".strip()

    def to_json(self) -> dict[str, float | str]:
        """As the results file has it."""
        verdict = "pass" if self.passed else "fail"
        told = {"name": self.name, "value": self.value, "unit": self.unit, "limit": self.limit, "verdict": verdict}
        return told | ({} if self.passed or not self.advice else {"advice": self.advice})


@dataclass(frozen=True)
class Limits:
    """What a rig must keep to be safe to run; ``[certificate]`` of the rig file.

    Attributes:
        hold_ms: from the request to hold until the axes stand.
        round_trip_ms: of a motion report, 99 of 100.
        frame_age_ms: of a pair of pictures at delivery, the median.
        spindle_stop_s: from the request to standstill.
        backlash_mm: of X and Y.
        scale: of X and Y against the certificate before: a share.
        free_disk_mb: where records go.
    """

    hold_ms: float = 250.0
    round_trip_ms: float = 50.0
    frame_age_ms: float = 100.0
    spindle_stop_s: float = 3.0
    backlash_mm: float = 0.025
    scale: float = 0.005
    free_disk_mb: float = 1000.0


@dataclass(frozen=True)
class Patient:
    """A rig to be examined: how to open its devices, and what its file says of them."""

    clock: Clock
    open_motion: Callable[[], AbstractContextManager[MotionController]]
    open_spindle: Callable[[], Spindle]
    open_camera: Callable[[], StereoCamera]
    find_tip: "FindTip"
    park_mm: Vector
    center_from_tip_mm: Vector
    speed_rpm: float
    limits: Limits = field(default_factory=Limits)
    motion_port: str = ""
    spindle_port: str = ""
    earlier: "Certificate | None" = None
    """Of the same devices, when they were well."""
    moving: bool = True
    free_disk_mb: Callable[[], float] = lambda: float("inf")
    """Room where records go."""
    doing: Callable[[str], None] = lambda _words: None
    """Told what is under way where that takes a while."""
    recorder: Recorder = field(default_factory=NullRecorder)
    """Takes a picture of each eye now and then, and what the eyes saw at each setpoint."""


def at_most(name: str, value: float, limit: float, unit: str, advice: str = "") -> Check:
    """Passed where the value is no greater."""
    return Check(name, value, unit, f"at most {limit:g}", value <= limit, advice)


def at_least(name: str, value: float, limit: float, unit: str, advice: str = "") -> Check:
    """Passed where the value is no smaller."""
    return Check(name, value, unit, f"at least {limit:g}", value >= limit, advice)


def within(name: str, value: float, low: float, high: float, unit: str, advice: str = "") -> Check:
    """Passed where the value is between both."""
    return Check(name, value, unit, f"{low:g} to {high:g}", low <= value <= high, advice)


def percentile(values: list[float], share: float) -> float:
    """The value below which so much of them lies."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def whole(name: str, checks: Iterator[Check], told: Callable[[Exception], str]) -> Iterator[Check]:
    """The checks of one device; one that fails in the middle is a finding, and the next device's turn.

    So is a device that is not set as the rig file says, or not as mill needs it: the file itself was found good before.
    """
    try:
        yield from checks
    except (DeviceError, ConfigError) as error:
        yield Check(f"{name}: answers", told(error), "", "no error", False)
