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
from typing import Final

import numpy as np
import numpy.typing as npt

from firmware_sim.cutting import carve_balls, mill_step, new_scratch
from firmware_sim.mechanics import AxesMm
from firmware_sim.skull import Array, Skull
from firmware_sim.specimen import Specimen
from firmware_sim.truth import FREE_RING_SHARE, Truth, disc, fit_ring, read_ring

POWER_UP_TIP_MM: Final = (20.0, 0.0, 15.0)
SWITCHES_MM: Final = (25.0, 10.0, 20.0)
TRAVEL_BEYOND_SWITCH_MM: Final = 1.5
CUTS_ABOVE_RPM: Final = 10_000.0
NOMINAL_RPM: Final = 50_000.0
REMOVAL_MM3_PER_S_N: Final = 0.35
NOMINAL_RATE_MM2_PER_S: Final = 0.065
IDLE_TORQUE: Final = 0.08
NOMINAL_TORQUE: Final = 0.22
BLOCKED_TORQUE: Final = 20.0
RATE_FILTER_S: Final = 0.008
HEAT_C_PER_MM3: Final = 22.0
HEAT_DECAY_S: Final = 8.0
LONGEST_STEP_MM: Final = 0.02
LONGEST_STEP_S: Final = 0.002
FLAP_PERIOD_S: Final = 0.25


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
        self.backlash_mm = np.full(3, specimen.rig.backlash_mm)
        self.axis_scale = np.ones(3)
        self.lost_mm = np.zeros(3)
        self.blocked = False
        """Whether something holds the shaft."""
        self.now_s = 0.0
        self.spindle_rpm = 0.0
        self.turns = 0.0
        self.deflection_mm = 0.0
        self.force_n = 0.0
        self.velocity_mm_s: AxesMm = (0.0, 0.0, 0.0)
        self._command: AxesMm = POWER_UP_TIP_MM
        self._tip: AxesMm = POWER_UP_TIP_MM
        ball = specimen.tool.ball_radius_mm
        self._ball_offset = tuple(ball * component for component in specimen.tool.axis)
        # Run-out enlarges what the ball sweeps; taken as a larger ball, a little too pessimistic along the axis.
        self._turning_radius_mm = ball + specimen.rig.run_out_mm
        self._scratch = new_scratch()
        self._highest = float(self.skull.outer_z.max())
        self._onlookers: list[ChangedBox] = []
        self._rate_mm3_s = 0.0
        self.first_cut_s: float | None = None
        self._heat_c = 0.0
        self._greatest_heat_c = 0.0
        self._greatest_force_n = 0.0
        self._freed = 0.0
        self._flap_checked_s = 0.0
        self._path: list[tuple[float, float]] = []
        self._overrun_mm = -math.inf
        self._touched_at_s: float | None = None
        self._touched_mm: tuple[float, float, float] | None = None
        noise = np.random.default_rng([specimen.seed, specimen.rig.seed & 0x7FFFFFFF, 911])
        self._noise = noise.standard_normal(8192)
        self._phases = noise.uniform(0, 2 * np.pi, 4)

    # What the boards call.

    def move_to(self, time_s: float, axes_mm: AxesMm) -> None:
        """The motors stand at ``axes_mm``, relative to power-up, from ``time_s`` on."""
        with self.lock:
            x, y, z = (
                min(start + float(axis * scale + lost), switch + TRAVEL_BEYOND_SWITCH_MM)
                for start, axis, scale, lost, switch in zip(
                    POWER_UP_TIP_MM, axes_mm, self.axis_scale, self.lost_mm, SWITCHES_MM, strict=True
                )
            )
            self._run(time_s, (x, y, z))

    def turn(self, time_s: float, speed_rpm: float) -> None:
        """The shaft turns at ``speed_rpm`` from ``time_s`` on."""
        with self.lock:
            self._run(time_s, self._command)
            self.spindle_rpm = speed_rpm

    def advance_to(self, time_s: float) -> None:
        """Let the world go on until ``time_s`` with the motors where they stand."""
        with self.lock:
            self._run(time_s, self._command)

    def limit_switches(self) -> tuple[bool, bool, bool]:
        """Home switches at the far corner of the travel."""
        x, y, z = (a >= b for a, b in zip(self._command, SWITCHES_MM, strict=True))
        return x, y, z

    def probe_closed(self) -> bool:
        """No probe is wired."""
        return False

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        """Share of the rated torque: idle, what the cut takes, ripple of the shaft, noise and drift."""
        if self.blocked:
            return BLOCKED_TORQUE
        if abs(speed_rpm) < 1.0:
            return 0.0
        signal = self.specimen.spindle
        cutting = NOMINAL_TORQUE * self._rate_mm3_s / self.nominal_rate_mm3_s
        if 0 < abs(speed_rpm) < NOMINAL_RPM:
            cutting *= NOMINAL_RPM / max(abs(speed_rpm), CUTS_ABOVE_RPM)
        angle = 2 * np.pi * (self.turns + (time_s - self.now_s) * speed_rpm / 60.0)
        ripple = math.sin(angle + self._phases[0]) + 0.5 * math.sin(2 * angle + self._phases[1])
        noise = self._noise[(math.floor(time_s * 100.0 + 1e-6) * 2654435761 >> 7) % self._noise.size]
        drift = signal.torque_drift * time_s / 60.0
        wander = 0.3 * signal.torque_drift * math.sin(2 * np.pi * time_s / 47.0 + self._phases[2])
        share = signal.torque_noise * noise + signal.torque_ripple * ripple + drift + wander
        return max(0.0, float(IDLE_TORQUE + cutting + NOMINAL_TORQUE * share))

    # What the pictures are made from.

    @property
    def tip_mm(self) -> Array:
        """True position of the tip in {R}, with backlash, without run-out."""
        return np.array(self._tip)

    @property
    def command_mm(self) -> Array:
        """Where the motors think the tip is, in {R}."""
        return np.array(self._command)

    @property
    def ball_center_mm(self) -> Array:
        """True centre of the ball in {R}."""
        return np.array([a + b for a, b in zip(self._tip, self._ball_offset, strict=True)])

    @property
    def nominal_rate_mm3_s(self) -> float:
        """Bone removed per second at published practice, for this ball."""
        return NOMINAL_RATE_MM2_PER_S * 1.6 * self.specimen.tool.ball_radius_mm

    @property
    def removal_rate_mm3_s(self) -> float:
        """Bone removed per second, now."""
        return self._rate_mm3_s

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
        radius = self._turning_radius_mm
        keep = np.isfinite(outer) & (d > 0)
        balls = np.column_stack([x, y, outer - d + radius])[keep]
        if not len(balls):
            return
        grid = self.skull.grid
        with self.lock:
            carve_balls(self.skull.top_z, grid.x0_mm, grid.y0_mm, grid.step_mm, balls, radius)
            low, high = balls[:, :2].min(axis=0) - radius, balls[:, :2].max(axis=0) + radius
            self._mark(*self._cells(low[0], high[0], grid.x0_mm), *self._cells(low[1], high[1], grid.y0_mm))
            self._path.extend(zip(x[keep], y[keep], strict=True))

    def restore_bone(self) -> None:
        """Undo every cut."""
        with self.lock:
            self.skull.top_z[:] = self.skull.outer_z
            self._mark(0, self.skull.grid.rows, 0, self.skull.grid.columns)
            self._path.clear()
            self._freed = 0.0

    def set_tip(self, tip_mm: Sequence[float] | Array) -> None:
        """Put the tip there at once."""
        with self.lock:
            x, y, z = (float(value) for value in tip_mm)
            self._command = self._tip = (x, y, z)
            self.velocity_mm_s = (0.0, 0.0, 0.0)

    def set_spindle(self, speed_rpm: float) -> None:
        """Let the shaft turn at once."""
        with self.lock:
            self.spindle_rpm = speed_rpm

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
                membrane_touched=self._touched_at_s is not None,
                membrane_touched_at_s=self._touched_at_s,
                membrane_touched_mm=self._touched_mm,
                membrane_overrun_mm=max(0.0, self._overrun_mm),
                heat_rise_c=self._greatest_heat_c,
                greatest_force_n=self._greatest_force_n,
            )

    # How time passes.

    def _run(self, time_s: float, target_mm: AxesMm) -> None:
        """Straight from the last command to ``target_mm``, which is reached at ``time_s``."""
        elapsed = max(0.0, time_s - self.now_s)
        start = self._command
        if elapsed == 0.0 and target_mm == start:
            return
        distance = math.dist(start, target_mm)
        before = self._tip
        if self._in_reach(min(start[2], target_mm[2])):
            # The small allowance keeps a tick of exactly the longest step in one piece.
            n = max(1, math.ceil(distance / LONGEST_STEP_MM - 1e-3), math.ceil(elapsed / LONGEST_STEP_S - 1e-3))
            if distance == 0.0 and self.deflection_mm == 0.0:
                n = min(n, 5)
            for k in range(1, n + 1):
                self._follow(*(a + (b - a) * (k / n) for a, b in zip(start, target_mm, strict=True)))
                self._cut(self.now_s + elapsed * k / n, elapsed / n)
        else:
            self._follow(*target_mm)
            self.deflection_mm = self.force_n = 0.0
            self._settle(0.0, elapsed)
        self._command = target_mm
        if elapsed > 0.0:
            x, y, z = ((b - a) / elapsed for a, b in zip(before, self._tip, strict=True))
            self.velocity_mm_s = (x, y, z)
        self.turns += self.spindle_rpm / 60.0 * elapsed
        self.now_s += elapsed

    def _in_reach(self, lowest_tip_z_mm: float) -> bool:
        lowest = lowest_tip_z_mm + self._ball_offset[2] - self._turning_radius_mm
        return lowest - float(self.backlash_mm[2]) < self._highest

    def _follow(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """The table lags within the play of each axis."""
        px, py, pz = (0.5 * float(play) for play in self.backlash_mm)
        x, y, z = self._tip
        self._tip = (
            min(max(x, x_mm - px), x_mm + px),
            min(max(y, y_mm - py), y_mm + py),
            min(max(z, z_mm - pz), z_mm + pz),
        )

    def _cut(self, time_s: float, elapsed_s: float) -> None:
        grid, skull = self.skull.grid, self.skull
        cuts = abs(self.spindle_rpm) > CUTS_ABOVE_RPM
        radius = self._turning_radius_mm if cuts else self.specimen.tool.ball_radius_mm
        stiffness = self.specimen.mechanics.stiffness_n_per_mm * (
            1.0 - self.specimen.mechanics.flap_softening * self._freed
        )
        capacity = REMOVAL_MM3_PER_S_N * abs(self.spindle_rpm) / NOMINAL_RPM * elapsed_s if cuts else 0.0
        x, y, z = (a + b for a, b in zip(self._tip, self._ball_offset, strict=True))
        ball = (x, y, z)
        deflection, volume, below, i, j, *changed = mill_step(
            skull.top_z, skull.inner_z, skull.membrane_z, grid.x0_mm, grid.y0_mm, grid.step_mm, ball, radius,
            stiffness, capacity, *self._scratch,
        )  # fmt: skip
        self.deflection_mm = deflection
        self.force_n = stiffness * deflection
        self._greatest_force_n = max(self._greatest_force_n, self.force_n)
        self._overrun_mm = max(self._overrun_mm, below)
        if below > 0.0 and self._touched_at_s is None:
            self._touched_at_s = time_s
            at = float(skull.membrane_z[i, j])
            self._touched_mm = (grid.x0_mm + i * grid.step_mm, grid.y0_mm + j * grid.step_mm, at)
        if volume > 0.0:
            if self.first_cut_s is None:
                self.first_cut_s = time_s
            self._mark(*changed)
            if not self._path or math.dist(self._path[-1], ball[:2]) > LONGEST_STEP_MM:
                self._path.append(ball[:2])
        self._settle(volume, elapsed_s)
        if time_s - self._flap_checked_s > FLAP_PERIOD_S and len(self._path) > 50:
            self._flap_checked_s = time_s
            self._freed = read_ring(skull, *self._ring(), 64).freed_share

    def _settle(self, volume_mm3: float, elapsed_s: float) -> None:
        """Filtered removal rate, and heat."""
        if elapsed_s <= 0.0:
            return
        keep = math.exp(-elapsed_s / RATE_FILTER_S)
        self._rate_mm3_s = keep * self._rate_mm3_s + (1 - keep) * volume_mm3 / elapsed_s
        self._heat_c = self._heat_c * math.exp(-elapsed_s / HEAT_DECAY_S) + HEAT_C_PER_MM3 * volume_mm3
        self._greatest_heat_c = max(self._greatest_heat_c, self._heat_c)

    def _mark(self, i0: int, i1: int, j0: int, j1: int) -> None:
        for box in self._onlookers:
            box.add(i0, i1, j0, j1)

    def _cells(self, low_mm: float, high_mm: float, origin_mm: float) -> tuple[int, int]:
        step, count = self.skull.grid.step_mm, self.skull.grid.rows
        return max(0, math.floor((low_mm - origin_mm) / step)), min(count, math.ceil((high_mm - origin_mm) / step) + 1)

    def _ring(self) -> tuple[Array, float]:
        return fit_ring(self._path, np.array(self.specimen.skull.center_mm[:2]))
