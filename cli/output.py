"""Machine-readable results: one JSON object a command."""

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click

from drivers.errors import ConfigError


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
