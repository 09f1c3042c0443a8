"""All of it in order: what moves nothing first, then each device alone, then eyes and axes together."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from calib.calibration_file import Calibration
from doctor import camera, computer, motion, spindle, stage
from doctor.check import Check, Patient, whole
from drivers.errors import ConfigError, DeviceError


@dataclass
class Attendance:
    """Which devices answer, and who they say they are; empty where one does not."""

    motion: str = ""
    spindle: str = ""
    camera: str = ""
    settings: Mapping[str, float] = field(default_factory=dict)

    @property
    def devices(self) -> tuple[str, str, str]:
        """Motion, spindle and camera."""
        return (self.motion, self.spindle, self.camera)


def attendance(patient: Patient) -> Attendance:
    """Open each device for a moment, so that the certificate of these devices can be found."""
    found = Attendance()
    with contextlib.suppress(DeviceError, ConfigError), patient.open_motion() as motion:
        found.motion, found.settings = motion.identity, dict(motion.settings)
    with contextlib.suppress(DeviceError, ConfigError), patient.open_spindle() as spindle:
        found.spindle = spindle.identity
    with contextlib.suppress(DeviceError, ConfigError), patient.open_camera() as eyes:
        found.camera = eyes.identity
    return found


def examine(patient: Patient, keep: Callable[[Calibration], None], told: Callable[[Exception], str]) -> Iterator[Check]:
    """Findings as they come; ``keep`` receives what the eyes saw, ``told`` puts a device's error into words."""
    yield from computer.examine(patient)
    well = {"motion": True, "camera": True}
    for name, checks in (
        ("motion", motion.examine(patient)),
        ("spindle", spindle.examine(patient)),
        ("camera", camera.examine(patient)),
    ):
        for check in whole(name, checks, told):
            if name in well and check.name == f"{name}: answers":
                well[name] = False
            yield check
    if patient.moving and all(well.values()):
        yield from whole("stage", stage.examine(patient, keep), told)
