"""What a person watches during a run: the ring filling up, the stage, depth, load and the time left."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from cli.ring import ring_gauge


class RunProgress(Protocol):
    """What the loop tells; see ``milling.loop.Progress``."""

    @property
    def stage(self) -> str:
        """What it does now."""

    @property
    def detail(self) -> str:
        """In words."""

    @property
    def depth_mm(self) -> tuple[float, ...]:
        """Per point, below contact."""

    @property
    def completion(self) -> tuple[float, ...]:
        """Per point."""

    @property
    def state(self) -> tuple[str, ...]:
        """Per point."""

    @property
    def torque_fraction(self) -> float:
        """Of rated torque."""

    @property
    def milling_time_s(self) -> float:
        """So far."""


Told = Callable[[RunProgress], None]


@contextmanager
def watched(console: Console) -> Iterator[Told]:
    """A live view on a terminal; one line a stage everywhere else."""
    if not console.is_terminal:
        yield _lines(console)
        return
    view = _View()
    with Live(view.draw(), console=console, refresh_per_second=8, transient=False) as live:

        def tell(now: RunProgress) -> None:
            view.take(now)
            live.update(view.draw())

        yield tell


def _lines(console: Console) -> Told:
    last: list[str] = []

    def tell(now: RunProgress) -> None:
        line = f"{now.stage}: {now.detail}" if now.detail else now.stage
        if now.completion:
            share = f"{100 * mean(now.completion):.0f} % of the bone"
            line = f"{now.stage}: {share}, {_resting(now).count(True)} of {len(now.completion)} points at rest"
        if [line] != last:
            last[:] = [line]
            console.print(line, highlight=False, soft_wrap=True)

    return tell


class _View:
    """The newest of everything that was told."""

    def __init__(self) -> None:
        self.stage = "start"
        self.detail = ""
        self.ring: RunProgress | None = None

    def take(self, now: RunProgress) -> None:
        self.stage, self.detail = now.stage, now.detail
        if now.completion:
            self.ring = now

    def draw(self) -> Panel:
        heading = Text.assemble((self.stage, "bold"), ("  " + self.detail if self.detail else ""))
        if self.ring is None:
            return Panel(heading, title="mill run")
        return Panel(Group(heading, Text(), _gauge(self.ring)), title="mill run")


def _resting(now: RunProgress) -> list[bool]:
    """Which points get no bite now; finished they are only at the look at the end."""
    return [state != "open" for state in now.state] or [value >= 1.0 for value in now.completion]


def _gauge(now: RunProgress) -> Text:
    resting = _resting(now)
    lines = [
        f"{100 * mean(now.completion):3.0f} % of the bone",
        f"{resting.count(True)} of {len(resting)} points at rest",
        f"{1000 * max(now.depth_mm):.0f} um deep",
        f"torque {100 * now.torque_fraction:.0f} %",
        time_left(now),
    ]
    return ring_gauge(now.completion, resting, lines)


def time_left(now: RunProgress) -> str:
    """The same speed for what is left of the bone; nothing is promised near the end."""
    through = mean(now.completion)
    if through <= 0.05 or now.milling_time_s <= 0:
        return ""
    if through >= 0.97:
        return "last looks"
    left_s = now.milling_time_s * (1.0 / through - 1.0)
    return f"about {int(left_s) // 60}:{int(left_s) % 60:02d} left"


def mean(values: tuple[float, ...]) -> float:
    """Of what is known."""
    known = [value for value in values if value == value]  # noqa: PLR0124  (NaN is not itself)
    return sum(known) / len(known) if known else 0.0
