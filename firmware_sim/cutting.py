"""A ball that cuts, or presses on, a height field."""

import math
from typing import Any

import numpy as np
from numba import njit

SCRATCH_CELLS = 40_000
_NO_BONE_MM = 1e-4


def new_scratch() -> tuple[Any, Any, Any]:
    """Work space of ``mill_step``: cell rows and columns, overlaps, shares of the normal that point up."""
    return (
        np.empty((SCRATCH_CELLS, 2), np.int32),
        np.empty(SCRATCH_CELLS, np.float64),
        np.empty(SCRATCH_CELLS, np.float64),
    )


@njit(cache=True, nogil=True)
def mill_step(
    top: Any,
    inner: Any,
    membrane: Any,
    x0: float,
    y0: float,
    step: float,
    ball: tuple[float, float, float],
    radius: float,
    stiffness: float,
    capacity: float,
    cells: Any,
    overlap: Any,
    upward: Any,
) -> tuple[float, float, float, int, int, int, int, int, int]:
    """One instant of a ball centred at ``ball``; lowers ``top`` by what it removes. There is no bone below ``inner``.

    The skull gives way by a deflection d. Bone is removed in proportion to the force that presses on it:
    ``volume * upward share = capacity * stiffness * d``, with ``capacity`` in mm^3 per N (0: the ball only pushes).

    Returns:
        deflection, removed volume in mm^3, depth below the membrane (far below zero where it is not reached), its row
        and column, and the box of changed cells (first row, past the last, first column, past the last).
    """
    bx, by, bz = ball
    i0 = max(0, math.ceil((bx - radius - x0) / step))
    i1 = min(top.shape[0], math.floor((bx + radius - x0) / step) + 1)
    j0 = max(0, math.ceil((by - radius - y0) / step))
    j1 = min(top.shape[1], math.floor((by + radius - y0) / step) + 1)
    count = 0
    pressed = 0.0
    below = -1e9
    below_i = -1
    below_j = -1
    for i in range(i0, i1):
        dx = x0 + i * step - bx
        for j in range(j0, j1):
            dy = y0 + j * step - by
            room = radius * radius - dx * dx - dy * dy
            if room <= 0.0:
                continue
            # Without a root for the many cells that the ball does not reach.
            gap = bz - membrane[i, j]
            if gap < 0.0 or gap * gap < room:
                deep = math.sqrt(room) - gap
                if deep > below:
                    below = deep
                    below_i = i
                    below_j = j
            gap = bz - top[i, j]
            if top[i, j] > inner[i, j] + _NO_BONE_MM and (gap < 0.0 or gap * gap < room) and count < cells.shape[0]:
                height = math.sqrt(room)
                cells[count, 0] = i
                cells[count, 1] = j
                overlap[count] = height - gap
                upward[count] = height / radius
                pressed = max(pressed, (height - gap) * height / radius)
                count += 1
    if count == 0:
        return 0.0, 0.0, below, below_i, below_j, 0, 0, 0, 0
    if capacity <= 0.0:
        return pressed, 0.0, below - pressed, below_i, below_j, 0, 0, 0, 0
    area = step * step
    low = 0.0
    high = pressed
    for _ in range(12):
        middle = 0.5 * (low + high)
        cut = 0.0
        for n in range(count):
            if overlap[n] > middle:
                left = top[cells[n, 0], cells[n, 1]] - inner[cells[n, 0], cells[n, 1]]
                cut += min(overlap[n] - middle, left) * upward[n]
        if cut * area > capacity * stiffness * middle:
            low = middle
        else:
            high = middle
    deflection = high
    volume = 0.0
    ci0, ci1, cj0, cj1 = top.shape[0], 0, top.shape[1], 0
    for n in range(count):
        i, j = cells[n, 0], cells[n, 1]
        gone = min(overlap[n] - deflection, top[i, j] - inner[i, j])
        if gone > 0.0:
            top[i, j] -= gone
            volume += gone * area
            ci0, ci1 = min(ci0, i), max(ci1, i + 1)
            cj0, cj1 = min(cj0, j), max(cj1, j + 1)
    if volume == 0.0:
        ci0, cj0 = 0, 0
    return deflection, volume, below - deflection, below_i, below_j, ci0, ci1, cj0, cj1


@njit(cache=True, nogil=True)
def carve_balls(top: Any, x0: float, y0: float, step: float, balls: Any, radius: float) -> None:
    """Remove at once what balls centred at ``balls`` (n, 3) overlap."""
    for n in range(balls.shape[0]):
        bx, by, bz = balls[n, 0], balls[n, 1], balls[n, 2]
        i0 = max(0, math.ceil((bx - radius - x0) / step))
        i1 = min(top.shape[0], math.floor((bx + radius - x0) / step) + 1)
        j0 = max(0, math.ceil((by - radius - y0) / step))
        j1 = min(top.shape[1], math.floor((by + radius - y0) / step) + 1)
        for i in range(i0, i1):
            dx = x0 + i * step - bx
            for j in range(j0, j1):
                dy = y0 + j * step - by
                room = radius * radius - dx * dx - dy * dy
                if room > 0.0:
                    top[i, j] = min(top[i, j], bz - math.sqrt(room))
