"""Progress of long work: how far, and how long still."""

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID


def progress_bars(console: "Console | None" = None) -> "Progress":
    """Bars on stderr, to be used as a context."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console or Console(stderr=True),
    )


def counter(bars: "Progress", what: str) -> Callable[[int, int], None]:
    """A bar from the first step on, as a function of how much is done and of how much."""
    shown: list[TaskID] = []

    def count(done: int, total: int) -> None:
        if not shown:
            shown.append(bars.add_task(what, total=total))
        bars.update(shown[0], completed=done)

    return count
