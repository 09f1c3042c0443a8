"""The board's `$` settings: defaults, limits, and how they are printed. They outlive every reset."""

import re
from collections.abc import Mapping

from drivers.errors import ConfigError
from firmware_sim.grbl_planner import Limits

_GNEA_DEFAULTS: dict[int, float] = {
    0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0, 20: 0, 21: 0, 22: 0, 23: 0, 24: 25,
    25: 500, 26: 250, 27: 1, 30: 1000, 31: 0, 32: 0, 100: 250, 101: 250, 102: 250, 110: 500, 111: 500, 112: 500,
    120: 10, 121: 10, 122: 10, 130: 200, 131: 200, 132: 200,
}  # fmt: skip
_HAL_EXTRA: dict[int, float] = {
    7: 0,
    8: 0,
    9: 1,
    10: 511,
    14: 70,
    15: 0,
    28: 0.1,
    29: 0,
    40: 1,
    43: 1,
    44: 4,
    45: 3,
    46: 0,
}

_NEXT_TO_NOTHING = 1e-3
_FLOATS = {11, 12, 24, 25, 27, 28, 29, *range(100, 133)}
"""Printed with three decimals."""


def _positive(values: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = (max(value, _NEXT_TO_NOTHING) for value in values)
    return x, y, z


class SettingError(Exception):
    """A setting that the firmware refuses, with its code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


class Settings:
    """Numbers by their `$` number."""

    def __init__(self, dialect: str, given: Mapping[str, float]) -> None:
        self._is_hal = dialect == "grblhal"
        self._values = dict(self._defaults())
        for key, value in given.items():
            if not re.fullmatch(r"\$?\d+", key) or int(key.lstrip("$")) not in self._values:
                known = " ".join(f"${number}" for number in sorted(self._values))
                raise ConfigError(f"emulated GRBL board ({dialect}): no setting {key!r}; there are {known}")
            self._values[int(key.lstrip("$"))] = float(value)

    def _defaults(self) -> dict[int, float]:
        return dict(sorted((_GNEA_DEFAULTS | (_HAL_EXTRA if self._is_hal else {})).items()))

    def restore(self) -> None:
        """Back to the firmware's defaults."""
        self._values = self._defaults()

    def __getitem__(self, number: int) -> float:
        return self._values[number]

    def flag(self, number: int) -> bool:
        """A setting that is on or off."""
        return bool(int(self._values[number]) & 1)

    def mask(self, number: int) -> int:
        """A setting made of bits."""
        return int(self._values[number])

    def per_axis(self, number: int) -> tuple[float, float, float]:
        """Three settings in a row."""
        return self._values[number], self._values[number + 1], self._values[number + 2]

    @property
    def steps_per_mm(self) -> tuple[float, float, float]:
        """``$100`` to ``$102``; the firmware takes a zero there, and so does the board, as next to nothing."""
        return _positive(self.per_axis(100))

    def limits(self) -> Limits:
        """What the planner needs: speeds in mm/s."""
        x, y, z = _positive(self.per_axis(110))
        return Limits(self.steps_per_mm, (x / 60, y / 60, z / 60), _positive(self.per_axis(120)), self[11])

    def store(self, number: int, value: float) -> None:
        """Take a value from the host.

        Raises:
            SettingError: with the firmware's code.
        """
        if value < 0:
            raise SettingError(4)
        if number not in self._values:
            raise SettingError(53 if self._is_hal else 3)
        if number == 0 and value < 3 and not self._is_hal:
            raise SettingError(6)
        if number == 20 and int(value) & 1 and not self.flag(22):
            raise SettingError(10)
        if number == 22 and not int(value) & 1:
            self._values[20] = 0
        self._values[number] = value if number in _FLOATS or number in {30, 31} else float(int(value))

    def lines(self) -> list[str]:
        """The answer to `$$`."""
        return [f"${number}={self._text(number, value)}" for number, value in self._values.items()]

    def _text(self, number: int, value: float) -> str:
        if number in _FLOATS or (self._is_hal and number in {30, 31}):
            return f"{value:.3f}"
        return f"{value:.0f}"
