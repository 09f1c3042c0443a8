"""What a run may call its window when no look re-opens anything any more."""

from milling.permission import Ledger
from milling.point import PointState
from milling.result import Outcome

BRIDGE_SHARE = 0.05
"""Of the ring that may still hold the flap: the published criterion of a window."""
UNDECIDED_SHARE = 0.1
"""Of the ring that may be left undecided."""
THIN = 0.9
"""Completion, as the picture estimates it, below which an undecided point may be a bridge."""


def conclude(ledger: Ledger) -> tuple[Outcome, str]:
    """Outcome and reason: complete only where few points are undecided, and next to none of them may be a bridge."""
    n, limits = len(ledger.points), ledger.limits
    left = [index for index, point in enumerate(ledger.points) if point.state is not PointState.DONE]
    bridges = [i for i in left if ledger.completion(i) < THIN or ledger.shallow_mm(i) > limits.felt_mm]
    names = ", ".join(f"{i + 1} ({ledger.points[i].why})" for i in left)
    if len(bridges) <= BRIDGE_SHARE * n and len(left) <= UNDECIDED_SHARE * n:
        return "complete", f"the flap can be lifted, though not every cue says these are through: {names}"
    return "held", f"the cues disagree on these points, and no look may re-open them: {names}"
