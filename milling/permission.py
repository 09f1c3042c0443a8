"""Who may go deeper: a ledger of evidence per trajectory point.

The default is inverted: no evidence, no descent. Each permission is one bite at one visit of one point, measured from
that point's own contact, and it needs all of

- a frame at most ``frame_age_s`` old (the eyes are alive),
- a picture of this very point taken after its last pass, whose upper bound of completion is below the threshold,
- a spindle load above idle at its last biting pass (the contact itself stands for the first bites),
- depth within the thickness prior and near that of its neighbours.

One cue that says "through" stops the point. A load that droops once, under a picture of bone, is a doubt: the next
bite is a small one, and a second droop stops. Past the low end of the thickness prior load above idle is not enough: it
must have been weighed against what bone takes. What is stopped goes on only after a look with the drill lifted, and
only by a bounded amount, in which the other cue has to prove wrong the one that stopped it.

A point is through where the load says so and the picture does not contradict. The picture alone is not believed: thin
bone, blood and glare look like holes too, and bridges would be left.

Standard library only, no clock, no device: every rule here can be read and tested by itself.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf

from drivers.errors import SafetyStop
from milling.limits import Limits

_ROUNDING_MM = 1e-6


class PointState(StrEnum):
    """Where a point stands."""

    OPEN = "open"
    STOPPED = "stopped"
    """One cue says "through", or a limit was met: no bite until a look with the drill lifted."""
    DONE = "done"
    """Latched: it never opens again."""


@dataclass(frozen=True)
class Grant:
    """The depth that one visit may reach, below contact, and why it is no deeper."""

    depth_mm: float
    deeper: bool
    reason: str


@dataclass
class Point:
    """The evidence about one point. Depths are below its own contact."""

    contacted: bool = False
    cut_mm: float = 0.0
    granted_mm: float | None = None
    last_pass_s: float = float("-inf")
    seen_at_s: float = float("-inf")
    upper: float | None = None
    completion: float = 0.0
    load_ratio: float | None = None
    load_above_idle: bool = False
    doubt: bool = False
    unheard_mm: float = 0.0
    """Depth gained since a pass was last weighed."""
    frames_through: int = 0
    picture_through: bool = False
    load_through: bool = False
    picture_said_mm: float | None = None
    """Where the picture first said "through"."""
    on_trial: bool = False
    """While the load, weighed at every pass, judges a picture that says "through"."""
    state: PointState = PointState.OPEN
    why: str = "no contact yet"
    looks: int = 0
    load_lost_mm: float | None = None
    """Where the load first said "through", until both cues refute it."""
    looked_at_mm: float = -1.0
    allowance_mm: float | None = None
    """While re-opened: the depth that the last look allows."""
    verdicts: Counter[str] = field(default_factory=Counter)


class Ledger:
    """The evidence about every point of a closed ring."""

    def __init__(self, n_points: int, limits: Limits) -> None:
        self.limits = limits
        self.points = [Point() for _ in range(n_points)]

    def touched(self, index: int) -> None:
        """The point's contact is found: depth counts from here, and the touch is the first load above idle."""
        point = self.points[index]
        point.contacted = True
        point.load_above_idle = True
        point.why = "contact found"

    def seen(self, index: int, *, completion: float, upper: float, exposed_at_s: float) -> None:
        """A frame shows the point. Pictures older than what is known, or not of this world, are ignored."""
        point = self.points[index]
        if not (0.0 <= completion <= 1.0 and completion <= upper <= 1.0) or exposed_at_s <= point.seen_at_s:
            return
        point.seen_at_s = exposed_at_s
        point.upper = upper
        point.completion = max(point.completion, completion) if point.picture_through else completion
        if point.on_trial:
            return
        # A re-opened point has its bound from a better look than this one: only a hole that is seen stops it.
        says = upper if point.allowance_mm is None else completion
        point.frames_through = point.frames_through + 1 if says >= self.limits.threshold else 0
        if point.frames_through >= 2 and not point.picture_through:
            self._picture_says_through(point)

    def felt(self, index: int, *, ratio: float | None, above_idle: bool) -> None:
        """The spindle load of a pass that took a bite here.

        Args:
            index: the point, counted from 0.
            ratio: load against what bone takes; None while too little bone was cut to know that.
            above_idle: whether there was any load at all.
        """
        point = self.points[index]
        if ratio is not None:
            before = 1.0 if point.load_ratio is None else point.load_ratio
            # More load than bone takes is no more bone: it must not hide the droop that follows.
            point.load_ratio = before + self.limits.newest * (min(ratio, 1.0) - before)
            point.unheard_mm = 0.0
        point.load_above_idle = above_idle or point.cut_mm <= self.limits.entry_mm
        if not point.load_above_idle:
            self._stop_by_load(point)
        elif ratio is not None and point.cut_mm > self.limits.thickness_low_mm - self.limits.prior_slack_mm:
            self._weigh(point)

    def ask(self, index: int, *, bite_mm: float, now_s: float, frame_at_s: float) -> Grant:
        """How deep the tip may go at this visit. Asking again within one visit never adds to it."""
        point = self.points[index]
        grant = self._judge(index, bite_mm, now_s, frame_at_s)
        if grant.deeper:
            if point.granted_mm is None:
                point.verdicts["bite"] += 1
            point.granted_mm = grant.depth_mm
        elif point.granted_mm is None:
            point.verdicts[grant.reason] += 1
        return grant

    def passed(self, index: int, *, depth_mm: float, now_s: float) -> None:
        """The tip has left the point, read back, having reached ``depth_mm``; the permission ends.

        Raises:
            SafetyStop: deeper than was permitted.
        """
        point = self.points[index]
        permitted = point.cut_mm if point.granted_mm is None else point.granted_mm
        point.granted_mm = None
        point.last_pass_s = now_s
        if depth_mm > permitted + _ROUNDING_MM:
            raise SafetyStop(
                f"point {index + 1} was cut to {depth_mm:.4f} mm below contact, permitted were {permitted:.4f} mm"
            )
        if depth_mm > point.cut_mm:
            point.unheard_mm += depth_mm - point.cut_mm
            point.cut_mm = depth_mm

    def stall(self) -> None:
        """No point got a bite for long: those that are open wait for a look."""
        for point in self.points:
            if point.state is PointState.OPEN:
                waits = [reason for reason in point.verdicts if reason != "bite"]
                self._stop(point, f"got no bite ({waits[-1] if waits else 'nothing asked'})")

    def look(self, index: int) -> PointState:
        """Judge a stopped point by what the lifted drill shows: finish it, or re-open it by a bounded amount.

        Call it after ``seen`` with frames taken while nothing hid the point.
        """
        point, limits = self.points[index], self.limits
        if point.state is PointState.DONE:
            return point.state
        picture = point.upper is not None and point.upper >= limits.threshold
        # A load that vanishes under a picture of thick bone speaks of the contact or of a ridge beside it, not of holes
        plausible = picture or point.completion >= limits.agrees
        behind_mm = self._shallower_neighbour_mm(index) - point.cut_mm
        if point.load_through and plausible and behind_mm <= limits.notch_mm:
            self._finish(point, "picture and load agree: through" if picture else "the load says through")
        elif point.looks > 0 and plausible and self._below_finished_neighbours(index):
            self._finish(point, "deeper than its finished neighbours, and the picture agrees")
        elif picture and self._tried(point) and max(self.shallow_mm(index), 2 * behind_mm) <= limits.felt_mm:
            self._finish(point, "the picture says through all along, and its neighbours were felt to be")
        elif point.looks >= limits.looks:
            self._stop(point, "the cues disagree after every look")
        elif point.state is PointState.STOPPED:
            # The load against the neighbours' depth, or the picture against their depth or what was felt there.
            refuted = behind_mm > limits.notch_mm if point.load_through else 2 * behind_mm > limits.felt_mm
            if refuted or (limits.felt_mm < self.shallow_mm(index) < inf and not point.load_through):
                self._forget(point)
            self._reopen(point, picture=picture)
        return point.state

    def void(self, index: int) -> None:
        """The visit ended before the tip reached the point: its permission is gone, its depth what it was."""
        self.points[index].granted_mm = None

    def cut_mm(self, index: int) -> float:
        """Depth below contact that the tip reached, read back."""
        return self.points[index].cut_mm

    def completion(self, index: int) -> float:
        """The newest completion seen."""
        return self.points[index].completion

    def shallow_mm(self, index: int) -> float:
        """How much shallower a point is than its nearest neighbours on both sides that were felt to be through.

        Between the two the straight line counts; infinite where nothing was felt within a quarter of the ring.
        """
        n, felt = len(self.points), []
        for step in (-1, 1):
            near = ((far, self.points[(index + step * far) % n]) for far in range(1, n // 4 + 1))
            felt += [next(((far, p.cut_mm) for far, p in near if p.state is PointState.DONE and p.load_through), None)]
        sides = [side for side in felt if side is not None]
        if not sides:
            return inf
        depth_mm = sum(cut_mm / far for far, cut_mm in sides) / sum(1 / far for far, _ in sides)
        return depth_mm - self.points[index].cut_mm

    @property
    def through_share(self) -> float:
        """Share of points that any cue says are through."""
        through = [point.picture_through or point.load_through for point in self.points]
        return sum(through) / len(through)

    @property
    def open_points(self) -> list[int]:
        """Indices that may still get a bite."""
        return [index for index, point in enumerate(self.points) if point.state is PointState.OPEN]

    @property
    def done(self) -> bool:
        """Whether every point is latched."""
        return all(point.state is PointState.DONE for point in self.points)

    def _judge(self, index: int, bite_mm: float, now_s: float, frame_at_s: float) -> Grant:
        point, limits = self.points[index], self.limits

        def no(reason: str) -> Grant:
            return Grant(point.cut_mm, False, reason)

        if point.state is not PointState.OPEN:
            return no(point.why)
        if not point.contacted:
            return no("no contact yet")
        if not bite_mm > 0:
            return no("no bite asked")
        if not 0.0 <= now_s - frame_at_s <= limits.frame_age_s:
            return no("no fresh frame")
        if point.upper is None or point.seen_at_s <= point.last_pass_s:
            return no("not seen since its last pass")
        reopened = point.allowance_mm is not None
        if point.upper >= limits.threshold and not reopened:
            if point.picture_through:
                return self._stop(point, "the picture says through")
            return no("the picture may say through")
        if not point.load_above_idle:
            return no("no load at the last pass")
        depth = point.cut_mm + min(bite_mm, self._bite_limit(point))
        if point.allowance_mm is not None and depth > point.allowance_mm + _ROUNDING_MM:
            return self._stop(point, "the allowance of the last look is used up")
        if depth > limits.thickness_high_mm:
            return self._stop(point, "the high end of the thickness prior is reached")
        unheard = point.unheard_mm + depth - point.cut_mm
        if depth > limits.thickness_low_mm and unheard > limits.unheard_mm + _ROUNDING_MM:
            return self._stop(point, "past the low end of the thickness prior, and its load is not known")
        if depth > self._shallower_neighbour_mm(index) + limits.neighbour_mm:
            return no("waits for its neighbours")
        return Grant(depth, True, "bone")

    def _bite_limit(self, point: Point) -> float:
        limits = self.limits
        late = point.cut_mm + limits.bite_mm > limits.thickness_low_mm - limits.late_margin_mm
        if point.upper is not None:
            # The picture's share of what bone may remain, taken at the thinnest bone of the prior.
            late = late or (1.0 - point.upper) * limits.thickness_low_mm < limits.late_margin_mm
        return limits.late_bite_mm if late or point.allowance_mm is not None else limits.bite_mm

    def _return_mm(self, point: Point) -> float:
        """What a look gives back: the picture's best estimate of the bone left, and a little.

        Against the load it gives back only that little: bites enough to tell bone from a hole.
        """
        if point.load_through:
            return self.limits.reopen_mm
        left_mm = point.cut_mm * (1.0 - point.completion) / max(point.completion, 0.1)
        return min(left_mm + self.limits.reopen_mm, self.limits.most_reopen_mm)

    def _shallower_neighbour_mm(self, index: int) -> float:
        """Bone does not change its thickness from one point to the next, so depths that part tell of a wrong cue.

        And a ball that digs beside a ridge cuts into its flank: the load there says nothing about the bone below.
        """
        n = len(self.points)
        return min(self.points[(index - 1) % n].cut_mm, self.points[(index + 1) % n].cut_mm)

    def _below_finished_neighbours(self, index: int) -> bool:
        """Whether both neighbours are through and the point is so much deeper that they would keep it waiting."""
        n = len(self.points)
        near = (self.points[(index - 1) % n], self.points[(index + 1) % n])
        depth = self.points[index].cut_mm + self.limits.late_bite_mm
        return all(point.state is PointState.DONE for point in near) and (
            depth > self._shallower_neighbour_mm(index) + self.limits.neighbour_mm
        )

    def _picture_says_through(self, point: Point) -> None:
        """Stop, or let a load that was weighed just now, and is that of bone, judge the picture."""
        point.picture_through = True
        if point.picture_said_mm is None:
            point.picture_said_mm = point.cut_mm
        weighed = point.load_ratio is not None and point.unheard_mm < 0.5 * self.limits.unheard_mm
        deep = point.cut_mm > self.limits.thickness_low_mm - self.limits.prior_slack_mm
        if point.doubt:
            self._stop_by_load(point)
        elif weighed and deep and point.state is PointState.OPEN and point.allowance_mm is None:
            self._try(point)
        else:
            self._stop(point, "the picture says through")

    def _tried(self, point: Point) -> bool:
        """Whether a trial of what the picture says is used up, or nothing more can be weighed in it."""
        said_mm, limits = point.picture_said_mm, self.limits
        used_up = said_mm is not None and point.cut_mm > said_mm + limits.trial_mm - limits.late_bite_mm
        return used_up or (point.looks > 0 and point.unheard_mm > limits.unheard_mm - limits.late_bite_mm)

    @staticmethod
    def _forget(point: Point) -> None:
        """Its neighbours were cut, or felt to be through, much deeper: what stopped the point is tried anew."""
        point.picture_said_mm = point.load_lost_mm = point.load_ratio = None
        point.load_through = point.doubt = False
        point.unheard_mm = 0.0

    def _try(self, point: Point) -> None:
        """A bounded way on, on which only the load can stop the point."""
        limits = self.limits
        assert point.picture_said_mm is not None
        point.on_trial = True
        point.allowance_mm = min(point.picture_said_mm + limits.trial_mm, limits.thickness_high_mm)

    def _weigh(self, point: Point) -> None:
        """What the newest load ratio says of a point deep enough to be through."""
        limits, load = self.limits, point.load_ratio
        assert load is not None
        hole = point.picture_through or (point.upper is not None and point.upper >= limits.threshold)
        if load >= limits.whole:
            point.doubt = False
            if not hole:
                # Both cues refute what stopped the point, if it was stopped.
                point.allowance_mm = point.load_lost_mm = point.picture_said_mm = None
        elif load < limits.droop and (hole or point.doubt):
            self._stop_by_load(point)
        elif load < limits.droop:
            point.doubt = True

    def _reopen(self, point: Point, *, picture: bool) -> None:
        """Give a bounded amount back to a stopped point, after a look."""
        limits = self.limits
        # A look that followed no bite (its neighbours kept the point waiting) told nothing new.
        point.looks += point.cut_mm > point.looked_at_mm
        point.looked_at_mm = point.cut_mm
        if not picture:
            point.picture_said_mm = None
        elif point.picture_said_mm is None:
            point.picture_said_mm = point.cut_mm
        point.on_trial = False
        far_mm = point.cut_mm + self._return_mm(point)
        if point.load_lost_mm is not None:
            far_mm = min(far_mm, point.load_lost_mm + limits.past_loss_mm)
        point.allowance_mm = min(far_mm, limits.thickness_high_mm)
        if picture and not point.load_through:
            self._try(point)
        point.load_above_idle, point.doubt = True, point.load_through
        point.picture_through = picture and point.on_trial
        point.load_through = False
        point.frames_through = 0
        if not picture:
            point.unheard_mm = 0.0
        point.state, point.why = PointState.OPEN, "re-opened after a look"

    @classmethod
    def _stop_by_load(cls, point: Point) -> None:
        point.load_through = True
        if point.load_lost_mm is None:
            point.load_lost_mm = point.cut_mm
        cls._stop(point, "the load says through")

    @staticmethod
    def _stop(point: Point, why: str) -> Grant:
        if point.state is not PointState.DONE:
            point.state, point.why = PointState.STOPPED, why
        return Grant(point.cut_mm, False, why)

    @staticmethod
    def _finish(point: Point, why: str) -> None:
        point.state, point.why = PointState.DONE, why
