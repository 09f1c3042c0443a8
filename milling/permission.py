"""Who may go deeper: a ledger of evidence per trajectory point.

The default is inverted: no evidence, no descent. Each permission is one bite at one visit of one point, measured from
that point's own contact, and it needs all of

- a frame at most ``frame_age_s`` old (the eyes are alive),
- a picture of this very point taken after its last pass, whose upper bound of completion is below the threshold,
- a spindle load above idle at its last biting pass (the contact itself stands for the first bites),
- depth within the thickness prior and near that of its neighbours.

One cue that says "through" stops the point. A load that droops once, under a picture of bone, is a doubt, and a second
droop stops. Past the low end of the thickness prior load above idle is not enough: it must have been weighed against
what bone takes. What is stopped goes on only after a look with the drill lifted, and only by a bounded amount, in which
the other cue has to prove wrong the one that stopped it.

A point is through where the load says so and the picture does not contradict. The picture alone is not believed: thin
bone, blood and glare look like holes too, and bridges would be left. A picture that says "through" over a load that was
weighed just now, and is that of bone, is tried: see docs/decisions/0024.

Standard library only, no clock, no device: every rule here can be read and tested by itself.
"""

from math import inf

from drivers.errors import SafetyStop
from milling.limits import Limits
from milling.point import Grant, Point, PointState


class Ledger:
    """The evidence about every point of a closed ring."""

    def __init__(self, n_points: int, limits: Limits) -> None:
        self.limits = limits
        self.points = [Point(limits) for _ in range(n_points)]

    def touched(self, index: int) -> None:
        """The point's contact is found: depth counts from here, and the touch is the first load above idle."""
        self.points[index].touched()

    def seen(self, index: int, *, completion: float, upper: float, exposed_at_s: float) -> None:
        """A frame shows the point. Pictures older than what is known, or not of this world, are ignored."""
        self.points[index].seen(completion=completion, upper=upper, exposed_at_s=exposed_at_s)

    def felt(self, index: int, *, ratio: float | None, above_idle: bool) -> None:
        """The spindle load of a pass that took a bite here.

        Args:
            index: the point, counted from 0.
            ratio: load against what bone takes; None while that cannot be known.
            above_idle: whether there was any load at all.
        """
        self.points[index].felt(ratio=ratio, above_idle=above_idle)

    def ask(self, index: int, *, bite_mm: float, now_s: float, frame_at_s: float) -> Grant:
        """How deep the tip may go at this visit. Asking again within one visit never adds to it."""
        point = self.points[index]
        grant = point.judge(bite_mm, now_s, frame_at_s, self._deepest_mm(index))
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
            self.points[index].passed(depth_mm=depth_mm, now_s=now_s)
        except SafetyStop as error:
            raise SafetyStop(f"point {index + 1}: {error}") from None

    def void(self, index: int) -> None:
        """The visit ended before the tip reached the point: its permission is gone, its depth what it was."""
        self.points[index].granted_mm = None

    def stall(self) -> None:
        """No point got a bite for long: those that are open wait for a look."""
        for point in self.points:
            if point.state is PointState.OPEN:
                waits = [reason for reason in point.verdicts if reason != "bite"]
                point.stop(f"got no bite ({waits[-1] if waits else 'nothing asked'})")

    def look(self, index: int) -> PointState:
        """Judge a stopped point by what the lifted drill shows: finish it, or re-open it by a bounded amount.

        Call it after ``seen`` with frames taken while nothing hid the point.
        """
        point = self.points[index]
        if point.state is PointState.DONE:
            return point.state
        through = self._through(index)
        if through is not None:
            point.finish(through)
        elif point.looks >= self.limits.looks:
            point.stop("the cues disagree after every look")
        elif point.state is PointState.STOPPED:
            if self._refuted(index):
                point.forget()
            point.reopen(self._plausible(point), max(0.0, self.shallow_mm(index)))
        return point.state

    def cut_mm(self, index: int) -> float:
        """Depth below contact that the tip reached, read back."""
        return self.points[index].cut_mm

    def completion(self, index: int) -> float:
        """The newest completion seen."""
        return self.points[index].completion

    def shallow_mm(self, index: int) -> float:
        """How much shallower a point is than its nearest neighbours on both sides that were felt to be through.

        Between the two the straight line counts; infinite where one half of the ring has none.
        """
        n, felt = len(self.points), []
        for step in (-1, 1):
            near = ((far, self.points[(index + step * far) % n]) for far in range(1, n // 2 + 1))
            felt += [next(((far, point.cut_mm) for far, point in near if point.felt_through), None)]
        sides = [side for side in felt if side is not None]
        if len(sides) < 2:
            return inf
        depth_mm = sum(cut_mm / far for far, cut_mm in sides) / sum(1 / far for far, _ in sides)
        return depth_mm - self.points[index].cut_mm

    @property
    def through_share(self) -> float:
        """Share of points that any cue says are through."""
        return sum(point.picture_through or point.load_through for point in self.points) / len(self.points)

    @property
    def open_points(self) -> list[int]:
        """Indices that may still get a bite."""
        return [index for index, point in enumerate(self.points) if point.state is PointState.OPEN]

    @property
    def done(self) -> bool:
        """Whether every point is latched."""
        return all(point.state is PointState.DONE for point in self.points)

    # What a look concludes.

    def _through(self, index: int) -> str | None:
        """Why the point is through; None where it is not, as far as is known."""
        point, limits = self.points[index], self.limits
        picture, plausible = point.hole_not_excluded, self._plausible(point)
        if point.load_through and plausible and self._behind_mm(index) <= limits.notch_mm:
            return "picture and load agree: through" if picture else "the load says through"
        if point.looks > 0 and plausible and self._below_finished_neighbours(index):
            return "deeper than its finished neighbours, and the picture agrees"
        near = max(self.shallow_mm(index), 2 * self._behind_mm(index)) <= limits.felt_mm
        if picture and near and (point.tried or self._waits(index)):
            return "the picture says through all along, and its neighbours were felt to be"
        if plausible and point.blind and self.shallow_mm(index) < limits.late_bite_mm:
            return "as deep as its neighbours that were felt to be through, and the picture agrees"
        return None

    def _plausible(self, point: Point) -> bool:
        """Whether the picture does not contradict a hole.

        A load that vanishes under a picture of thick bone speaks of the contact or of a ridge beside it, not of holes.
        """
        return point.hole_not_excluded or point.completion >= self.limits.agrees

    def _refuted(self, index: int) -> bool:
        """Whether its neighbours, cut deeper or felt to be through much deeper, say that here must be bone."""
        limits, behind_mm = self.limits, self._behind_mm(index)
        if self.points[index].load_through:
            return behind_mm > limits.notch_mm
        return 2 * behind_mm > limits.felt_mm or limits.felt_mm < self.shallow_mm(index) < inf

    def _behind_mm(self, index: int) -> float:
        """How much shallower a point is than both its neighbours."""
        return self._shallower_neighbour_mm(index) - self.points[index].cut_mm

    def _deepest_mm(self, index: int) -> float:
        """How deep its neighbours let a point go; less where the picture says that it is through."""
        limits = self.limits
        return self._shallower_neighbour_mm(index) + (
            limits.pit_mm if self.points[index].on_trial else limits.neighbour_mm
        )

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
        return all(point.state is PointState.DONE for point in near) and self._waits(index)

    def _waits(self, index: int) -> bool:
        """Whether the point is so deep that its shallower neighbour keeps it waiting."""
        return self.points[index].cut_mm + self.limits.late_bite_mm > self._deepest_mm(index)
