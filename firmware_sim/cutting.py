"""A ball that cuts, or presses on, a height field."""

import math
from typing import Any

import numpy as np
from numba import njit

SCRATCH_CELLS = 40_000
_NO_BONE_MM = 1e-4


def new_scratch() -> tuple[Any, Any, Any, Any, Any]:
    """Work space of ``mill_step``.

    Which cells of a row the ball reaches; and of those that hold bone their row and column, bone left, overlap, share
    of the normal that points up.
    """
    return (
        np.empty(SCRATCH_CELLS, np.bool_),
        np.empty((SCRATCH_CELLS, 2), np.int32),
        np.empty(SCRATCH_CELLS, np.float64),
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
    reached: Any,
    cells: Any,
    left: Any,
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
    square = radius * radius
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
        row = square - dx * dx
        tops, inners, membranes = top[i, j0:j1], inner[i, j0:j1], membrane[i, j0:j1]
        # The ball reaches few of the cells. This loop finds them without a branch, which makes it a quick one.
        some = False
        for k in range(j1 - j0):
            dy = y0 + (j0 + k) * step - by
            gap = max(0.0, bz - max(tops[k], membranes[k]))
            reached[k] = row - dy * dy > gap * gap
            some |= reached[k]
        if not some:
            continue
        for k in range(j1 - j0):
            if not reached[k]:
                continue
            j = j0 + k
            dy = y0 + j * step - by
            room = row - dy * dy
            # Without a root for the many cells that the ball does not reach.
            gap = bz - membranes[k]
            if gap < 0.0 or gap * gap < room:
                deep = math.sqrt(room) - gap
                if deep > below:
                    below = deep
                    below_i = i
                    below_j = j
            gap = bz - tops[k]
            if tops[k] > inners[k] + _NO_BONE_MM and (gap < 0.0 or gap * gap < room) and count < cells.shape[0]:
                height = math.sqrt(room)
                cells[count, 0] = i
                cells[count, 1] = j
                left[count] = tops[k] - inners[k]
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
        allowed = capacity * stiffness * middle
        cut = 0.0
        for n in range(count):
            if overlap[n] > middle:
                cut += min(overlap[n] - middle, left[n]) * upward[n]
                if cut * area > allowed:
                    break
        if cut * area > allowed:
            low = middle
        else:
            high = middle
    deflection = high
    volume = 0.0
    ci0, ci1, cj0, cj1 = top.shape[0], 0, top.shape[1], 0
    for n in range(count):
        gone = min(overlap[n] - deflection, left[n])
        if gone > 0.0:
            i, j = cells[n, 0], cells[n, 1]
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
