"""Laps of short segments: XY at constant feed, z only as deep as permitted, a queue of 120 ms.

The path runs through the points; every stretch between two of them is cut into segments of at most 40 ms. When the
first segment towards a point is written, its permission is asked for; each later one asks again, so a permission that
ends takes the rest of the way back to the depth already cut. The tip is followed along what was written: a tip off
that line by more than 20 um stops the run.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from math import ceil, floor
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from drivers.errors import DeviceError, SafetyStop
from drivers.motion.interface import MotionState, MotionStatus, Vector
from drivers.spindle.interface import SpindleStatus
from milling.eyes import Watch, Witness
from milling.hands import LIFT_MM, QUEUED_S, READ_BACK_MM, Hands
from milling.job import Job
from milling.load import LoadMeter
from milling.planner import Policy
from milling.point import Grant
from milling.spline import periodic_spline
from milling.trajectory import Trajectory

Floats = npt.NDArray[np.float64]

POLL_S = 0.04
"""What is written ahead of a tip that should run and stands still is so much more than ``QUEUED_S``."""
GLANCE_S = 0.01
SPEED_OVER_S = 0.12
LOG_S = 0.2
PAUSE_AFTER_S = 0.15
"""Frames older than this, and the drill leaves the bone."""
GIVE_UP_AFTER_S = 2.0
MOST_PAUSES = 8
"""Within one lap: eyes that are late again and again guide nothing, and each way back into the kerf is a risk."""
LONGER_BY = 1.05
"""Of a stretch, by what is milled, against the straight line between its points at depth zero."""
ENTER_FEED_MM_S = 1.0
ACROSS_FEED_MM_S = 15.0
IDLE_LAPS = 2
_TICK_S = 0.004


class Permits(Witness, Protocol):
    """Who grants depth; ``milling.permission.Ledger``, or the published systems' lack of one."""

    @property
    def open_points(self) -> list[int]:
        """Points that may still get a bite."""

    @property
    def through_share(self) -> float:
        """Share of points that are through."""

    def ask(self, index: int, *, bite_mm: float, now_s: float, frame_at_s: float) -> Grant:
        """How deep this visit may go."""

    def passed(self, index: int, *, depth_mm: float, now_s: float) -> None:
        """The tip has left the point."""

    def void(self, index: int) -> None:
        """The visit ended before the tip reached the point."""

    def felt(self, index: int, *, ratio: float | None, above_idle: bool) -> None:
        """The load of a pass that took a bite."""

    def snapshot(self, index: int) -> dict[str, Any]:
        """What a later run must know of the point, beside its depth."""

    def cut_mm(self, index: int) -> float:
        """The depth reached and confirmed."""

    def completion(self, index: int) -> float:
        """The newest completion seen."""


class Laps:
    """Mills until no point may get a bite any more."""

    def __init__(
        self,
        hands: Hands,
        watch: Watch,
        permits: Permits,
        meter: LoadMeter | None,
        policy: Policy,
        trajectory: Trajectory,
        top_z_mm: Floats,
        job: Job,
        told: Callable[["Laps"], None],
    ) -> None:
        """``top_z_mm`` (n,) is the tip height at depth zero: contact, or the start where there is no contact."""
        self._hands, self._watch, self.permits, self._meter = hands, watch, permits, meter
        self._policy, self._path, self._job, self._told = policy, trajectory.path, job, told
        self._knots, self._length = trajectory.knots_mm, trajectory.length_mm
        self.top_z_mm = top_z_mm
        self._n = trajectory.n
        # The feed is that of the tip in space: on a slope the same stretch of ring takes longer.
        knots = np.column_stack([trajectory.tip_mm[:, :2], top_z_mm])
        stretch_s = np.linalg.norm(np.diff(knots, axis=0, append=knots[:1]), axis=1) / job.feed_mm_s
        self._per_point = max(1, ceil(LONGER_BY * float(stretch_s.max()) / job.segment_s))
        self._step_s = stretch_s / self._per_point
        """(n,) from vertex to vertex on the way to the next point."""
        self._longest_step_s = float(self._step_s.max())
        self._depth = np.zeros(self._n)
        """What was commanded at each point's last or current visit."""
        self._bite = np.zeros(self._n)
        self._height: Callable[[float], Any] | None = None
        """Of the tip, by the place along the path; made anew where a depth has changed."""
        self._next = 0
        """Number of the next vertex to write, counted over all laps."""
        self._left = 0
        """Number of the next point to leave."""
        self._vertices: deque[tuple[int, Vector]] = deque(maxlen=64)
        self._at = 0.0
        self._at_s = 0.0
        self._written = (0, 0, 0.0, 0.0)
        """The vertices before and after what is written ahead, how long all of it takes, and its first step."""
        self._tip: Vector | None = None
        self._reports: deque[SpindleStatus] = deque(maxlen=512)
        self._torque = 0.0
        self._bitten = 0
        self._logged_s = float("-inf")
        self._paused_at: deque[float] = deque(maxlen=MOST_PAUSES)
        """Laps at the last pauses."""
        self._track: deque[tuple[float, float]] = deque(maxlen=64)
        """Where the tip was lately, for its speed."""

    @property
    def laps(self) -> float:
        """Laps so far."""
        return self._at / (self._n * self._per_point)

    @property
    def torque(self) -> float:
        """The newest report, for people; 0 before the first."""
        return self._torque

    def mill(self) -> bool:
        """Run laps; whether they ended because no point is open (and not because none gets a bite).

        Raises:
            Interrupted, SafetyStop, DeviceError: the tip is where it was.
        """
        self._hands.on_torque.append(self._hear)
        try:
            self._enter()
            return self._run()
        finally:
            self._hands.on_torque.remove(self._hear)

    def _hear(self, status: SpindleStatus) -> None:
        self._reports.append(status)
        self._torque = status.torque_fraction

    def _run(self) -> bool:
        clock = self._hands.clock
        polled_s = glanced_s = float("-inf")
        told_lap = floor(self.laps)
        while self.permits.open_points:
            report = self._hands.beat()
            if clock.now_s() - polled_s >= POLL_S:
                polled_s = clock.now_s()
                self._follow(self._hands.motion.status())
                self._log(report)
            if clock.now_s() - glanced_s >= GLANCE_S:
                glanced_s = clock.now_s()
                self._watch.glance(self._tip)
            if clock.now_s() - self._watch.frame_at_s > PAUSE_AFTER_S:
                self._pause()
                polled_s = glanced_s = float("-inf")
                continue
            wrote = False
            while self._ahead_s() + self._longest_step_s <= QUEUED_S:
                self._write()
                wrote = True
            if self._next - self._bitten > IDLE_LAPS * self._n * self._per_point:
                self._follow(self._hands.settle())
                return False
            if floor(self.laps) > told_lap:
                told_lap = floor(self.laps)
                self._told(self)
                if told_lap >= self._job.max_laps:
                    raise SafetyStop(f"{told_lap} laps and still open points, allowed {self._job.max_laps} (max_laps)")
            if not wrote:
                clock.sleep_s(_TICK_S)
        self._follow(self._hands.settle())
        return True

    # Writing ahead.

    def _write(self) -> None:
        number = self._next
        target = ceil(number / self._per_point)
        index = target % self._n
        bite_mm = self._policy.bite_mm(self.permits.completion(index), depth_mm=self.permits.cut_mm(index))
        now_s, frame_at_s = self._hands.clock.now_s(), self._watch.frame_at_s
        grant = self.permits.ask(index, bite_mm=bite_mm, now_s=now_s, frame_at_s=frame_at_s)
        self._hands.recorder.event(
            "asked",
            point=index + 1,
            bite_mm=bite_mm,
            frame_age_s=now_s - frame_at_s,
            depth_mm=grant.depth_mm,
            reason="" if grant.deeper else grant.reason,
        )
        if grant.deeper:
            self._bitten = number
        if self._depth[index] != grant.depth_mm:
            self._depth[index] = grant.depth_mm
            self._height = None
        self._bite[index] = grant.depth_mm - self.permits.cut_mm(index)
        vertex = self._vertex(number)
        self._hands.motion.start_move(vertex, feed_mm_per_s=self._job.feed_mm_s)
        self._vertices.append((number, vertex))
        self._next += 1

    def _vertex(self, number: int) -> Vector:
        before, part = divmod(number % (self._n * self._per_point), self._per_point)
        start = self._knots[before]
        end = self._knots[before + 1] if before + 1 < self._n else self._length
        along = start + (end - start) * part / self._per_point
        x, y = self._path(along)
        if self._height is None:
            self._height = periodic_spline(self._knots, self.top_z_mm - self._depth, self._length)
        z = self._height(along)
        return (round(float(x), 4), round(float(y), 4), round(float(z), 4))

    def _ahead_s(self) -> float:
        """How long the tip can go on by what is written; it is believed to run for ``POLL_S`` without being seen."""
        first, last = floor(self._at), self._next - 1
        if self._written[:2] != (first, last):
            ways = self._step_s[(np.arange(first, last) // self._per_point) % self._n]
            self._written = (first, last, float(ways.sum()), float(ways[0]) if len(ways) else 0.0)
        *_, whole_s, first_s = self._written
        left_s = whole_s - (self._at - first) * first_s
        return max(0.0, left_s - min(self._hands.clock.now_s() - self._at_s, POLL_S))

    # Following the tip.

    def _follow(self, status: MotionStatus) -> None:
        if status.state not in (MotionState.IDLE, MotionState.MOVING):
            raise DeviceError(f"motion: {status.state} ({status.alarm or 'no alarm'}) while milling")
        at, miss = self._nearest(status.position_mm)
        if miss > READ_BACK_MM:
            raise SafetyStop(
                f"the controller stands at {status.position_mm} mm, {miss:.3f} mm off the path it was given, "
                f"allowed {READ_BACK_MM} mm"
            )
        at = max(at, self._at)
        self._feel(at, status.time_s)
        self._at, self._at_s, self._tip = at, status.time_s, status.position_mm
        while self._left + 0.5 < at / self._per_point:
            self._leave(self._left % self._n, status.time_s)
            self._left += 1

    def _nearest(self, position: Vector) -> tuple[float, float]:
        """The place on the written line nearest to ``position``, from where the tip was last, and how far it is off."""
        best = (self._at, float("inf"))
        p = np.asarray(position)
        vertices = [(number, np.asarray(v)) for number, v in self._vertices if number >= floor(self._at) - 1]
        for (number, a), (_, b) in pairwise(vertices):
            along = b - a
            share = float(np.clip((p - a) @ along / max(float(along @ along), 1e-12), 0.0, 1.0))
            miss = float(np.linalg.norm(p - a - share * along))
            if miss < best[1] - 1e-9:
                best = (number + share, miss)
        if len(vertices) == 1:
            best = (float(vertices[0][0]), float(np.linalg.norm(p - vertices[0][1])))
        return best

    def _feel(self, at: float, time_s: float) -> None:
        """Give each torque report since the last look to the point that the ball was nearest to."""
        if self._meter is None:
            return
        span_s = time_s - self._at_s
        self._track.append((time_s, at))
        while len(self._track) > 2 and time_s - self._track[1][0] >= SPEED_OVER_S:
            self._track.popleft()
        since_s = time_s - self._track[0][0]
        step_s = float(self._step_s[floor(at / self._per_point) % self._n])
        speed = (at - self._track[0][1]) * step_s / since_s if since_s > 0 else 0.0
        while self._reports and self._reports[0].time_s <= time_s:
            report = self._reports.popleft()
            if span_s <= 0 or report.time_s <= self._at_s:
                continue
            where = (self._at + (at - self._at) * (report.time_s - self._at_s) / span_s) / self._per_point
            before = floor(where)
            share = where - before
            nearest = before + 1 if share >= 0.5 else before
            self._meter.report(nearest % self._n, report.torque_fraction, offset=where - nearest, speed=speed)

    def _leave(self, index: int, time_s: float) -> None:
        depth_mm = float(self._depth[index])
        deeper = depth_mm > self.permits.cut_mm(index)
        # First of all, for the journal that a later run goes on from: a cut cannot be taken back.
        age_s = self._hands.clock.now_s() - time_s
        self._hands.recorder.event("cut" if deeper else "left", point=index + 1, depth_mm=depth_mm, age_s=age_s)
        self.permits.passed(index, depth_mm=depth_mm, now_s=time_s)
        if self._meter is None:
            return
        feeling = self._meter.leave(
            index, bite_mm=self._bite.tolist(), depth_mm=self._depth.tolist(), freed=self.permits.through_share
        )
        if feeling is not None:
            self.permits.felt(index, ratio=feeling.ratio, above_idle=feeling.above_idle)
        if deeper:
            felt = {} if feeling is None else asdict(feeling)
            self._hands.recorder.event("pass", point=index + 1, **felt, known=self.permits.snapshot(index))

    def _log(self, report: SpindleStatus) -> None:
        """Load and place a few times a second, for the report."""
        if report.time_s - self._logged_s >= LOG_S:
            self._logged_s = report.time_s
            self._hands.recorder.event("load", torque=report.torque_fraction, rpm=report.speed_rpm, tip_mm=self._tip)

    # Leaving and entering the bone.

    def _pause(self) -> None:
        """The eyes are late: out of the bone, wait for them, and go on where the tip was."""
        self._hands.recorder.event("state", state="paused", reason="no fresh frame")
        self._follow(self._hands.settle())
        self._hands.lift(LIFT_MM)
        self._paused_at.append(self.laps)
        if len(self._paused_at) == MOST_PAUSES and self.laps - self._paused_at[0] < 1.0:
            raise SafetyStop(
                f"no fresh frame {MOST_PAUSES} times within one lap; pictures must be at most {PAUSE_AFTER_S:g} s old: "
                "check the cameras' rate and latency, and what else this machine is doing"
            )
        waited_s = self._hands.clock.now_s()
        while not self._watch.glance(None):
            self._hands.beat()
            if self._hands.clock.now_s() - waited_s > GIVE_UP_AFTER_S:
                raise SafetyStop(f"no fresh frame for {GIVE_UP_AFTER_S:g} s; check the cameras")
            self._hands.clock.sleep_s(_TICK_S)
        self._enter()

    def _enter(self) -> None:
        """Into the kerf at the depth already cut, at the vertex after the last one reached."""
        self._abandon()
        number = ceil(self._at)
        self._next = self._bitten = number
        self._depth = np.array([self.permits.cut_mm(index) for index in range(self._n)])
        self._height = None
        self._bite = np.zeros(self._n)
        x, y, z = self._vertex(number)
        top = float(np.max(self.top_z_mm)) + LIFT_MM
        position = self._hands.motion.status().position_mm
        if position[2] < top:
            self._hands.travel((position[0], position[1], top), ACROSS_FEED_MM_S)
        self._hands.travel((x, y, max(top, position[2])), ACROSS_FEED_MM_S)
        self._hands.travel((x, y, z + LIFT_MM), ACROSS_FEED_MM_S)
        status = self._hands.go((x, y, z), ENTER_FEED_MM_S)
        self._vertices.clear()
        self._vertices.append((number, (x, y, z)))
        self._next = number + 1
        self._at, self._at_s, self._tip = float(number), status.time_s, status.position_mm
        self._left = ceil(number / self._per_point)
        self._reports.clear()
        self._track.clear()
        self._track.append((self._at_s, self._at))
        self._hands.recorder.event("state", state="milling", lap=round(self.laps, 3))

    def _abandon(self) -> None:
        """Points whose visit the tip did not finish keep the depth they had."""
        points = [point % self._n for point in range(self._left, ceil(self._next / self._per_point) + 1)]
        for point in points:
            self.permits.void(point)
        self._hands.recorder.event("voided", points=[point + 1 for point in points])
