"""Pages as their reader takes them: blocks of a terminal, each with its commands and what they show.

A block fenced as ``console`` is run. A line that begins with ``$`` is typed, what follows is shown; ``...`` stands for
anything. The title names the terminal and, in brackets, what is special about it.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
FENCE = re.compile(r'^```(\w+)(?: title="([^"]*)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Step:
    """One command and what it shows."""

    command: str
    shown: str


@dataclass(frozen=True)
class Block:
    """Some commands in one terminal. Without a command: more of what an earlier one shows there."""

    page: str
    title: str
    steps: tuple[Step, ...]

    @property
    def terminal(self) -> str:
        """Which one, as the title begins."""
        return self.title.partition("(")[0].strip()

    @property
    def goes_on(self) -> bool:
        """Its command keeps the terminal."""
        return "goes on" in self.title

    @property
    def takes_long(self) -> bool:
        """It moves a machine for a minute or more."""
        return "takes " in self.title

    @property
    def exit_code(self) -> int:
        """Of each of its commands."""
        told = re.search(r"exit code (\d+)", self.title)
        return int(told[1]) if told else 0


def fences(path: Path) -> Iterator[tuple[str, str, str]]:
    """Language, title and text of every fenced block."""
    for found in FENCE.finditer(path.read_text(encoding="utf-8")):
        yield found[1], found[2] or "", found[3]


def blocks(path: Path) -> list[Block]:
    """The blocks that are to be run."""
    return [Block(path.name, title, steps_of(text)) for kind, title, text in fences(path) if kind == "console"]


def steps_of(text: str) -> tuple[Step, ...]:
    """Commands with what is shown below each; a block without a command is one step."""
    before, *rest = re.split(r"^\$ ", text, flags=re.MULTILINE)
    steps = [Step("", before)] if before.strip() else []
    return tuple(
        steps + [Step(command.strip(), shown) for command, _, shown in (part.partition("\n") for part in rest)]
    )


def is_shown(shown: str, said: str, *, so_far: bool = False) -> bool:
    """Whether ``said`` is what is shown. How lines are broken does not count; ``so_far``: more may come."""
    dots = re.escape("...")
    words = (r"(?: \S+)*" if word == "..." else " " + re.escape(word).replace(dots, ".*") for word in shown.split())
    match = re.match if so_far else re.fullmatch
    return match("".join(words), "".join(f" {word}" for word in said.split())) is not None
