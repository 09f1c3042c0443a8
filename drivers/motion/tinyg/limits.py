"""The board's own settings: read and checked once, and one of them, the low end of Z, written for the floor."""

import math
from collections.abc import Mapping
from typing import Any

from drivers.errors import ConfigError, DeviceFaultError, OutOfTravelError, ProtocolError
from drivers.motion.interface import Travel, Vector
from drivers.motion.tinyg import machine, protocol
from drivers.motion.tinyg.session import TinyGSession

_STEP_MM = machine.RESOLUTION_MM
_COMMUNICATION = (("ej", 1), ("jv", 5), ("qv", 0), ("sv", 0))
"""JSON; replies with the whole G-code line; no queue or status report that nobody asked for."""


class SoftLimits:
    """Where a board lets its axes go, in {R}, and by which settings."""

    def __init__(
        self, session: TinyGSession, origin_mm: Vector, expected: Mapping[str, float], firmware: str = ""
    ) -> None:
        """Read who the board is and how it is set; refuse one that is set wrongly.

        Written are the settings of communication, and the low end of Z where a host that was killed left its floor.

        Raises:
            ProtocolError: it does not say who it is.
            ConfigError: the build does not begin with ``firmware``, it checks no checksum, or a setting is not as
                ``expected`` or as mill needs it.
        """
        self._session = session
        self._origin_mm = origin_mm
        self.configure()
        self.settings, self.identity, build = self._read()
        if not build.startswith(firmware):
            raise ConfigError(
                f"{session.name}: firmware build {build} found, the rig file expects {firmware}; is this the right "
                "controller? If so, correct [motion] firmware, calibrate and run `mill doctor` again"
            )
        self._check_expected(expected)
        machine.check_required(session.name, self.settings)
        self._full_low_mm = self.settings[machine.FLOOR_SETTING]

    @property
    def full_settings(self) -> machine.Settings:
        """All settings, as without a floor."""
        return {**self.settings, machine.FLOOR_SETTING: self._full_low_mm}

    @property
    def travel(self) -> Travel:
        """The travel in {R} that the settings leave."""
        return Travel(self.robot_mm(self._ends("tn")), self.robot_mm(self._ends("tm")))

    def configure(self) -> None:
        """Write how the board is to speak, which a reset makes it forget, and see that it checks checksums.

        Raises:
            ConfigError: it takes a line whose checksum is wrong.
        """
        session = self._session
        for name, value in _COMMUNICATION:
            session.command(protocol.assignment(name, value), name)
        session.command(protocol.assignment("sr", dict.fromkeys(protocol.REPORT, True)), "sr")
        try:
            session.command("N1G21*0", "gc")
        except DeviceFaultError:
            session.check()
            session.upset = None
        else:
            raise ConfigError(
                f"{session.name}: the board takes a line with a wrong checksum, as TinyG and early builds of g2core "
                "do; mill needs one that refuses it: write a newer g2core into the board"
            )
        session.gcode("G21")

    def read_again(self) -> None:
        """The settings, as a reset may have changed them; the identity stays."""
        self.settings = self._read()[0]
        machine.check_required(self._session.name, self.settings)

    def machine_mm(self, robot_mm: Vector) -> Vector:
        """A point of {R} in machine coordinates, as exact as a line of G-code says it."""
        x, y, z = (round(value + origin, 3) for value, origin in zip(robot_mm, self._origin_mm, strict=True))
        return (x, y, z)

    def robot_mm(self, machine_mm: Vector) -> Vector:
        """A point in machine coordinates in {R}."""
        x, y, z = (round(value - origin, 6) for value, origin in zip(machine_mm, self._origin_mm, strict=True))
        return (x, y, z)

    def check_floor(self, z_mm: float, tip_mm: float | None) -> None:
        """Refuse a floor that cannot be, before anything is written; ``tip_mm`` is None where nobody knows it.

        Raises:
            OutOfTravelError: the floor is outside the travel or above the tip.
            ConfigError: Z homes at its low end.
        """
        name = self._session.name
        if machine.homes_low(self.settings, "z"):
            raise ConfigError(
                f"{name}: setting {machine.titled('zhd')} lets Z home at its low end, where its travel moves the "
                "coordinates and not the floor; let Z home at the top"
            )
        low_mm = self._full_low_mm - self._origin_mm[2]
        high_mm = self.settings["ztm"] - self._origin_mm[2]
        if not low_mm <= z_mm < high_mm:
            raise OutOfTravelError(
                f"{name}: floor z = {z_mm:g} mm is outside the travel {low_mm:g} to {high_mm:g} mm; nothing was "
                f"written. A run that was killed leaves its floor in the board: with the full {machine.FLOOR_SETTING} "
                "under [motion.settings] of the rig file it is restored at the next start"
            )
        if tip_mm is not None and tip_mm < z_mm:
            raise OutOfTravelError(
                f"{name}: floor z = {z_mm:g} mm is above the tip at {tip_mm:g} mm; lift first; nothing was written"
            )

    def write_floor(self, z_mm: float | None) -> None:
        """Write the low end of Z in {R}, None for the whole travel, and read it back."""
        if z_mm is None:
            self._write_low(self._full_low_mm)
            return
        # Rounded up: a floor is never lower than asked.
        self._write_low(round(math.ceil((z_mm + self._origin_mm[2]) / _STEP_MM - 1e-6) * _STEP_MM, 3))

    def _check_expected(self, expected: Mapping[str, float]) -> None:
        # The floor of a host that was killed is no reason to refuse; any other difference is, and nothing is written.
        low_mm = machine.floor_to_remove(self.settings, expected)
        restored = self.settings if low_mm is None else {**self.settings, machine.FLOOR_SETTING: low_mm}
        machine.check_expected(self._session.name, restored, expected)
        if low_mm is not None:
            self._write_low(low_mm)

    def _read(self) -> tuple[dict[str, float], str, str]:
        """Settings, identity, build."""
        settings: dict[str, float] = {}
        said: dict[str, Any] = {}
        for group in machine.GROUPS:
            found = self._session.command(protocol.query(group), group)[group]
            if not isinstance(found, dict):
                raise ProtocolError(f"{self._session.name}: settings {group!r} read as {found!r}; a group is due")
            said |= {(name if group == "sys" else group + name): value for name, value in found.items()}
        for name, value in said.items():
            if type(value) in (int, float, bool):
                settings[name] = float(value)
        if not all(name in settings for name in ("fb", "fv")) or "id" not in said:
            raise ProtocolError(f"{self._session.name}: the board does not say its fb, fv and id; is it a g2core?")
        build = f"{settings.pop('fb'):.2f}"
        identity = f"g2core {build} (version {settings.pop('fv'):g}) {said['id']}"
        settings.pop("id", None)
        return settings, identity, build

    def _ends(self, name: str) -> Vector:
        x, y, z = (self.settings[f"{axis}{name}"] for axis in machine.AXES)
        return (x, y, z)

    def _write_low(self, low_mm: float) -> None:
        name = machine.FLOOR_SETTING
        self._session.command(protocol.assignment(name, low_mm), name)
        found = self._session.command(protocol.query(name), name)[name]
        if type(found) not in (int, float) or abs(found - low_mm) > _STEP_MM / 2:
            raise DeviceFaultError(
                f"{self._session.name}: setting {machine.titled(name)} was written as {low_mm:g} and reads back as "
                f"{found!r}; write it again, then look at the board's memory"
            )
        self.settings = {**self.settings, name: float(found)}
