"""What every stereo camera promises."""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.device import Device

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class StereoFrame:
    """One pair of pictures: (H, W, 3) uint8 RGB each, the clock's time when exposure began, a running number.

    ``skew_s`` is how much earlier the left one's exposure began than the right one's. ``lag_s`` is how much older than
    the newest picture of the one eye that of the other was when they were paired: an eye that is always late.
    """

    left: Image
    right: Image
    exposed_at_s: float
    index: int
    skew_s: float = 0.0
    lag_s: float = 0.0


class StereoCamera(Device):
    """A left and a right picture of the same moment."""

    @property
    @abstractmethod
    def size_px(self) -> tuple[int, int]:
        """Width and height of each picture."""

    @property
    @abstractmethod
    def identity(self) -> str:
        """Stable names and serial numbers of both cameras, as far as known; goes into the calibration file."""

    @abstractmethod
    def capture(self, timeout_s: float = 2.0) -> StereoFrame:
        """A pair whose exposure began after the call.

        Raises:
            DeviceTimeoutError: no such pair within ``timeout_s``; the message says which side is late.
            DeviceFaultError: a picture of a wrong size, or a pair whose skew exceeds its bound.
            ConnectionLostError: a camera is gone.
        """

    @abstractmethod
    def latest(self) -> StereoFrame | None:
        """The freshest pair at hand, without waiting; None while there is none. The caller judges its age."""
