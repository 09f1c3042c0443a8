"""Options that several commands share."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path

import click

from drivers.errors import ConfigError


def _writable(_context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """Refused before anything moves: a run's results must have a place to go to."""
    if path is not None and not path.parent.is_dir():
        raise ConfigError(f"{path}: no folder {path.parent}; make it, or name another {parameter.opts[0]} file")
    return path


rig_option = click.option(
    "--rig", type=click.Path(path_type=Path), metavar="FILE", help="Rig file: use the devices it names."
)
emulate_option = click.option("--emulate", is_flag=True, help="Use a virtual bench, started for this command.")
specimen_option = click.option(
    "--specimen", type=click.Path(path_type=Path), metavar="FILE", help="Specimen file of the virtual bench."
)
seed_option = click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Draws specimen and rig of the virtual bench.",
)
motion_option = click.option(
    "--motion",
    type=click.Choice(["grbl", "tinyg", "bcap"]),
    default="grbl",
    show_default=True,
    help="Motion controller of the virtual bench: a GRBL or a g2core board, or a DENSO robot over b-CAP.",
)
fault_option = click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="NAME[=VALUE][@TIME]",
    help="Plant a fault in the virtual bench, such as camera.stuck@30s; docs/faults.md lists them.",
)
json_option = click.option(
    "--json",
    "json_file",
    type=click.Path(path_type=Path, dir_okay=False),
    callback=_writable,
    metavar="FILE",
    help="Write the results as JSON; - for stdout.",
)
trace_option = click.option(
    "--trace",
    "trace_file",
    type=click.Path(path_type=Path, dir_okay=False),
    callback=_writable,
    metavar="FILE",
    help="Write down every byte on the wires, every call and decision (docs/trace.md).",
)
log_option = click.option(
    "--log",
    "log_file",
    type=click.Path(path_type=Path, dir_okay=False),
    callback=_writable,
    metavar="FILE",
    help="Add what happens to this file, as JSON lines with the run's id.",
)


@dataclass(frozen=True)
class BenchChoice:
    """The bench that a command works on: the devices of a rig file, or a virtual bench."""

    rig_file: Path | None = None
    emulate: bool = False
    specimen: Path | None = None
    seed: int = 0
    faults: tuple[str, ...] = ()
    trace_file: Path | None = None
    motion: str = "grbl"

    @property
    def drawn_from(self) -> int | None:
        """The seed that results tell; None on hardware, where nothing is drawn."""
        return self.seed if self.emulate else None


def on_a_bench(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of a bench and --trace; the command's first argument is a ``BenchChoice`` of them."""

    @wraps(command)
    def with_choice(
        rig: Path | None,
        emulate: bool,
        specimen: Path | None,
        seed: int,
        faults: tuple[str, ...],
        trace_file: Path | None,
        motion: str,
        **others: object,
    ) -> None:
        command(BenchChoice(rig, emulate, specimen, seed, faults, trace_file, motion), **others)

    shown = (rig_option, emulate_option, specimen_option, seed_option, motion_option, fault_option, trace_option)
    # The last one added is the first that the help shows.
    for option in reversed(shown):
        with_choice = option(with_choice)
    return with_choice
