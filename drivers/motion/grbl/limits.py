"""The controller's own settings: read and checked once, and one of them, the travel of Z, written for the floor."""

import math
from collections.abc import Callable, Mapping
from typing import TypeVar

from drivers.errors import ConfigError, DeviceFaultError, OutOfTravelError, ProtocolError
from drivers.motion.grbl import machine, protocol
from drivers.motion.grbl.codes import HOMING_REQUIRED
from drivers.motion.grbl.session import GrblSession
from drivers.motion.interface import Travel, Vector

_STEP_MM = machine.RESOLUTION_MM

_Answer = TypeVar("_Answer")


class SoftLimits:
    """Where a controller lets its axes go, in {R}, and by which settings."""

    def __init__(
        self, session: GrblSession, origin_mm: Vector, expected: Mapping[str, float], firmware: str = ""
    ) -> None:
        """Read who the controller is and how it is set; refuse one that is set wrongly.

        Written are ``$10`` where 1.1h does not report what mill needs, and the travel of Z where a host that was killed
        left its floor.

        Raises:
            ProtocolError: it does not speak GRBL 1.1, or what it says of itself changes from one answer to the next.
            ConfigError: the version does not begin with ``firmware``, or a setting is not as ``expected`` or as mill
                needs it.
        """
        self._session = session
        self._origin_mm = origin_mm
        self.info = self._read_twice("build info ($I)", self._read_info)
        if not self.info.version.startswith(firmware):
            raise ConfigError(
                f"{session.name}: firmware version {self.info.version} found, the rig file expects {firmware}; is this "
                "the right controller? If so, correct [motion] firmware, calibrate and run `mill doctor` again"
            )
        self.settings = self._read_twice("settings ($$)", self._read)
        self._check_expected(expected)
        if (mask := machine.report_mask_to_write(self.settings, self.info)) is not None:
            self._write(machine.REPORT_MASK, mask)
        machine.check_required(session.name, self.settings, self.info)
        self._full_travel_mm = self.settings[machine.FLOOR_SETTING]

    @property
    def full_settings(self) -> machine.Settings:
        """All settings, as without a floor."""
        return {**self.settings, machine.FLOOR_SETTING: self._full_travel_mm}

    @property
    def travel(self) -> Travel:
        """The travel in {R} that the settings leave."""
        x, y, z = (machine.span_of(axis, self.settings, self.info) for axis in range(3))
        return Travel(
            self.robot_mm((x.low_mm, y.low_mm, z.low_mm)),
            self.robot_mm((x.high_mm, y.high_mm, z.high_mm)),
        )

    @property
    def forgets_homing(self) -> bool:
        """Whether the controller forgets that Z was homed when the floor is written; it may lock itself then."""
        return self.info.is_hal

    def machine_mm(self, robot_mm: Vector) -> Vector:
        """A point of {R} in machine coordinates, as exact as a line of G-code says it."""
        x, y, z = (round(value + origin, 3) for value, origin in zip(robot_mm, self._origin_mm, strict=True))
        return (x, y, z)

    def robot_mm(self, machine_mm: Vector) -> Vector:
        """A point in machine coordinates in {R}."""
        x, y, z = (round(value - origin, 6) for value, origin in zip(machine_mm, self._origin_mm, strict=True))
        return (x, y, z)

    def check_target(self, target_mm: Vector) -> None:
        """Refuse a target of {R} outside the travel.

        Raises:
            OutOfTravelError: it is outside; nothing was sent.
        """
        travel = self.travel
        if not travel.contains(target_mm):
            raise OutOfTravelError(
                f"{self._session.name}: target {machine.shown(target_mm)} mm is outside the travel "
                f"{machine.shown(travel.low_mm)} to {machine.shown(travel.high_mm)} mm of {{R}}; nothing was sent"
            )

    def check_floor(self, z_mm: float, tip_mm: float | None) -> None:
        """Refuse a floor that cannot be, before anything is written; ``tip_mm`` is None where nobody knows it.

        Raises:
            OutOfTravelError: the floor is outside the travel or above the tip.
            ConfigError: Z homes at its low end.
        """
        name = self._session.name
        span = machine.span_of(2, self.full_settings, self.info)
        if span.homes_low:
            raise ConfigError(
                f"{name}: setting ${machine.HOMING_DIRECTION} lets Z home at its low end, where its travel setting "
                "moves the coordinates and not the floor; let Z home at the top"
            )
        low_mm, high_mm = span.low_mm - self._origin_mm[2], span.high_mm - self._origin_mm[2]
        if not low_mm <= z_mm < high_mm:
            raise OutOfTravelError(
                f"{name}: floor z = {z_mm:g} mm is outside the travel {low_mm:g} to {high_mm:g} mm; nothing was "
                f"written. A run that was killed leaves its floor in the controller: with the full "
                f"${machine.FLOOR_SETTING} under [motion.settings] of the rig file it is restored at the next start"
            )
        if tip_mm is not None and tip_mm < z_mm:
            raise OutOfTravelError(
                f"{name}: floor z = {z_mm:g} mm is above the tip at {tip_mm:g} mm; lift first; nothing was written"
            )

    def write_floor(self, z_mm: float | None) -> None:
        """Write the travel of Z that ends at ``z_mm``, None for all of it, and read it back."""
        if z_mm is None:
            self._write_z_travel(self._full_travel_mm)
            return
        # Rounded up: the firmware keeps three decimals, and a floor is never lower than asked.
        low_mm = math.ceil((z_mm + self._origin_mm[2]) / _STEP_MM - 1e-6) * _STEP_MM
        span = machine.span_of(2, self.settings, self.info)
        self._write_z_travel(round(span.travel_for(low_mm), 3))

    def _check_expected(self, expected: Mapping[str, float]) -> None:
        # The floor of a host that was killed is no reason to refuse; any other difference is, and nothing is written.
        left_mm = machine.travel_to_restore(self.settings, expected)
        restored = self.settings if left_mm is None else {**self.settings, machine.FLOOR_SETTING: left_mm}
        machine.check_expected(self._session.name, restored, expected)
        if left_mm is not None:
            self._write_z_travel(left_mm)

    def _write_z_travel(self, travel_mm: float) -> None:
        if self.forgets_homing:
            # It locks itself if it is set to insist on homing ($22).
            self._session.tolerated_alarm = HOMING_REQUIRED
        self._write(machine.FLOOR_SETTING, travel_mm)

    def _read_twice(self, what: str, read: Callable[[], _Answer]) -> _Answer:
        # The wire has no checksum, and this is believed until the end.
        first, second = read(), read()
        if first != second:
            raise ProtocolError(
                f"{self._session.name}: {what} differ from one answer to the next; look at the cable, the baud rate "
                "and its shielding, then open the controller again"
            )
        return first

    def _read_info(self) -> protocol.BuildInfo:
        replies = self._session.command("$I", 2.0)
        return protocol.build_info([reply for reply in replies if isinstance(reply, protocol.Feedback)])

    def _read(self) -> dict[int, float]:
        replies = self._session.command("$$", 3.0)
        settings = [reply for reply in replies if isinstance(reply, protocol.Setting)]
        return {setting.number: setting.value for setting in settings if setting.value is not None}

    def _write(self, number: int, value: float) -> None:
        self._session.command(f"${number}={value:.3f}".rstrip("0").rstrip("."), 2.0)
        settings = self._read()
        known = {*settings, *self.settings} - {number}
        others = {other for other in known if settings.get(other) != self.settings.get(other)}
        if others:
            raise ProtocolError(
                f"{self._session.name}: setting ${number} was written, and ${min(others)} reads otherwise as well; "
                "look at the cable, the baud rate and its shielding, then open the controller again"
            )
        self.settings = settings
        found = self.settings.get(number)
        if found is None or abs(found - value) > _STEP_MM / 2:
            raise DeviceFaultError(
                f"{self._session.name}: setting ${number} was written as {value:g} and reads back as {found}; "
                "is its memory worn out or write-protected?"
            )
