"""Charts as SVG in the page's own colours: data placed in a box, with ticks along two sides."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

Range = tuple[float, float]
"""From the left or the lower end to the other; it may run downwards, as the rows of a picture do."""


@dataclass(frozen=True)
class Tick:
    """A place along an axis, in user units, and what stands there."""

    at: float
    text: str


class Chart:
    """A box for data, which leaves room for the ticks' words."""

    def __init__(
        self,
        x: Range,
        y: Range,
        *,
        width: float = 720.0,
        height: float = 220.0,
        unit: str = "",
        logarithmic: bool = False,
        even: bool = False,
        named: bool = False,
    ) -> None:
        """Lay it out.

        Args:
            x: of the data.
            y: of the data.
            width: of the box.
            height: of the box.
            unit: written behind the ticks along x.
            logarithmic: y; both its ends are then above 0.
            named: what stands along x are names and no numbers, so that it gets no ticks.
            even: one unit is as long along x as along y; the range that has room to spare is widened.
        """
        self.width, self.height, self.unit, self.logarithmic, self.named = width, height, unit, logarithmic, named
        self.left, self.right, self.top, self.bottom = 52.0, width - 8.0, 8.0, height - 26.0
        self.x, self.y = x, y
        if even:
            across = abs(x[1] - x[0]) / (self.right - self.left)
            up = abs(y[1] - y[0]) / (self.bottom - self.top)
            self.x, self.y = _widened(x, max(1.0, up / across)), _widened(y, max(1.0, across / up))

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where a value is drawn."""
        low, high = self.y
        share = math.log(y / low) / math.log(high / low) if self.logarithmic else _share(y, self.y)
        across = self.left + _share(x, self.x) * (self.right - self.left)
        return round(across, 1), round(self.bottom - share * (self.bottom - self.top), 1)

    def line(self, dots: Iterable[tuple[float, float]]) -> str:
        """The ``points`` of a polyline through values."""
        return " ".join("{},{}".format(*self.at(x, y)) for x, y in dots)

    @property
    def across(self) -> list[Tick]:
        """Along x."""
        if self.named:
            return []
        behind = f" {self.unit}" if self.unit else ""
        return [Tick(self.at(value, self.y[0])[0], f"{value:g}{behind}") for value in ticks(*self.x)]

    @property
    def up(self) -> list[Tick]:
        """Along y."""
        values = _powers(*self.y) if self.logarithmic else ticks(*self.y)
        return [Tick(self.at(self.x[0], value)[1], f"{value:g}") for value in values]


def ticks(a: float, b: float) -> list[float]:
    """Three to seven round values between two, the ends included where they are round."""
    low, high = min(a, b), max(a, b)
    if high <= low:
        return [low]
    raw = (high - low) / 6
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw)
    first = math.ceil(low / step - 1e-9)
    return [round(index * step, 10) for index in range(first, math.floor(high / step + 1e-9) + 1)]


def _powers(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten within a range; its ends where it has no two of them."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found = [float(f"{factor}e{power}") for power in powers for factor in (1, 2, 5)]
    found = [value for value in found if low <= value <= high]
    return found if len(found) > 1 else [float(f"{low:.3g}"), float(f"{high:.3g}")]


def _share(value: float, ends: Range) -> float:
    return (value - ends[0]) / ((ends[1] - ends[0]) or 1e-9)


def _widened(ends: Range, factor: float) -> Range:
    middle, half = (ends[0] + ends[1]) / 2, factor * (ends[1] - ends[0]) / 2
    return middle - half, middle + half
