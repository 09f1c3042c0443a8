"""Who may go deeper: a ledger of evidence per trajectory point, and one latch for the machine.

The default is inverted: no evidence, no descent. Each permission is one bite at one visit of one point, measured from
that point's own contact, and it needs all of

- a frame at most ``frame_age_s`` old (the eyes are alive),
- a picture of this very point taken after its last pass, whose upper bound of completion is below the threshold,
- a spindle load above idle at its last biting pass (the contact itself stands for the first bites),
- depth within the thickness prior and near that of its neighbours.

One cue that says "through" stops the point. A load that droops once, under a picture of bone, is a doubt: the next bite
is a small one, and a second droop stops. Past the low end of the thickness prior the load must be whole: above idle is
not enough there. What is stopped goes on only after a look with the drill lifted, and then only by a bounded amount.

Standard library only, no clock, no device: every rule here can be read and tested by itself.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum

from drivers.errors import SafetyStop

_ROUNDING_MM = 1e-6


@dataclass(frozen=True)
class Limits:
    """What the ledger enforces; lengths in mm, load ratios against the bone cut so far.

    Attributes:
        bite_mm: the deepest bite of one visit.
        late_bite_mm: the same, once less than ``late_margin_mm`` of bone may remain.
        thickness_low_mm, thickness_high_mm: the thickness prior.
        threshold: upper bound of completion that means "through".
        entry_mm: how deep the contact alone is evidence of bone: its own uncertainty, run-out included.
        frame_age_s: the oldest newest frame.
        doubtful_bite_mm: the bite that settles a doubt.
        newest: the weight of the newest pass in a point's load.
        prior_slack_mm: how far above the low end of the thickness prior a droop of the load is first believed.
        droop: a load below this share of what bone takes means "through".
        whole: past the low end of the prior, and after a doubt, the load must reach this share.
        neighbour_mm: how much deeper than its shallower neighbour a point may go.
        reopen_mm: what one look with the drill lifted may give back to a stopped point, beyond what its best
            estimate of completion leaves.
        most_reopen_mm: the bound on both together.
        past_loss_mm: how far all looks together may let a point go past where the load was first lost.
        agrees: the best estimate of completion that does not contradict a load that says "through".
        looks: how often a point may be re-opened.
    """

    bite_mm: float = 0.05
    late_bite_mm: float = 0.015
    late_margin_mm: float = 0.1
    thickness_low_mm: float = 0.25
    thickness_high_mm: float = 0.6
    threshold: float = 0.995
    entry_mm: float = 0.03
    frame_age_s: float = 0.1
    doubtful_bite_mm: float = 0.005
    newest: float = 0.4
    prior_slack_mm: float = 0.05
    droop: float = 0.75
    whole: float = 0.8
    neighbour_mm: float = 0.05
    reopen_mm: float = 0.03
    most_reopen_mm: float = 0.06
    past_loss_mm: float = 0.02
    agrees: float = 0.9
    looks: int = 4


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
    frames_through: int = 0
    picture_through: bool = False
    load_through: bool = False
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
        # A re-opened point has its bound from a better look than this one: only a hole that is seen stops it.
        says = upper if point.allowance_mm is None else completion
        point.frames_through = point.frames_through + 1 if says >= self.limits.threshold else 0
        if point.frames_through >= 2 and not point.picture_through:
            point.picture_through = True
            self._stop(point, "the picture says through")

    def felt(self, index: int, *, ratio: float | None, above_idle: bool) -> None:
        """The spindle load of a pass that took a bite here.

        Args:
            index: the point, counted from 0.
            ratio: load against what bone takes; None while too little bone was cut to know that.
            above_idle: whether there was any load at all.
        """
        point = self.points[index]
        if ratio is not None:
            # One pass is some eight reports, its ratio spreads by a fifth: only several passes tell bone from a hole.
            before = 1.0 if point.load_ratio is None else point.load_ratio
            # More load than bone takes is no more bone: it must not hide the droop that follows.
            point.load_ratio = before + self.limits.newest * (min(ratio, 1.0) - before)
        point.load_above_idle = above_idle or point.cut_mm <= self.limits.entry_mm
        picture_of_bone = point.upper is not None and point.upper < self.limits.threshold
        if not point.load_above_idle:
            self._stop_by_load(point)
        elif point.load_ratio is not None and point.cut_mm > self.limits.thickness_low_mm - self.limits.prior_slack_mm:
            late = point.doubt or point.cut_mm > self.limits.thickness_low_mm
            if point.load_ratio >= (self.limits.whole if late else self.limits.droop):
                point.doubt = False
                if picture_of_bone:
                    # Both cues refute what stopped the point, if it was stopped.
                    point.allowance_mm = point.load_lost_mm = None
            elif picture_of_bone and not point.doubt:
                point.doubt = True
            else:
                self._stop_by_load(point)

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
        point.cut_mm = max(point.cut_mm, depth_mm)

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
        through = point.upper is not None and point.upper >= limits.threshold
        # A load that vanishes under a picture of thick bone speaks of the contact or of a ridge beside it, not of holes
        plausible = point.completion >= limits.agrees
        if through and point.load_through:
            self._finish(point, "picture and load agree: through")
        elif point.load_through and point.looks > 0 and plausible:
            self._finish(point, "the load said through twice")
        elif through and point.looks > 0 and point.completion >= limits.threshold:
            self._finish(point, "the picture says through, bound and best estimate")
        elif point.looks > 0 and plausible and self._below_finished_neighbours(index):
            self._finish(point, "deeper than its finished neighbours, and the picture agrees")
        elif point.looks >= limits.looks:
            if through or (point.load_through and plausible):
                self._finish(point, "one cue says through after every look")
            else:
                self._stop(point, "no cue says through after every look")
        elif point.state is PointState.STOPPED:
            # A look that followed no bite (its neighbours kept the point waiting) told nothing new.
            point.looks += point.cut_mm > point.looked_at_mm
            point.looked_at_mm = point.cut_mm
            point.allowance_mm = min(point.cut_mm + self._return_mm(point), limits.thickness_high_mm)
            if point.load_lost_mm is not None:
                point.allowance_mm = min(point.allowance_mm, point.load_lost_mm + limits.past_loss_mm)
            stopped_by_load = point.load_through
            point.picture_through = point.load_through = False
            point.frames_through = 0
            # What stopped the point is what the next bites have to prove wrong; where it was the load, small ones.
            point.load_above_idle, point.doubt = True, stopped_by_load
            if not stopped_by_load:
                point.load_ratio = None
            point.state, point.why = PointState.OPEN, "re-opened after a look"
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
        if depth > limits.thickness_low_mm and point.load_ratio is None and not reopened:
            return self._stop(point, "past the low end of the thickness prior, and its load is not known")
        if depth > self._shallower_neighbour_mm(index) + limits.neighbour_mm:
            return no("waits for its neighbours")
        return Grant(depth, True, "bone")

    def _bite_limit(self, point: Point) -> float:
        limits = self.limits
        if point.doubt:
            return limits.doubtful_bite_mm
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


class Reaction(IntEnum):
    """What the machine does about a failure; a later, harder one never softens an earlier one."""

    NONE = 0
    HOLD = 1
    """Feed hold, then 50-200 um up: dwelling on the membrane tears it."""
    RETRACT = 2
    """At least 1 mm up, confirmed, then the spindle off, confirmed."""
    KILL = 3
    """Spindle off and controller reset together; the position is lost."""


@dataclass
class Latch:
    """The first failure, kept; what comes later may only make the reaction harder."""

    reaction: Reaction = Reaction.NONE
    reason: str = ""

    def trip(self, reaction: Reaction, reason: str) -> None:
        """Latch a failure."""
        if not self.reason:
            self.reason = reason
        self.reaction = max(self.reaction, reaction)


def reaction_to(error: BaseException) -> Reaction:
    """The first reaction to an error or to a person's interrupt.

    Retract needs a trusted position and a controller that answers. Only the controller knows, so a retract that
    it refuses becomes a kill.
    """
    return Reaction.HOLD if isinstance(error, SafetyStop) else Reaction.RETRACT
