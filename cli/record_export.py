"""`mill runs export` and `mill runs follow`: runs in Foxglove and Rerun, from a record or while it grows."""

import importlib.util
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from drivers.errors import ConfigError

if TYPE_CHECKING:
    from cli.viewers.viewer import Viewer
    from milling.tail import Tail

PORTS = {"foxglove": 8765, "rerun": 9876}
"""What the viewers try when nobody tells them."""
HOW = {
    "foxglove": "in Foxglove: Open connection, Foxglove WebSocket, {address}",
    "rerun": "rerun --connect {address}",
}
LOOK_S = 0.1
"""How often a growing record is looked at."""


def export(run: Path, mcap_file: Path | None, rerun_file: Path | None) -> None:
    """Write the files, and tell what is in them.

    Raises:
        ConfigError: the record is damaged, a package is missing, or a file cannot be written; no file is left half.
    """
    for name, file in (("foxglove", mcap_file), ("rerun", rerun_file)):
        if file is not None:
            _require(name)
            with _replacing(file) as part:
                _write(run, name, part, file)


def follow(run: Path, name: str) -> None:
    """Serve a run that goes on, until Ctrl-C.

    Raises:
        ConfigError: the run is over, its record is damaged, or a package is missing.
    """
    from cli.viewers.telling import Telling
    from drivers.clock import SystemClock
    from milling.tail import Tail

    _require(name)
    if (run / "result.json").exists():
        flag = {"foxglove": "--mcap", "rerun": "--rerun"}[name]
        raise ConfigError(f"{run}: the run is over; open its record instead: mill runs export {run} {flag} FILE")
    clock = SystemClock()
    with Tail(run) as tail, _served(name, tail) as (viewer, address):
        telling = Telling(run, tail.header, viewer)
        click.echo(f"{HOW[name].format(address=address)}\nCtrl-C ends it; the run goes on without.")
        with suppress(KeyboardInterrupt):
            over = False
            while True:
                for event in tail.news():
                    telling.take(event)
                if telling.story.over and not over:
                    over = True
                    click.echo(f"the run is over: {telling.story.now['outcome']['outcome']}")
                clock.sleep_s(LOOK_S)


def _write(run: Path, name: str, part: Path, file: Path) -> None:
    from cli.viewers.telling import Telling
    from milling.tail import Tail

    number = 0
    with Tail(run) as tail:
        into = _file_writer(name, run)
        with into(part, tail.header) as viewer:
            telling = Telling(run, tail.header, viewer)
            for number, event in enumerate(tail.news(), start=1):  # noqa: B007
                telling.take(event)
        if tail.damage:
            click.echo(f"{run}: {tail.damage}", err=True)
    if telling.missing:
        click.echo(f"{run}: {telling.missing} pictures of the record are missing; the rest is whole", err=True)
    click.echo(f"{file}: {number} events")


def _file_writer(name: str, run: Path) -> "Callable[[Path, dict[str, Any]], AbstractContextManager[Viewer]]":
    if name == "foxglove":
        from cli.viewers.foxglove import into_mcap

        return into_mcap
    from cli.viewers.rerun import into_rrd

    return lambda path, header: into_rrd(path, run.resolve().name, header)


@contextmanager
def _served(name: str, tail: "Tail") -> "Iterator[tuple[Viewer, str]]":
    port = _free_port(PORTS[name])
    if name == "foxglove":
        from cli.viewers import foxglove

        with foxglove.served(tail.header, port) as served:
            yield served
    else:
        from cli.viewers import rerun

        with rerun.served(tail.folder.resolve().name, tail.header, port) as served_too:
            yield served_too


def _free_port(wanted: int) -> int:
    """The one wanted, or another where a second run is followed."""
    for port in (wanted, 0):
        with socket.socket() as probe, suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return int(probe.getsockname()[1])
    raise ConfigError("127.0.0.1: no port is free; end other programs")


@contextmanager
def _replacing(file: Path) -> Iterator[Path]:
    """A name beside ``file`` to write to; it takes its place only when whole."""
    if not file.parent.is_dir():
        raise ConfigError(f"{file}: {file.parent} is no folder; make it, or name another file")
    part = file.with_name(f".{file.name}.part")
    try:
        yield part
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def _require(name: str) -> None:
    # Module and extra have the viewer's name.
    if importlib.util.find_spec(name) is None:
        raise ConfigError(f"{name} is not installed: pip install 'micromill[{name}]'")
