"""What every spindle promises."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from drivers.device import Device
from drivers.errors import DeviceFaultError

SILENT_AFTER = 0.8
"""A drive that says nothing for this share of the heartbeat's time while it is asked is silent: the host gives up
before the drive does."""


@dataclass(frozen=True)
class AlarmPath:
    """How another process, which knows no make, hears a drive cry out: a wire to read along, and what a cry looks like.

    That process reads ``fd`` and hands every byte on to the file that the driver was told to ``read_through``; when
    that file ends, the driver reads its wire itself again.
    """

    fd: int
    pattern: bytes
    """A regular expression over bytes, of at most 64 of them, that ends with the cry's last byte."""
    words: Callable[[bytes], str]
    """What was found, as a person reads it."""
    read_through: Callable[[int], None]
    """Takes over a file descriptor."""


@dataclass(frozen=True)
class SpindleStatus:
    """Actual speed, torque as a fraction of rated torque, the drive's fault in words or None, time of the report.

    See ``Spindle.feels_load`` for drills that tell neither speed nor torque.
    """

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
        """The longest silence of the host that leaves the drill turning; infinite where nothing there watches it.

        Danger: such a drill turns on when the host is gone.
        """

    @property
    def feels_load(self) -> bool:
        """Whether speed and torque are the drill's own.

        Where not, the speed is what the drill was told, the torque is NaN, and a blocked drill is not noticed.
        """
        return True

    @property
    def answers(self) -> tuple[int, int] | None:
        """How often the drive was asked since opening, and how often it answered; None where the wire tells neither."""
        return None

    @property
    def alarm_path(self) -> AlarmPath | None:
        """For a supervisor; None where the drive says nothing unasked, or no other process can read its wire."""
        return None

    @property
    def errors_on_wire(self) -> int | None:
        """Frames refused, broken or told as errors since opening; None where nothing counts them."""
        return None

    def heartbeats_s(self, duration_s: float) -> list[float]:
        """Listen for so long at most: when each sign of life of the drive's own came; empty where it gives none."""
        return []

    def speed_unheard_rpm(self) -> float | None:
        """The speed, asked for without a sign of life; None where every question is one.

        For whoever measures how soon the drive stops by itself when its host falls silent, and for nobody else.
        """
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

        Where nothing watches the host it waits for three replies, half a second at most.

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

    def reset_fault(self) -> None:
        """Acknowledge a fault; the drill stays off until ``start()``. An operator's act.

        Raises:
            DeviceFaultError: the cause is still there, or this drive takes no such command.
        """
        raise DeviceFaultError(f"{self.identity}: its faults are reset at the drive itself; do so, and open it again")
