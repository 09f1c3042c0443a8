"""What a GRBL controller's own settings say about the machine: its travel, its limits, and what mill insists on."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import ConfigError
from drivers.motion.grbl.protocol import BuildInfo
from drivers.motion.interface import Vector

AXES = "XYZ"
RESOLUTION_MM = 0.001
"""What the firmware's three decimals keep."""
REPORT_MASK, REPORT_INCHES, SOFT_LIMITS, HARD_LIMITS, HOMING, HOMING_DIRECTION = 10, 13, 20, 21, 22, 23
LOCATE_RATE, SEEK_RATE, PULL_OFF = 24, 25, 27
STEPS_PER_MM, MAX_RATE, ACCELERATION, MAX_TRAVEL = 100, 110, 120, 130
"""The first of three, one for each axis."""
FLOOR_SETTING = MAX_TRAVEL + 2

_MPOS_AND_BF = 0b11
_HAL_ORIGIN_AT_HOME = 8
_GNEA_ORIGIN_AT_HOME = "Z"

Settings = Mapping[int, float]


@dataclass(frozen=True)
class Span:
    """Where one axis may go, in machine coordinates."""

    low_mm: float
    high_mm: float
    low_margin_mm: float
    """What the firmware takes off the low end of the travel."""
    homes_low: bool

    def travel_for(self, low_mm: float) -> float:
        """The travel setting that puts the low end of an axis that homes high at ``low_mm``."""
        return self.low_margin_mm - low_mm


_NAMES = {
    1: "release of the motors", 3: "direction of the axes", 10: "status reports", 11: "junction deviation",
    13: "reports in inches", 20: "soft limits", 21: "hard limits", 22: "homing", 23: "direction of homing",
    24: "homing feed", 25: "homing seek", 27: "pull-off after homing", 32: "laser mode",
}  # fmt: skip
_OF_AXES = {10: "steps per mm", 11: "greatest rate", 12: "acceleration", 13: "travel"}


def number_of(name: str) -> int:
    """``"$130"`` or ``"130"`` as a setting's number.

    Raises:
        ConfigError: it is neither.
    """
    digits = name.removeprefix("$")
    if not digits.isdecimal():
        raise ConfigError(f"[motion.settings] key {name!r}: GRBL settings are called '$' and a number, such as '$130'")
    return int(digits)


def check_expected(line: str, settings: Settings, expected: Mapping[str, float]) -> None:
    """Compare what the controller has with what the rig file expects.

    Raises:
        ConfigError: names the key, what was found and what was expected.
    """
    for name, value in expected.items():
        number = number_of(name)
        found = settings.get(number)
        if found is None:
            raise ConfigError(f"{line}: the controller has no setting {titled(number)}; the rig file expects {value:g}")
        # The firmware keeps single precision and prints three decimals.
        if not math.isclose(found, value, rel_tol=1e-6, abs_tol=5.1e-4):
            raise ConfigError(
                f"{line}: setting {titled(number)} is {found:g}, the rig file expects {value:g}; is this the right "
                f"controller? If so, correct [motion.settings] or write ${number}={value:g} into the controller"
            )


def titled(number: int) -> str:
    """A setting with its meaning, "$20 (soft limits)"."""
    name = _NAMES.get(number) or (
        f"{_OF_AXES[number // 10]} of {AXES[number % 10]}"
        if number % 10 < len(AXES) and number // 10 in _OF_AXES
        else ""
    )
    return f"${number} ({name})" if name else f"${number}"


def travel_to_restore(settings: Settings, expected: Mapping[str, float]) -> float | None:
    """The travel of Z that the rig file expects where the controller has a smaller one, else None.

    A host that is killed leaves its floor in the controller, as a smaller travel.
    """
    wanted = next((value for name, value in expected.items() if number_of(name) == FLOOR_SETTING), None)
    found = settings.get(FLOOR_SETTING)
    return wanted if wanted is not None and found is not None and 0 < found < wanted - RESOLUTION_MM / 2 else None


def check_required(line: str, settings: Settings, info: BuildInfo) -> None:
    """Refuse a controller that would not refuse for itself, or that counts in inches.

    Raises:
        ConfigError: names the setting, what was found and what to write.
    """

    def require(number: int, *, bit: int, wanted: int, why: str) -> None:
        found = settings.get(number)
        if found is None or int(found) & bit != wanted:
            shown = "missing" if found is None else f"{found:g}"
            raise ConfigError(
                f"{line}: setting ${number} is {shown}, and mill needs {why}; write ${number}="
                f"{(0 if found is None else int(found)) & ~bit | wanted} into the controller"
            )

    require(HOMING, bit=1, wanted=1, why="homing on")
    require(SOFT_LIMITS, bit=1, wanted=1, why="soft limits on")
    require(REPORT_INCHES, bit=1, wanted=0, why="reports in millimetres")
    if info.is_hal:
        require(REPORT_MASK, bit=_MPOS_AND_BF, wanted=_MPOS_AND_BF, why="machine position and buffer in reports")
    for axis, letter in enumerate(AXES):
        for first in (MAX_RATE, MAX_TRAVEL):
            if settings.get(first + axis, 0.0) <= 0:
                raise ConfigError(f"{line}: setting ${first + axis} ({letter}) is missing or zero; it must be positive")


def report_mask_to_write(settings: Settings, info: BuildInfo) -> int | None:
    """The ``$10`` that makes 1.1h report MPos and Bf, None where it does already.

    Never one for grblHAL, where a small mask takes other fields away.
    """
    mask = int(settings.get(REPORT_MASK, 0))
    return None if info.is_hal or mask & _MPOS_AND_BF == _MPOS_AND_BF else mask | _MPOS_AND_BF


def span_of(axis: int, settings: Settings, info: BuildInfo) -> Span:
    """Where one axis may go after homing: inside the soft limits, and with hard limits on not onto its switch.

    Coordinates end at zero at the high end, wherever the switch is ($23), unless the firmware was told to put its
    origin where it homes and it homes low: then they begin at zero. With hard limits on, grblHAL itself keeps the
    pull-off distance from the ends; 1.1h does not, and would run onto the switch.
    """
    travel_mm = settings[MAX_TRAVEL + axis]
    homes_low = bool(int(settings.get(HOMING_DIRECTION, 0)) >> axis & 1)
    margin_mm = settings.get(PULL_OFF, 0.0) if int(settings.get(HARD_LIMITS, 0)) & 1 else 0.0
    if info.is_hal:
        if not int(settings[HOMING]) & _HAL_ORIGIN_AT_HOME:
            return Span(margin_mm - travel_mm, -margin_mm, margin_mm, homes_low)
        if homes_low:
            return Span(0.0, travel_mm - margin_mm, 0.0, homes_low)
        return Span(margin_mm - travel_mm, 0.0, margin_mm, homes_low)
    if _GNEA_ORIGIN_AT_HOME in info.options:
        # Zero is where the axis stands after the pull-off.
        return Span(0.0, travel_mm, 0.0, homes_low) if homes_low else Span(-travel_mm, 0.0, 0.0, homes_low)
    if homes_low:
        return Span(margin_mm - travel_mm, 0.0, 0.0, homes_low)
    return Span(-travel_mm, -margin_mm, 0.0, homes_low)


def homing_timeout_s(settings: Settings) -> float:
    """Longer than any homing that can still succeed: 1.5 travels of each axis at seek rate, and locating."""
    seek_mm_per_s = max(settings.get(SEEK_RATE, 100.0), 1.0) / 60.0
    locate_mm_per_s = max(settings.get(LOCATE_RATE, 25.0), 1.0) / 60.0
    travel_mm = sum(settings[MAX_TRAVEL + axis] for axis in range(3))
    return 10.0 + 1.5 * travel_mm / seek_mm_per_s + 30.0 * settings.get(PULL_OFF, 1.0) / locate_mm_per_s


def stand_at(position_mm: Vector, target_mm: Vector, settings: Settings) -> bool:
    """Whether axes at ``position_mm`` stand at ``target_mm``, to half a motor step and the report's rounding."""
    return all(
        abs(at - to) <= 0.5 / max(settings.get(STEPS_PER_MM + axis, 0.0), 1.0) + 2 * RESOLUTION_MM
        for axis, (at, to) in enumerate(zip(position_mm, target_mm, strict=True))
    )


def shown(point_mm: Vector) -> str:
    """A point as messages show it."""
    return "(" + ", ".join(f"{value:.4g}" for value in point_mm) + ")"


def rates_mm_per_s(settings: Settings) -> Vector:
    """The greatest rates of the axes."""
    x, y, z = (settings[MAX_RATE + axis] / 60.0 for axis in range(3))
    return (x, y, z)
