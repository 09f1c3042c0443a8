"""What every motion controller promises. Positions are those of the drill tip in {R}: mm, z up."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from drivers.device import Device

Vector = tuple[float, float, float]


class MotionState(StrEnum):
    """What the controller says it does."""

    IDLE = "idle"
    MOVING = "moving"
    HOMING = "homing"
    HOLDING = "holding"
    """A feed hold that is still slowing down."""
    HELD = "held"
    """A feed hold at standstill."""
    ALARM = "alarm"
    OTHER = "other"
    """Door, sleep, check: no state in which mill moves anything."""


@dataclass(frozen=True)
class MotionStatus:
    """One status report: position in {R}, seconds of motion still queued (as far as the host knows), report time."""

    state: MotionState
    position_mm: Vector
    queued_s: float
    time_s: float
    alarm: str | None = None


@dataclass(frozen=True)
class Travel:
    """The box that targets must stay in, in {R}."""

    low_mm: Vector
    high_mm: Vector

    def contains(self, point_mm: Vector) -> bool:
        """Whether the point is a permitted target; NaN is not."""
        return all(low <= value <= high for low, value, high in zip(self.low_mm, point_mm, self.high_mm, strict=True))


@dataclass(frozen=True)
class StopPath:
    """How another process, which knows no make, stops the motion: an open port, and what to write to it."""

    fd: int
    script: tuple[tuple[bytes, float], ...]
    """Bytes, and seconds to wait after them. It holds first; then it may lift, where the position is still trusted."""


class MotionController(Device):
    """Three axes and a drill. Refuses, never clips; the first fault latches until ``home()``."""

    @property
    @abstractmethod
    def identity(self) -> str:
        """Firmware, version and serial number, as far as known."""

    @property
    def settings(self) -> Mapping[str, float]:
        """The firmware's own settings by name, as read when it was opened; empty where it has none."""
        return {}

    @property
    def buffer_bytes(self) -> int | None:
        """Of the controller's serial port; None where it does not tell."""
        return None

    @property
    @abstractmethod
    def travel(self) -> Travel:
        """The travel in {R}, after soft limits and floor."""

    @property
    @abstractmethod
    def dead_time_s(self) -> float:
        """From writing a segment into an otherwise empty queue to the tip moving."""

    @abstractmethod
    def home(self) -> None:
        """Find the switches; afterwards the position is trusted and a latched fault is released. Blocks."""

    @abstractmethod
    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        """Queue one straight move, and return when the controller has taken it.

        Raises:
            OutOfTravelError: nothing was sent.
            NotHomedError: the position is not trusted.
            DeviceFaultError: the controller refused, or an earlier fault is latched.
        """

    @abstractmethod
    def status(self) -> MotionStatus:
        """A fresh report."""

    @abstractmethod
    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        """Wait for the end of all queued motion.

        Raises:
            DeviceTimeoutError: still moving after ``timeout_s``.
            DeviceFaultError: an alarm, or ``halt()`` from another thread.
        """

    @abstractmethod
    def hold(self) -> None:
        """Slow down to standstill on the path and keep the queue. From any thread; never waits behind anything."""

    @abstractmethod
    def resume(self) -> None:
        """Go on after ``hold()``."""

    @abstractmethod
    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        """Hold, wait for standstill, then drop the queue; the position stays trusted. Idle afterwards.

        Raises:
            DeviceTimeoutError: no standstill in time; nothing was dropped and the hold stands.
        """

    @abstractmethod
    def halt(self) -> None:
        """Stop now, drop the queue, latch. From any thread; never waits behind anything.

        The position is lost when the axes were moving: ``home()`` releases.
        """

    @property
    def stop_path(self) -> StopPath | None:
        """For a supervisor; None where no other process can reach the wire."""
        return None

    @abstractmethod
    def set_floor(self, z_mm: float | None) -> None:
        """Let the controller itself refuse targets below ``z_mm`` in {R}, read back; None restores the travel."""
