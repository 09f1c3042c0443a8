"""The one physical world that every emulated board, drive and camera shares.

What it holds: where the tip is, how fast the shaft turns, what is left of the bone, and what harm was done.

Force law (no milling forces of mouse skulls are published, so these are choices): bone goes at a rate proportional to
the axial force, 0.35 mm^3/s per N at 50,000 rpm, so that published practice (0.065 mm^2/s along the kerf) takes about
0.15 N, and about 0.3 of the rated torque. The skull is a spring under that force; what it gave way by while loaded it
takes back when the load falls, into the ball.

Left out: lateral forces and their deflection, chatter, tool wear, chips that clog, resonances, the elasticity of the
dura (a ball that reaches its plane has damaged it), bone that breaks rather than being cut (a freed flap stays in its
place), scalp and muscle as obstacles, end stops that cost steps. Heat is one lumped figure for the bone at the kerf.
"""

import math
import threading
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from firmware_sim.cutting import (
    LONGEST_STEP_MM,
    LOOK_AT_FLAP,
    NOMINAL_RATE_MM2_PER_S,
    THROUGH,
    WORLD,
    carve_balls,
    go_on,
    move,
    new_scratch,
    stay,
    torque_fraction,
)
from firmware_sim.mechanics import AxesMm
from firmware_sim.skull import Array, Skull
from firmware_sim.specimen import Specimen
from firmware_sim.truth import FREE_RING_SHARE, Truth, disc, fit_ring, read_ring

POWER_UP_TIP_MM: Final = (20.0, 0.0, 15.0)
SWITCHES_MM: Final = (25.0, 10.0, 20.0)
TRAVEL_BEYOND_SWITCH_MM: Final = 1.5
BLOCKED_TORQUE: Final = 20.0
_PATH_PIECE: Final = 4096


class ChangedBox:
    """The cells that changed since somebody last looked, one box per onlooker."""

    def __init__(self, rows: int, columns: int) -> None:
        """Everything is new at first."""
        self.bounds = (0, rows, 0, columns)

    def add(self, i0: int, i1: int, j0: int, j1: int) -> None:
        """Grow by a box; an empty one changes nothing."""
        if i1 <= i0 or j1 <= j0:
            return
        a0, a1, b0, b1 = self.bounds
        empty = a1 <= a0
        self.bounds = (i0, i1, j0, j1) if empty else (min(a0, i0), max(a1, i1), min(b0, j0), max(b1, j1))

    def take(self) -> tuple[int, int, int, int]:
        """The box, which is empty from now on."""
        bounds, self.bounds = self.bounds, (0, 0, 0, 0)
        return bounds


class Machine:
    """Implements ``Mechanics`` and ``SpindleLoad`` for the boards, and tells the truth to scorers only.

    One lock guards it, so that a renderer in another thread may copy what changed.
    """

    def __init__(self, specimen: Specimen) -> None:
        """A machine at rest at its power-up position over an untouched ``specimen``."""
        self.specimen = specimen
        self.skull = Skull(specimen)
        self.lock = threading.RLock()
        self.blocked = False
        """Whether something holds the shaft."""
        noise = np.random.default_rng([specimen.seed, specimen.rig.seed & 0x7FFFFFFF, 911])
        self._noise = noise.standard_normal(8192)
        self._worlds: Any = np.zeros(1, WORLD)
        self._world: Any = self._worlds[0]
        self._fill_in(noise.uniform(0, 2 * np.pi, 4))
        # Of each axis; views, to be changed in place.
        self.backlash_mm: Array = self._world["backlash_mm"]
        self.axis_scale: Array = self._world["axis_scale"]
        self.lost_mm: Array = self._world["lost_mm"]
        self._command: Array = self._world["command_mm"]
        self._path = np.empty((_PATH_PIECE, 2))
        self._onlookers: list[ChangedBox] = []
        skull = self.skull
        self._bone = (skull.top_z, skull.inner_z, skull.membrane_z)
        self._scratch = new_scratch()

    def _fill_in(self, phases_rad: Array) -> None:
        world, specimen, grid = self._world, self.specimen, self.skull.grid
        ball = specimen.tool.ball_radius_mm
        for name, value in {
            "x0_mm": grid.x0_mm,
            "y0_mm": grid.y0_mm,
            "step_mm": grid.step_mm,
            "highest_mm": float(self.skull.outer_z.max()),
            "power_up_mm": POWER_UP_TIP_MM,
            "end_stops_mm": [switch + TRAVEL_BEYOND_SWITCH_MM for switch in SWITCHES_MM],
            "axis_scale": 1.0,
            "ball_offset_mm": [ball * component for component in specimen.tool.axis],
            "ball_radius_mm": ball,
            # Run-out enlarges what the ball sweeps; taken as a larger ball, a little too pessimistic along the axis.
            "turning_radius_mm": ball + specimen.rig.run_out_mm,
            "stiffness_n_per_mm": specimen.mechanics.stiffness_n_per_mm,
            "flap_softening": specimen.mechanics.flap_softening,
            # At published practice, for this ball.
            "nominal_rate_mm3_s": NOMINAL_RATE_MM2_PER_S * 1.6 * ball,
            "torque_noise": specimen.spindle.torque_noise,
            "torque_ripple": specimen.spindle.torque_ripple,
            "torque_drift": specimen.spindle.torque_drift,
            "phases_rad": phases_rad,
            "backlash_mm": specimen.rig.backlash_mm,
            "command_mm": POWER_UP_TIP_MM,
            "tip_mm": POWER_UP_TIP_MM,
            "first_cut_s": math.nan,
            "touched_at_s": math.nan,
            "overrun_mm": -math.inf,
        }.items():
            world[name] = value

    # What the boards call.

    def move_to(self, time_s: float, axes_mm: AxesMm) -> None:
        """The motors stand at ``axes_mm``, relative to power-up, from ``time_s`` on."""
        with self.lock:
            self._let_go_on(move(self._worlds, *self._bone, self._path, self._scratch, time_s, *axes_mm))

    def turn(self, time_s: float, speed_rpm: float) -> None:
        """The shaft turns at ``speed_rpm`` from ``time_s`` on."""
        with self.lock:
            self._let_go_on(stay(self._worlds, *self._bone, self._path, self._scratch, time_s))
            self._world["spindle_rpm"] = speed_rpm

    def advance_to(self, time_s: float) -> None:
        """Let the world go on until ``time_s`` with the motors where they stand."""
        with self.lock:
            self._let_go_on(stay(self._worlds, *self._bone, self._path, self._scratch, time_s))

    def limit_switches(self) -> tuple[bool, bool, bool]:
        """Home switches at the far corner of the travel."""
        x, y, z = self._command.tolist()
        return x >= SWITCHES_MM[0], y >= SWITCHES_MM[1], z >= SWITCHES_MM[2]

    def probe_closed(self) -> bool:
        """No probe is wired."""
        return False

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        """Share of the rated torque: idle, what the cut takes, ripple of the shaft, noise and drift."""
        if self.blocked:
            return BLOCKED_TORQUE
        if abs(speed_rpm) < 1.0:
            return 0.0
        return torque_fraction(self._worlds, self._noise, time_s, speed_rpm)

    # What the pictures are made from.

    @property
    def now_s(self) -> float:
        """How far time has come."""
        return float(self._world["now_s"])

    @property
    def spindle_rpm(self) -> float:
        """Of the shaft."""
        return float(self._world["spindle_rpm"])

    @property
    def turns(self) -> float:
        """Of the shaft, since power-up."""
        return float(self._world["turns"])

    @turns.setter
    def turns(self, turns: float) -> None:
        self._world["turns"] = turns

    @property
    def velocity_mm_s(self) -> AxesMm:
        """Of the tip."""
        x, y, z = self._world["velocity_mm_s"].tolist()
        return x, y, z

    @property
    def deflection_mm(self) -> float:
        """What the skull gives way by."""
        return float(self._world["deflection_mm"])

    @property
    def force_n(self) -> float:
        """What it gives way to, along the axis of the drill."""
        return float(self._world["force_n"])

    @property
    def first_cut_s(self) -> float | None:
        """When bone was removed first."""
        return _known(self._world["first_cut_s"])

    @property
    def tip_mm(self) -> Array:
        """True position of the tip in {R}, with backlash, without run-out."""
        return np.array(self._world["tip_mm"])

    @property
    def command_mm(self) -> Array:
        """Where the motors think the tip is, in {R}."""
        return np.array(self._command)

    @property
    def ball_center_mm(self) -> Array:
        """True centre of the ball in {R}."""
        return np.asarray(self._world["tip_mm"] + self._world["ball_offset_mm"])

    @property
    def nominal_rate_mm3_s(self) -> float:
        """Bone removed per second at published practice, for this ball."""
        return float(self._world["nominal_rate_mm3_s"])

    @property
    def removal_rate_mm3_s(self) -> float:
        """Bone removed per second, now."""
        return float(self._world["rate_mm3_s"])

    def watch(self) -> ChangedBox:
        """A box that grows with every cut from now on."""
        box = ChangedBox(self.skull.grid.rows, self.skull.grid.columns)
        with self.lock:
            self._onlookers.append(box)
        return box

    # What makers of training pictures call: no time passes, no force acts.

    def carve(self, path_xy_mm: npt.ArrayLike, depth_mm: npt.ArrayLike, *, closed: bool = True) -> None:
        """Remove a kerf: the ball's lowest point runs along ``path_xy_mm`` (n, 2).

        ``depth_mm``, one number or (n,), is measured down from the outer surface.

        A depth of zero or less leaves the bone untouched there. No harm to the membrane is recorded.
        """
        path = np.asarray(path_xy_mm, float)
        depth = np.broadcast_to(np.asarray(depth_mm, float), len(path))
        points = np.column_stack([path, depth])
        if closed:
            points = np.vstack([points, points[:1]])
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])
        at = np.linspace(0.0, length[-1], max(2, int(length[-1] / LONGEST_STEP_MM) + 1))
        x, y, d = (np.interp(at, length, points[:, k]) for k in range(3))
        outer = self.skull.grid.sample(self.skull.outer_z, x, y)
        radius = float(self._world["turning_radius_mm"])
        keep = np.isfinite(outer) & (d > 0)
        balls = np.column_stack([x, y, outer - d + radius])[keep]
        if not len(balls):
            return
        grid = self.skull.grid
        with self.lock:
            carve_balls(self.skull.top_z, grid.x0_mm, grid.y0_mm, grid.step_mm, balls, radius)
            low, high = balls[:, :2].min(axis=0) - radius, balls[:, :2].max(axis=0) + radius
            self._mark(*self._cells(low[0], high[0], grid.x0_mm), *self._cells(low[1], high[1], grid.y0_mm))
            cut = self._cut_path
            self._path = np.vstack([cut, balls[:, :2], np.empty((_PATH_PIECE, 2))])
            self._world["path_length"] = len(cut) + len(balls)

    def restore_bone(self) -> None:
        """Undo every cut."""
        with self.lock:
            self.skull.top_z[:] = self.skull.outer_z
            self._mark(0, self.skull.grid.rows, 0, self.skull.grid.columns)
            self._world["path_length"] = 0
            self._world["freed"] = 0.0

    def set_tip(self, tip_mm: Sequence[float] | Array) -> None:
        """Put the tip there at once."""
        with self.lock:
            x, y, z = (float(value) for value in tip_mm)
            self._world["command_mm"] = self._world["tip_mm"] = (x, y, z)
            self._world["velocity_mm_s"] = 0.0

    def set_spindle(self, speed_rpm: float) -> None:
        """Let the shaft turn at once."""
        with self.lock:
            self._world["spindle_rpm"] = speed_rpm

    # What a scorer asks.

    def completion_at(self, points_mm: npt.ArrayLike, *, search_mm: float = 0.0) -> Array:
        """Share of the local thickness removed at each (x, y) of ``points_mm`` (n, 2 or more).

        With ``search_mm``, the greatest within that distance: the kerf's own centre line, where the trajectory's aim
        and the tip differ.
        """
        xy = np.asarray(points_mm, float)[:, :2]
        offsets = disc(search_mm)
        around = xy[:, None, :] + offsets[None, :, :]
        return np.asarray(self.skull.completion_at(around[..., 0], around[..., 1]).max(axis=1))

    def truth(self, center_xy_mm: Sequence[float] | None = None, radius_mm: float | None = None, n: int = 360) -> Truth:
        """The state of the ring; without a ring told, the circle that fits what was cut."""
        with self.lock:
            world = self._world
            center, radius = self._ring()
            if center_xy_mm is not None:
                center = np.asarray(center_xy_mm, float)[:2]
            if radius_mm is not None:
                radius = radius_mm
            ring = read_ring(self.skull, center, radius, n)
            return Truth(
                center_mm=(float(center[0]), float(center[1])),
                radius_mm=float(radius),
                angles_rad=ring.angles_rad,
                completion=ring.completion,
                remaining_mm=ring.remaining_mm,
                depth_mm=ring.depth_mm,
                flap_free=ring.freed_share >= FREE_RING_SHARE,
                membrane_touched=not np.isnan(world["touched_at_s"]),
                membrane_touched_at_s=_known(world["touched_at_s"]),
                membrane_touched_mm=None if np.isnan(world["touched_at_s"]) else tuple(world["touched_mm"].tolist()),
                membrane_overrun_mm=max(0.0, float(world["overrun_mm"])),
                heat_rise_c=float(world["greatest_heat_c"]),
                greatest_force_n=float(world["greatest_force_n"]),
            )

    # How time passes.

    def _let_go_on(self, told: int) -> None:
        """The rest of what ``told`` says has begun."""
        world = self._world
        while told != THROUGH:
            if told == LOOK_AT_FLAP:
                world["freed"] = read_ring(self.skull, *self._ring(), 64).freed_share
            else:
                self._path = np.vstack([self._path, np.empty((_PATH_PIECE, 2))])
            told = go_on(self._worlds, *self._bone, self._path, self._scratch)
        if self._onlookers and world["i1"]:
            self._mark(int(world["i0"]), int(world["i1"]), int(world["j0"]), int(world["j1"]))

    def _mark(self, i0: int, i1: int, j0: int, j1: int) -> None:
        for box in self._onlookers:
            box.add(i0, i1, j0, j1)

    def _cells(self, low_mm: float, high_mm: float, origin_mm: float) -> tuple[int, int]:
        step, count = self.skull.grid.step_mm, self.skull.grid.rows
        return max(0, math.floor((low_mm - origin_mm) / step)), min(count, math.ceil((high_mm - origin_mm) / step) + 1)

    def _ring(self) -> tuple[Array, float]:
        return fit_ring(self._cut_path, np.array(self.specimen.skull.center_mm[:2]))

    @property
    def _cut_path(self) -> Array:
        """(n, 2) where the ball cut."""
        return self._path[: self._world["path_length"]]


def _known(time_s: float) -> float | None:
    return None if np.isnan(time_s) else float(time_s)
