"""A ball that cuts, or presses on, a height field, and how time passes there; compiled.

The world's numbers are one record, in an array of one because that is handed over fastest. Everything is computed in
the order in which it is written here, in double precision: the same calls give the same bits. It is one file because
what is compiled is cached by the file that it stands in.
"""

import math
from typing import Any, Final

import numpy as np
from numba import njit

SCRATCH_CELLS = 40_000
_NO_BONE_MM = 1e-4
CUTS_ABOVE_RPM: Final = 10_000.0
NOMINAL_RPM: Final = 50_000.0
REMOVAL_MM3_PER_S_N: Final = 0.35
NOMINAL_RATE_MM2_PER_S: Final = 0.065
IDLE_TORQUE: Final = 0.08
NOMINAL_TORQUE: Final = 0.22
RATE_FILTER_S: Final = 0.008
HEAT_C_PER_MM3: Final = 22.0
HEAT_DECAY_S: Final = 8.0
LONGEST_STEP_MM: Final = 0.02
LONGEST_STEP_S: Final = 0.002
FLAP_PERIOD_S: Final = 0.25
FLAP_PATH_LEAST: Final = 50

THROUGH, LOOK_AT_FLAP, PATH_FULL = 0, 1, 2
"""Why ``move``, ``stay`` and ``go_on`` return: time has passed, or the caller is to do something and to go on."""

WORLD: Final = np.dtype(
    [
        # Of this specimen and its tool.
        ("x0_mm", "f8"), ("y0_mm", "f8"), ("step_mm", "f8"), ("highest_mm", "f8"),
        ("power_up_mm", "f8", (3,)), ("end_stops_mm", "f8", (3,)),
        ("ball_offset_mm", "f8", (3,)), ("ball_radius_mm", "f8"), ("turning_radius_mm", "f8"),
        ("stiffness_n_per_mm", "f8"), ("flap_softening", "f8"), ("nominal_rate_mm3_s", "f8"),
        ("torque_noise", "f8"), ("torque_ripple", "f8"), ("torque_drift", "f8"), ("phases_rad", "f8", (4,)),
        # What somebody may change.
        ("backlash_mm", "f8", (3,)), ("axis_scale", "f8", (3,)), ("lost_mm", "f8", (3,)),
        # What time changes.
        ("now_s", "f8"), ("spindle_rpm", "f8"), ("turns", "f8"),
        ("command_mm", "f8", (3,)), ("tip_mm", "f8", (3,)), ("velocity_mm_s", "f8", (3,)),
        ("deflection_mm", "f8"), ("force_n", "f8"), ("greatest_force_n", "f8"),
        ("rate_mm3_s", "f8"), ("heat_c", "f8"), ("greatest_heat_c", "f8"),
        ("freed", "f8"), ("flap_checked_s", "f8"), ("path_length", "i8"),
        ("first_cut_s", "f8"), ("overrun_mm", "f8"), ("touched_at_s", "f8"), ("touched_mm", "f8", (3,)),
        # The move under way: where from and where to, its steps, and the cells that it has changed so far.
        ("start_mm", "f8", (3,)), ("target_mm", "f8", (3,)), ("before_mm", "f8", (3,)),
        ("elapsed_s", "f8"), ("step", "i8"), ("steps", "i8"),
        ("i0", "i8"), ("i1", "i8"), ("j0", "i8"), ("j1", "i8"),
    ]
)  # fmt: skip


@njit(cache=True, nogil=True)
def move(
    worlds: Any,
    top: Any,
    inner: Any,
    membrane: Any,
    path: Any,
    scratch: Any,
    time_s: float,
    x: float,
    y: float,
    z: float,
) -> int:
    """Straight from the last command to where the motors stand at (x, y, z), relative to power-up, at ``time_s``."""
    world = worlds[0]
    motors = (x, y, z)
    for axis in range(3):
        turned_mm = motors[axis] * world.axis_scale[axis] + world.lost_mm[axis]
        world.target_mm[axis] = min(world.power_up_mm[axis] + turned_mm, world.end_stops_mm[axis])
    return _begin(world, top, inner, membrane, path, scratch, time_s)


@njit(cache=True, nogil=True)
def stay(worlds: Any, top: Any, inner: Any, membrane: Any, path: Any, scratch: Any, time_s: float) -> int:
    """Stand at the last command until ``time_s``."""
    world = worlds[0]
    for axis in range(3):
        world.target_mm[axis] = world.command_mm[axis]
    return _begin(world, top, inner, membrane, path, scratch, time_s)


@njit(cache=True, nogil=True)
def go_on(worlds: Any, top: Any, inner: Any, membrane: Any, path: Any, scratch: Any) -> int:
    """The rest of the move under way."""
    return _step_on(worlds[0], top, inner, membrane, path, scratch)


@njit(cache=True, nogil=True)
def _begin(world: Any, top: Any, inner: Any, membrane: Any, path: Any, scratch: Any, time_s: float) -> int:
    world.elapsed_s = max(0.0, time_s - world.now_s)
    start, target = world.command_mm, world.target_mm
    x, y, z = target[0], target[1], target[2]
    world.i0, world.i1, world.j0, world.j1 = 0, 0, 0, 0
    if world.elapsed_s == 0.0 and start[0] == x and start[1] == y and start[2] == z:
        return THROUGH
    for axis in range(3):
        world.start_mm[axis] = start[axis]
        world.before_mm[axis] = world.tip_mm[axis]
    if _in_reach(world, min(start[2], z)):
        distance = math.sqrt((x - start[0]) ** 2 + (y - start[1]) ** 2 + (z - start[2]) ** 2)
        # The small allowance keeps a tick of exactly the longest step in one piece.
        by_distance = math.ceil(distance / LONGEST_STEP_MM - 1e-3)
        by_time = math.ceil(world.elapsed_s / LONGEST_STEP_S - 1e-3)
        steps = max(1, by_distance, by_time)
        if distance == 0.0 and world.deflection_mm == 0.0:
            steps = min(steps, 5)
        world.step, world.steps = 0, steps
    else:
        world.step, world.steps = 0, 0
        _follow(world, x, y, z)
        world.deflection_mm = 0.0
        world.force_n = 0.0
        _settle(world, 0.0, world.elapsed_s)
    return _step_on(world, top, inner, membrane, path, scratch)


@njit(cache=True, nogil=True)
def _step_on(world: Any, top: Any, inner: Any, membrane: Any, path: Any, scratch: Any) -> int:
    start, target = world.start_mm, world.target_mm
    while world.step < world.steps:
        if world.path_length == len(path):
            return PATH_FULL
        world.step += 1
        share = world.step / world.steps
        _follow(
            world,
            start[0] + (target[0] - start[0]) * share,
            start[1] + (target[1] - start[1]) * share,
            start[2] + (target[2] - start[2]) * share,
        )
        time_s = world.now_s + world.elapsed_s * world.step / world.steps
        _cut(world, top, inner, membrane, path, scratch, time_s, world.elapsed_s / world.steps)
        if time_s - world.flap_checked_s > FLAP_PERIOD_S and world.path_length > FLAP_PATH_LEAST:
            world.flap_checked_s = time_s
            return LOOK_AT_FLAP
    for axis in range(3):
        world.command_mm[axis] = target[axis]
        if world.elapsed_s > 0.0:
            world.velocity_mm_s[axis] = (world.tip_mm[axis] - world.before_mm[axis]) / world.elapsed_s
    world.turns += world.spindle_rpm / 60.0 * world.elapsed_s
    world.now_s += world.elapsed_s
    return THROUGH


@njit(cache=True, nogil=True)
def torque_fraction(worlds: Any, noise: Any, time_s: float, speed_rpm: float) -> float:
    """Share of the rated torque: idle, what the cut takes, ripple of the shaft, noise and drift."""
    world = worlds[0]
    cutting = NOMINAL_TORQUE * world.rate_mm3_s / world.nominal_rate_mm3_s
    if 0 < abs(speed_rpm) < NOMINAL_RPM:
        cutting *= NOMINAL_RPM / max(abs(speed_rpm), CUTS_ABOVE_RPM)
    angle = 2 * np.pi * (world.turns + (time_s - world.now_s) * speed_rpm / 60.0)
    phases = world.phases_rad
    ripple = math.sin(angle + phases[0]) + 0.5 * math.sin(2 * angle + phases[1])
    sample = noise[(math.floor(time_s * 100.0 + 1e-6) * 2654435761 >> 7) % len(noise)]
    drift = world.torque_drift * time_s / 60.0
    wander = 0.3 * world.torque_drift * math.sin(2 * np.pi * time_s / 47.0 + phases[2])
    share = world.torque_noise * sample + world.torque_ripple * ripple + drift + wander
    return float(max(0.0, IDLE_TORQUE + cutting + NOMINAL_TORQUE * share))


@njit(cache=True, nogil=True)
def _in_reach(world: Any, lowest_tip_z_mm: float) -> bool:
    lowest = lowest_tip_z_mm + world.ball_offset_mm[2] - world.turning_radius_mm
    return bool(lowest - world.backlash_mm[2] < world.highest_mm)


@njit(cache=True, nogil=True)
def _follow(world: Any, x_mm: float, y_mm: float, z_mm: float) -> None:
    """The table lags within the play of each axis."""
    for axis, command in enumerate((x_mm, y_mm, z_mm)):
        play = 0.5 * world.backlash_mm[axis]
        world.tip_mm[axis] = min(max(world.tip_mm[axis], command - play), command + play)


@njit(cache=True, nogil=True)
def _cut(
    world: Any, top: Any, inner: Any, membrane: Any, path: Any, scratch: Any, time_s: float, elapsed_s: float
) -> None:
    rpm = abs(world.spindle_rpm)
    cuts = rpm > CUTS_ABOVE_RPM
    radius = world.turning_radius_mm if cuts else world.ball_radius_mm
    stiffness = world.stiffness_n_per_mm * (1.0 - world.flap_softening * world.freed)
    capacity = REMOVAL_MM3_PER_S_N * rpm / NOMINAL_RPM * elapsed_s if cuts else 0.0
    ball = (
        world.tip_mm[0] + world.ball_offset_mm[0],
        world.tip_mm[1] + world.ball_offset_mm[1],
        world.tip_mm[2] + world.ball_offset_mm[2],
    )
    x0, y0, step = world.x0_mm, world.y0_mm, world.step_mm
    deflection, volume, below, i, j, i0, i1, j0, j1 = mill_step(
        top, inner, membrane, x0, y0, step, ball, radius, stiffness, capacity, *scratch
    )
    world.deflection_mm = deflection
    world.force_n = stiffness * deflection
    world.greatest_force_n = max(world.greatest_force_n, world.force_n)
    world.overrun_mm = max(world.overrun_mm, below)
    if below > 0.0 and math.isnan(world.touched_at_s):
        world.touched_at_s = time_s
        world.touched_mm[0], world.touched_mm[1], world.touched_mm[2] = x0 + i * step, y0 + j * step, membrane[i, j]
    if volume > 0.0:
        if math.isnan(world.first_cut_s):
            world.first_cut_s = time_s
        if world.i1 <= world.i0:
            world.i0, world.i1, world.j0, world.j1 = i0, i1, j0, j1
        else:
            world.i0, world.i1 = min(world.i0, i0), max(world.i1, i1)
            world.j0, world.j1 = min(world.j0, j0), max(world.j1, j1)
        n = world.path_length
        if n == 0 or math.sqrt((path[n - 1, 0] - ball[0]) ** 2 + (path[n - 1, 1] - ball[1]) ** 2) > LONGEST_STEP_MM:
            path[n, 0], path[n, 1] = ball[0], ball[1]
            world.path_length = n + 1
    _settle(world, volume, elapsed_s)


@njit(cache=True, nogil=True)
def _settle(world: Any, volume_mm3: float, elapsed_s: float) -> None:
    """Filtered removal rate, and heat."""
    if elapsed_s <= 0.0:
        return
    keep = math.exp(-elapsed_s / RATE_FILTER_S)
    world.rate_mm3_s = keep * world.rate_mm3_s + (1 - keep) * volume_mm3 / elapsed_s
    world.heat_c = world.heat_c * math.exp(-elapsed_s / HEAT_DECAY_S) + HEAT_C_PER_MM3 * volume_mm3
    world.greatest_heat_c = max(world.greatest_heat_c, world.heat_c)


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
