"""Every error that mill raises on purpose.

    MillError
    ├── DeviceError                     a device, its wire or its state
    │   ├── ConnectionLostError         (also ConnectionError) the wire is gone
    │   ├── DeviceTimeoutError          (also TimeoutError) no answer in time
    │   ├── ProtocolError               an answer that no manual allows
    │   ├── DeviceFaultError            the device reports a fault of its own (alarm, EMCY)
    │   ├── DeviceBusyError             another process owns the device
    │   ├── NotHomedError               the position is not trusted
    │   └── OutOfTravelError            (also ValueError) a target outside the travel; nothing moved
    ├── ConfigError                     (also ValueError) a rig, specimen, job or calibration file
    ├── CalibrationError                a calibration that cannot be trusted
    │   └── WrongCalibrationError       (also ConfigError) a calibration file of another rig, or not for this job
    ├── DetectionError                  the picture does not show what was asked for
    ├── PlanError                       a trajectory that must not be milled
    └── SafetyStop                      the machine stopped itself; the message is the reason

Messages name what, where, what was found, what is allowed, and the next step.
"""


class MillError(Exception):
    """The root of the tree."""


class DeviceError(MillError):
    """A device, its wire or its state."""


class ConnectionLostError(DeviceError, ConnectionError):
    """The wire is gone."""


class DeviceTimeoutError(DeviceError, TimeoutError):
    """No answer in time."""


class ProtocolError(DeviceError):
    """An answer that no manual allows."""


class DeviceFaultError(DeviceError):
    """The device reports a fault of its own."""


class DeviceBusyError(DeviceError):
    """Another process owns the device."""


class NotHomedError(DeviceError):
    """The position is not trusted; home first."""


class OutOfTravelError(DeviceError, ValueError):
    """A target outside the travel; nothing moved."""


class ConfigError(MillError, ValueError):
    """A file or option that a person wrote cannot be used."""


class CalibrationError(MillError):
    """A calibration that cannot be trusted."""


class WrongCalibrationError(CalibrationError, ConfigError):
    """A calibration file of another rig, or one that is not for this job."""


class DetectionError(MillError):
    """The picture does not show what was asked for."""


class PlanError(MillError):
    """A trajectory that must not be milled."""


class SafetyStop(MillError):  # noqa: N818  (a stop is the machine doing its duty, not an error of its)
    """The machine stopped itself; the message is the reason."""
