"""What published systems use in place of permission: they descend unless the picture says "done".

For comparison on the virtual bench only: no contact, no load, no verify pass. The floor in the controller's soft limits
is all that stands between a wrong picture and the membrane.
"""

from typing import Any

from milling.point import Grant

_DONE = 0.95


class Unguarded:
    """Grants whatever is asked for, down to a floor, until the picture says that the point is done."""

    def __init__(self, deepest_mm: list[float]) -> None:
        """``deepest_mm`` (n,) below the start, where the calibrated floor lies."""
        self._deepest_mm = deepest_mm
        self._cut_mm = [0.0] * len(deepest_mm)
        self._completion = [0.0] * len(deepest_mm)

    @property
    def open_points(self) -> list[int]:
        """All of them until all are done: the published stop rule."""
        n = len(self._completion)
        return [] if all(value >= _DONE for value in self._completion) else list(range(n))

    @property
    def through_share(self) -> float:
        """Share of points that the picture calls done."""
        return sum(value >= _DONE for value in self._completion) / len(self._completion)

    def seen(self, index: int, *, completion: float, upper: float, exposed_at_s: float) -> None:
        """Believe the best estimate; completion never falls."""
        del upper, exposed_at_s
        self._completion[index] = max(self._completion[index], completion)

    def ask(self, index: int, *, bite_mm: float, now_s: float, frame_at_s: float) -> Grant:
        """The bite asked for."""
        del now_s, frame_at_s
        depth = min(self._cut_mm[index] + bite_mm, self._deepest_mm[index])
        return Grant(depth, depth > self._cut_mm[index], "published systems ask nobody")

    def passed(self, index: int, *, depth_mm: float, now_s: float) -> None:
        """Keep the depth."""
        del now_s
        self._cut_mm[index] = max(self._cut_mm[index], depth_mm)

    def void(self, index: int) -> None:
        """Nothing to give back."""

    def felt(self, index: int, *, ratio: float | None, above_idle: bool) -> None:
        """Published systems do not feel."""

    def snapshot(self, index: int) -> dict[str, Any]:
        """Nothing: such a window is not resumed."""
        return {}

    def cut_mm(self, index: int) -> float:
        """Depth below the start."""
        return self._cut_mm[index]

    def completion(self, index: int) -> float:
        """The greatest completion seen."""
        return self._completion[index]
