"""What a board's own settings say about the machine: its travel, its limits, and what mill insists on.

A setting is called by its group and name, such as ``xtn`` (g2core wiki, Configuring Version 0.99).
"""

import math
from collections.abc import Mapping

from drivers.errors import ConfigError
from drivers.motion.interface import Vector

AXES = "xyz"
GROUPS = ("sys", *AXES, "1", "2", "3")
"""What is read: the system's settings, the axes', and those of the three motors."""
RESOLUTION_MM = 0.001
"""What the three decimals of a move keep."""
FLOOR_SETTING = "ztn"
UNLIMITED_MM = 1e6
"""A travel from here on switches the soft limit off."""

Settings = Mapping[str, float]

_NAMES = {
    "sl": "soft limits", "lim": "limit switches", "jt": "junction time", "ct": "chordal tolerance",
    "mt": "motor time-out", "saf": "safety interlock", "fhz": "lift in a feed hold",
}  # fmt: skip
_OF_AXES = {
    "am": "axis mode", "vm": "greatest velocity", "fr": "greatest feed", "tn": "low end of travel",
    "tm": "high end of travel", "jm": "jerk", "jh": "jerk of homing", "hi": "homing input", "hd": "homing direction",
    "sv": "homing search", "lv": "homing latch", "lb": "homing backoff", "zb": "pull-off after homing",
}  # fmt: skip


def titled(name: str) -> str:
    """A setting with its meaning, "xtn (low end of travel of X)"."""
    meaning = _NAMES.get(name, "")
    if name[:1] in AXES and name[1:] in _OF_AXES:
        meaning = f"{_OF_AXES[name[1:]]} of {name[0].upper()}"
    return f"{name} ({meaning})" if meaning else name


def check_expected(line: str, settings: Settings, expected: Mapping[str, float]) -> None:
    """Compare what the board has with what the rig file expects.

    Raises:
        ConfigError: names the key, what was found and what was expected.
    """
    for name, value in expected.items():
        found = settings.get(name)
        if found is None:
            raise ConfigError(f"{line}: the board has no setting {titled(name)}; the rig file expects {value:g}")
        # The firmware keeps single precision and prints three decimals.
        if not math.isclose(found, value, rel_tol=1e-6, abs_tol=5.1e-4):
            raise ConfigError(
                f"{line}: setting {titled(name)} is {found:g}, the rig file expects {value:g}; is this the right "
                f'controller? If so, correct [motion.settings] or write {{"{name}":{value:g}}} into the board'
            )


def floor_to_remove(settings: Settings, expected: Mapping[str, float]) -> float | None:
    """The low end of Z that the rig file expects where the board has a higher one, else None.

    A host that is killed leaves its floor in the board.
    """
    wanted, found, high = expected.get(FLOOR_SETTING), settings.get(FLOOR_SETTING), settings.get("ztm", 0.0)
    if wanted is None or found is None or not wanted + RESOLUTION_MM / 2 < found < high:
        return None
    return wanted


def check_required(line: str, settings: Settings) -> None:
    """Refuse a board that would not refuse for itself.

    Raises:
        ConfigError: names the setting, what was found and what to write.
    """

    def require(name: str, *, holds: bool, why: str) -> None:
        if not holds:
            found = settings.get(name)
            shown = "missing" if found is None else f"{found:g}"
            raise ConfigError(
                f"{line}: setting {titled(name)} is {shown}, and mill needs {why}; write it into the board"
            )

    require("sl", holds=settings.get("sl") == 1, why="soft limits on, 1")
    require("fhz", holds=settings.get("fhz", 0.0) == 0, why="a feed hold that stays on the path, 0")
    for axis in AXES:
        require(f"{axis}am", holds=settings.get(f"{axis}am") == 1, why="a standard axis, 1")
        require(f"{axis}hi", holds=settings.get(f"{axis}hi", 0.0) >= 1, why="the number of its homing switch")
        for name in ("vm", "fr", "sv", "lv"):
            require(f"{axis}{name}", holds=settings.get(f"{axis}{name}", 0.0) > 0, why="a rate above 0 mm/min")
        low, high = settings.get(f"{axis}tn", math.nan), settings.get(f"{axis}tm", math.nan)
        require(f"{axis}tm", holds=low < high < UNLIMITED_MM, why=f"a travel that ends above {axis}tn")
        require(f"{axis}tn", holds=low > -UNLIMITED_MM, why="a travel that begins somewhere")


def rates_mm_per_s(settings: Settings) -> Vector:
    """The greatest feeds of the axes."""
    x, y, z = (min(settings[f"{axis}fr"], settings[f"{axis}vm"]) / 60.0 for axis in AXES)
    return (x, y, z)


def homes_low(settings: Settings, axis: str) -> bool:
    """Whether an axis searches its switch at its low end."""
    return settings.get(f"{axis}hd") == 0


def homing_timeout_s(settings: Settings) -> float:
    """Longer than any homing that can still succeed: a travel and a backoff of each axis, and latching."""
    total_s = 10.0
    for axis in AXES:
        travel_mm = settings[f"{axis}tm"] - settings[f"{axis}tn"]
        backoff_mm = settings.get(f"{axis}lb", 0.0) + settings.get(f"{axis}zb", 0.0)
        total_s += 60.0 * (travel_mm + 3.0 * backoff_mm) / settings[f"{axis}sv"]
        total_s += 60.0 * backoff_mm / settings[f"{axis}lv"]
    return total_s
