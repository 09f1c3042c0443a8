"""What every spindle promises."""

from abc import abstractmethod
from dataclasses import dataclass

from drivers.device import Device

SILENT_AFTER = 0.8
"""A drive that says nothing for this share of the heartbeat's time while it is asked is silent: the host gives up
before the drive does."""


@dataclass(frozen=True)
class SpindleStatus:
    """Actual speed, torque as a fraction of rated torque, the drive's fault in words or None, time of the report."""

    speed_rpm: float
    torque_fraction: float
    fault: str | None
    time_s: float


class Spindle(Device):
    """A drill that turns. While it turns, call ``status()`` at least every ``heartbeat_s``: the drive stops without.

    The host's sign of life is given by the calls of the control loop and by nothing else, so that a frozen loop
    stops the drill.
    """

    @property
    @abstractmethod
    def identity(self) -> str:
        """Maker, type, version and serial number, as far as known."""

    @property
    @abstractmethod
    def heartbeat_s(self) -> float:
        """The longest silence of the host that leaves the drill turning."""

    @property
    def answers(self) -> tuple[int, int] | None:
        """How often the drive was asked since opening, and how often it answered; None where the wire tells neither."""
        return None

    def past_faults(self) -> list[str]:
        """The drive's own history of errors in words, newest first; empty where it keeps none."""
        return []

    @abstractmethod
    def start(self, speed_rpm: float) -> None:
        """Set the speed and let the drill run up; refuses a speed outside the drive's limits (ConfigError)."""

    @abstractmethod
    def stop(self) -> None:
        """Stop: in any state, from any thread, any number of times. Returns when the command is on the wire."""

    @abstractmethod
    def status(self) -> SpindleStatus:
        """The newest report of the drive, and a sign of life to it. Waits ``SILENT_AFTER`` heartbeats at most.

        Raises:
            DeviceTimeoutError: the drive has been silent for too long.
            ConnectionLostError: the wire is gone.
        """

    @abstractmethod
    def wait_until_at_speed(self, timeout_s: float) -> SpindleStatus:
        """Wait until the commanded speed is reached (standstill after ``stop()``).

        Raises:
            DeviceTimeoutError: not at speed in time.
            DeviceFaultError: the drive reports a fault.
        """

    @abstractmethod
    def reset_fault(self) -> None:
        """Acknowledge a fault; the drill stays off until ``start()``. An operator's act.

        Raises:
            DeviceFaultError: the cause is still there.
        """
