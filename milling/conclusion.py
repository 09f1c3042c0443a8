"""What a run may call its window when no look re-opens anything any more."""

from milling.permission import Ledger
from milling.point import PointState
from milling.result import Outcome

BRIDGE_SHARE = 0.05
"""Of the ring that may hold the flap: the published criterion of a window."""


def conclude(ledger: Ledger) -> tuple[Outcome, str]:
    """Outcome and reason: complete only where next to nothing of the ring holds the flap, as far as is known."""
    left = [index for index, point in enumerate(ledger.points) if point.state is not PointState.DONE]
    if not left:
        return "complete", "every point is through, judged again with the drill aside"
    names = ", ".join(f"{index + 1} ({ledger.points[index].why})" for index in left)
    share = ledger.bridge_share
    held = f"{100 * share:.1f} % of the ring may hold it"
    if share <= BRIDGE_SHARE:
        return "complete", f"the flap can be lifted ({held}), though these points are not through for certain: {names}"
    return (
        "held",
        f"the flap may not be free ({held}); these points may not be through, and no look may re-open them: {names}",
    )
