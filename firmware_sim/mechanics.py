"""What emulated boards and drives turn: the only way in which they touch the world."""

from typing import Protocol

AxesMm = tuple[float, float, float]


class Mechanics(Protocol):
    """Three motors with home switches, and a probe input."""

    def move_to(self, time_s: float, axes_mm: AxesMm) -> None:
        """The motors stand at ``axes_mm``, relative to where they stood at power-up, from ``time_s`` on."""

    def limit_switches(self) -> tuple[bool, bool, bool]:
        """Whether each axis' switch is pressed, at the last position."""

    def probe_closed(self) -> bool:
        """Whether the probe touches, at the last position."""


class SpindleLoad(Protocol):
    """The spindle's shaft and what it cuts."""

    def turn(self, time_s: float, speed_rpm: float) -> None:
        """The shaft turns at ``speed_rpm`` from ``time_s`` on."""

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        """Share of the rated torque that the load takes; a drive stalls above 1."""
