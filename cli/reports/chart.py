"""Axes of the drawings in reports, in a box of 720 by 220."""

import math
from collections.abc import Callable
from typing import Any

WIDTH, HEIGHT, LEFT, BOTTOM = 720.0, 220.0, 46.0, 26.0

Place = Callable[[float, float], tuple[float, float]]
"""Where a value is drawn."""


def axes(
    t0: float, t1: float, low: float, high: float, unit: str = "s"
) -> tuple[Place, list[dict[str, Any]], list[dict[str, Any]]]:
    """Where values from ``t0`` to ``t1`` (in ``unit``) and from ``low`` to ``high`` are drawn, and both axes' ticks."""

    def place(t: float, value: float) -> tuple[float, float]:
        x = LEFT + (t - t0) / max(t1 - t0, 1e-9) * (WIDTH - LEFT - 8)
        y = 8 + (high - value) / max(high - low, 1e-9) * (HEIGHT - BOTTOM - 8)
        return round(x, 1), round(y, 1)

    across = [{"at": place(t, low)[0], "text": f"{t:.0f} {unit}"} for t in _ticks(t0, t1)]
    up = [{"at": place(t0, value)[1], "text": f"{value:g}"} for value in _ticks(low, high)]
    return place, across, up


def _ticks(low: float, high: float) -> list[float]:
    span = max(high - low, 1e-9)
    step = next(s for k in range(-6, 7) for s in (10.0**k, 2 * 10.0**k, 5 * 10.0**k) if span / s <= 6)
    first = math.ceil(low / step - 1e-6)
    return [round(step * k, 9) for k in range(first, math.floor(high / step + 1e-6) + 1)]
