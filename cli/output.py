"""What commands write: one JSON object for machines, lines and columns for people."""

import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from drivers.errors import ConfigError, MillError

if TYPE_CHECKING:
    from rich.console import Console


def write_json(path: Path, command: str, *, seed: int | None, **figures: Any) -> None:
    """Write ``schema``, ``command``, ``version``, ``seed`` and the figures to ``path``; "-" is stdout."""
    result = {"schema": 1, "command": command, "version": version("micromill"), "seed": seed, **figures}
    text = json.dumps(result, indent=2, allow_nan=False)
    if str(path) == "-":
        click.echo(text)
        return
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot write the results: {error.strerror}; name another --json file") from None


def console_beside(json_file: Path | None) -> "Console":
    """Where people read on: stdout, unless that is for machines alone."""
    from rich.console import Console

    return Console(stderr=json_file is not None and str(json_file) == "-")


def one_line(text: str) -> str:
    """The same words on one line."""
    return " ".join(text.split())


COMMANDS_OF_VERBS = {
    "hold() or flush()": "`mill stop`",
    "halt() stops": "`mill stop` stops",
    "home()": "`mill jog --home`",
}
"""What the drivers tell a program to call, and what a person types for it."""


def for_people(error: MillError) -> str:
    """The words of an error on one line; a next step that is a call becomes the command that does it."""
    text = one_line(str(error))
    for verb, command in COMMANDS_OF_VERBS.items():
        text = text.replace(verb, command)
    return text


def columns(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table as lines that are never cut: what stands in it can be copied, and found with grep.

    Columns that are empty in every row are left out.
    """
    kept = [index for index in range(len(titles)) if any(row[index] for row in rows)]
    table = [[row[index] for index in kept] for row in [titles, *rows]]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in table]
