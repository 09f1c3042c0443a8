"""Settings of the emulated g2core board, by group and name (g2core wiki, Configuring Version 0.99)."""

import math
from collections.abc import Mapping

from drivers.errors import ConfigError

AXES = "xyz"
OK, UNRECOGNIZED_NAME, READ_ONLY, BELOW_MINIMUM, ABOVE_MAXIMUM = 0, 100, 104, 108, 109

_SYSTEM: Mapping[str, float | str] = {
    "fb": 101.03, "fv": 0.99, "fbs": "101.03", "fbc": "settings_default.h", "hp": 3, "hv": 0, "id": "0213-2335-6343",
    "jt": 0.75, "ct": 0.01, "sl": 0, "lim": 1, "saf": 1, "mt": 2, "fhz": 0, "ej": 1, "jv": 2, "qv": 0, "sv": 1,
    "si": 250, "gpl": 0, "gun": 1, "gco": 1, "gpa": 2, "gdi": 0,
}  # fmt: skip
_AXIS: Mapping[str, float] = {
    "am": 1, "vm": 1200, "fr": 1200, "tn": 0, "tm": 0, "jm": 10_800, "jh": 20_000, "hi": 0, "hd": 1, "sv": 500,
    "lv": 100, "lb": 3, "zb": 1,
}  # fmt: skip
_MOTOR: Mapping[str, float] = {"ma": 0, "sa": 1.8, "tr": 1.6, "mi": 8, "su": 1000, "po": 0, "pm": 2, "pl": 0.4}
_READ_ONLY = frozenset({"fb", "fv", "fbs", "fbc", "hp", "hv", "id"})
_LIMITS: Mapping[str, tuple[float, float]] = {
    "sl": (0, 1), "lim": (0, 1), "saf": (0, 1), "ej": (0, 1), "jv": (0, 5), "qv": (0, 2), "sv": (0, 2),
}  # fmt: skip
_FORGOTTEN = ("ej", "jv", "qv", "sv")
"""A reset brings these back to what they are at power-up."""
_JERK_UNIT = 1e6 / 60**3
"""Jerk settings count millions of mm/min3; in mm/s3."""

Value = float | str
Axes = tuple[float, float, float]


class Settings:
    """What the board remembers."""

    def __init__(self, given: Mapping[str, float]) -> None:
        """``given`` are settings that differ from the defaults."""
        self._values: dict[str, Value] = dict(_SYSTEM)
        for axis in AXES:
            self._values |= {axis + name: value for name, value in _AXIS.items()}
        for motor in range(3):
            self._values |= {f"{motor + 1}{name}": value for name, value in _MOTOR.items()}
            self._values[f"{motor + 1}ma"] = motor
        for index, axis in enumerate(AXES):
            self._values[f"{axis}hi"] = index + 1
        for name, value in given.items():
            if name not in self._values:
                raise ConfigError(f"emulated g2core board: no setting {name!r}; there are {', '.join(self._values)}")
            self._values[name] = value

    def __getitem__(self, name: str) -> float:
        return float(self._values[name])

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def text(self, name: str) -> str:
        """A setting that is text."""
        return str(self._values[name])

    def axes(self, name: str) -> Axes:
        """A setting of all three axes."""
        x, y, z = (self[axis + name] for axis in AXES)
        return x, y, z

    @property
    def steps_per_mm(self) -> Axes:
        """Of the three motors."""
        x, y, z = (
            360.0 / self[f"{motor}sa"] * self[f"{motor}mi"] / self[f"{motor}tr"] for motor in range(1, len(AXES) + 1)
        )
        return x, y, z

    @property
    def acceleration(self) -> Axes:
        """Constant, mm/s2, such that an axis is as soon at its greatest feed as under its jerk."""
        x, y, z = (
            math.sqrt(feed / 60 * jerk * _JERK_UNIT) / 2
            for feed, jerk in zip(self.axes("fr"), self.axes("jm"), strict=True)
        )
        return x, y, z

    def read(self, name: str) -> Value | dict[str, Value] | None:
        """A setting, or all of a group; None where there is neither."""
        if name == "sys":
            return {key: self._values[key] for key in _SYSTEM}
        if name in AXES or name in {"1", "2", "3"}:
            members = _AXIS if name in AXES else _MOTOR
            return {key: self._values[name + key] for key in members}
        return self._values.get(name)

    def write(self, name: str, value: float) -> int:
        """Store a setting; the status code of the reply."""
        if name not in self._values:
            return UNRECOGNIZED_NAME
        if name in _READ_ONLY:
            return READ_ONLY
        low, high = _LIMITS.get(name, (-math.inf, math.inf))
        if value < low:
            return BELOW_MINIMUM
        if value > high:
            return ABOVE_MAXIMUM
        self._values[name] = value
        return OK

    def put(self, name: str, value: Value) -> None:
        """What no host may write: another firmware, another board, another hand on the memory."""
        self._values[name] = value

    def forget(self) -> None:
        """A reset."""
        for name in _FORGOTTEN:
            self._values[name] = _SYSTEM[name]
