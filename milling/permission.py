"""Who may go deeper: a ledger of evidence per trajectory point.

The default is inverted: no evidence, no descent. Each permission is one bite at one visit of one point, measured from
that point's own contact, and it needs all of

- a frame at most ``frame_age_s`` old (the eyes are alive), and a picture of this very point taken after its last pass,
- a spindle load above idle at its last biting pass (the contact itself stands for the first bites), and past the low
  end of the thickness prior, or under a picture that may say "through", a load that was weighed lately,
- depth within the thickness prior and near that of its neighbours,
- by all that load, pictures and neighbours say together (``milling.thickness``): that the bite most probably leads no
  farther past the inner surface than ``past_mm``, and that there is bone left which is worth it.

What a limit has stopped goes on only after a look with the drill lifted. A point is finished at a look, where it is
through with all probability; it is latched then.

Standard library only, no clock, no device: every rule here can be read and tested by itself.
"""

from collections.abc import Mapping
from typing import Any, Protocol

from drivers.errors import SafetyStop
from milling.limits import Limits
from milling.point import Grant, Point, PointState


class Estimate(Protocol):
    """What all cues together say of the bone under each point; ``milling.thickness.Thickness``."""

    def weighed(self, index: int, depth_mm: float, ratio: float, *, beside_mm: float) -> None:
        """A pass that ended at ``depth_mm``, its neighbours at ``beside_mm`` in the mean, took that ``ratio``."""

    def pictured(self, index: int, depth_mm: float, completion: float) -> None:
        """A picture of the point, cut to ``depth_mm``, reads as ``completion``."""

    def forget_pictures(self, index: int) -> None:
        """What was seen of the point tells nothing."""

    def pictures(self, index: int) -> dict[str, Any]:
        """What was seen of the point, for a later run; as JSON."""

    def recall_pictures(self, index: int, kept: Mapping[str, Any]) -> None:
        """What an earlier run saw of the point."""

    def through(self, index: int, depth_mm: float) -> float:
        """Probability that the ball, at ``depth_mm`` below contact, has come through."""


class Ledger:
    """The evidence about every point of a closed ring."""

    def __init__(self, n_points: int, limits: Limits, thickness: Estimate) -> None:
        """``thickness`` as it is known before anything is milled."""
        self.limits = limits
        self._points = [Point(limits) for _ in range(n_points)]
        self.thickness = thickness
        self._bite_mm = limits.late_bite_mm
        """The newest bite that was asked for."""
        self._stale = False

    @property
    def points(self) -> list[Point]:
        """As they stand by all that is known."""
        if self._stale:
            self._estimate()
        return self._points

    def touched(self, index: int) -> None:
        """The point's contact is found: depth counts from here, and the touch is the first load above idle."""
        self._points[index].touched()

    def seen(self, index: int, *, completion: float, upper: float, exposed_at_s: float) -> None:
        """A frame shows the point. Pictures older than what is known, or not of this world, are ignored."""
        point = self._points[index]
        if point.seen(completion=completion, upper=upper, exposed_at_s=exposed_at_s) and point.cut_mm > 0:
            if point.incredible:
                self.thickness.forget_pictures(index)
            else:
                self.thickness.pictured(index, point.cut_mm, completion)
            self._stale = True

    def felt(self, index: int, *, ratio: float | None, above_idle: bool) -> None:
        """The spindle load of a pass that took a bite here.

        Args:
            index: the point, counted from 0.
            ratio: load against what bone takes; None while that cannot be known.
            above_idle: whether there was any load at all.
        """
        point = self._points[index]
        if ratio is not None:
            self._stale = True
            self._weigh(index, ratio)
        point.felt(ratio=ratio, above_idle=above_idle)

    def ask(self, index: int, *, bite_mm: float, now_s: float, frame_at_s: float) -> Grant:
        """How deep the tip may go at this visit. Asking again within one visit never adds to it."""
        point, self._bite_mm = self.points[index], bite_mm
        deepest_mm = min(self._beside_mm(index)) + self.limits.neighbour_mm
        grant = point.judge(bite_mm, now_s, frame_at_s, deepest_mm=deepest_mm, said_mm=self._said_mm)
        if grant.deeper and self._too_deep(index, grant.depth_mm):
            grant = Grant(point.cut_mm, False, "the bite may lead too deep")
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
        try:
            self._points[index].passed(depth_mm=depth_mm, now_s=now_s)
        except SafetyStop as error:
            raise SafetyStop(f"point {index + 1}: {error}") from None
        self._stale = True

    def snapshot(self, index: int) -> dict[str, Any]:
        """What a later run must know of the point, beside its depth; as JSON."""
        return self._points[index].snapshot() | self.thickness.pictures(index)

    def restore(self, index: int, kept: Mapping[str, Any]) -> None:
        """What an earlier run knew of the point."""
        self._points[index].restore(kept)
        self.thickness.recall_pictures(index, kept)
        self._stale = True

    def recall(self, index: int, *, depth_mm: float, ratio: float | None = None) -> None:
        """A pass of an earlier run left the point at ``depth_mm``, which nobody can take back, with this load."""
        point = self._points[index]
        point.unheard_mm += max(0.0, depth_mm - point.cut_mm)
        point.cut_mm = max(point.cut_mm, depth_mm)
        if ratio is not None:
            self._weigh(index, ratio)
        self._stale = True

    def void(self, index: int) -> None:
        """The visit ended before the tip reached the point: its permission is gone, its depth what it was."""
        self._points[index].granted_mm = None

    def stall(self) -> None:
        """No point got a bite for long: those that are open wait for a look."""
        for point in self.points:
            if point.state is PointState.OPEN:
                waits = [reason for reason in point.verdicts if reason != "bite"]
                point.stop(f"got no bite ({waits[-1] if waits else 'nothing asked'})")

    def look(self, index: int) -> PointState:
        """Judge a stopped point by what the lifted drill shows: finish it, or re-open it while looks are left.

        Call it after ``seen`` with frames taken while nothing hid the point.
        """
        point = self.points[index]
        if point.state is PointState.DONE:
            return point.state
        if point.left_probability < self.limits.left_risk and point.load_ratio is not None:
            point.finish(f"through, by load, pictures and neighbours: {100 * (1 - point.left_probability):.1f} %")
        elif point.looks >= self.limits.looks:
            point.stop("the cues disagree after every look")
        elif point.state is PointState.STOPPED:
            point.reopen()
            self._rest(index)
        return point.state

    def cut_mm(self, index: int) -> float:
        """Depth below contact that the tip reached, read back."""
        return self._points[index].cut_mm

    def completion(self, index: int) -> float:
        """The newest completion seen."""
        return self._points[index].completion

    @property
    def through_share(self) -> float:
        """Share of the ring that is probably through."""
        return sum(1.0 - point.left_probability for point in self.points) / len(self._points)

    @property
    def bridge_share(self) -> float:
        """Share of the ring that may hold the flap, as is to be expected."""
        bridge_mm = self.limits.bridge_mm
        held = (1.0 - self.thickness.through(i, point.cut_mm + bridge_mm) for i, point in enumerate(self._points))
        return sum(held) / len(self._points)

    @property
    def open_points(self) -> list[int]:
        """Indices that may still get a bite."""
        return [index for index, point in enumerate(self.points) if point.state is PointState.OPEN]

    @property
    def done(self) -> bool:
        """Whether every point is latched."""
        return all(point.state is PointState.DONE for point in self.points)

    def _estimate(self) -> None:
        """What all evidence says of every point."""
        self._stale = False
        for index, point in enumerate(self._points):
            if point.cut_mm > 0:
                point.left_probability = 1.0 - self.thickness.through(index, point.cut_mm + self.limits.left_mm)
                point.wake()
                self._rest(index)

    def _rest(self, index: int) -> None:
        point = self._points[index]
        if point.left_probability < self.limits.left_risk:
            point.rest("probably through")
        elif self._too_deep(index, point.next_mm(self._bite_mm)):
            point.rest("may be through: the next bite may lead too deep")

    @property
    def _said_mm(self) -> float:
        """How far a picture that says "through" may be overruled: farther by a load that drooped at other points."""
        proven = sum(point.agreed for point in self._points) >= self.limits.proven_share * len(self._points)
        return self.limits.said_proven_mm if proven else self.limits.said_mm

    def _too_deep(self, index: int, depth_mm: float) -> bool:
        return self.thickness.through(index, depth_mm - self.limits.past_mm) > self.limits.past_risk

    def _weigh(self, index: int, ratio: float) -> None:
        beside_mm = sum(self._beside_mm(index)) / 2
        self.thickness.weighed(index, self._points[index].cut_mm, ratio, beside_mm=beside_mm)

    def _beside_mm(self, index: int) -> tuple[float, float]:
        """Depths of its neighbours.

        Bone does not change its thickness from one point to the next, so depths that part tell of a wrong cue. And a
        ball that digs deeper than beside it cuts into its flanks: load there is no evidence of bone below.
        """
        n = len(self._points)
        return self._points[(index - 1) % n].cut_mm, self._points[(index + 1) % n].cut_mm
