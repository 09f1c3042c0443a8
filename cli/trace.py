"""`mill trace`: read a trace, cut it, and hand it to other tools."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from drivers.errors import ConfigError

if TYPE_CHECKING:
    from drivers.trace_file import Entry, TraceLog

ARROWS = {"out": "->", "in": "<-"}
SOH = "\x01"
"""What every datagram of a robot begins with, and no line of a board."""
span_options = (
    click.option("--from", "from_s", type=float, default=0.0, metavar="S", help="Seconds of the trace to begin with."),
    click.option(
        "--to", "to_s", type=float, default=float("inf"), metavar="S", help="Seconds of the trace to end with."
    ),
)
file_argument = click.argument("file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE")


@click.group(no_args_is_help=False)
def trace() -> None:
    """Read, cut and export what --trace has written."""


@trace.command()
@file_argument
@click.option("--wire", metavar="WIRE", help="Only this one: motion, spindle, left, right, or run for decisions.")
@span_options[0]
@span_options[1]
@click.option("--grep", "pattern", metavar="REGEX", help="Only lines in which this is found.")
def show(file: Path, wire: str | None, from_s: float, to_s: float, pattern: str | None) -> None:
    """Show a trace as lines: seconds, wire, direction, bytes as text, or a CAN frame and what it means.

    -> is what the program wrote, <- what came back; bytes of a serial wire are put together to lines, and datagrams of
    a robot are told in words.
    """
    try:
        wanted = re.compile(pattern or "")
    except re.error as error:
        raise click.UsageError(f"--grep {pattern!r}: {error}; escape what is to be taken literally") from None
    log = _read(file)
    wires = sorted({entry.wire for entry in log.entries})
    if wire is not None and wire not in wires:
        raise click.UsageError(f"--wire {wire}: not in this trace; there are {', '.join(wires)}")
    if from_s == 0.0:
        click.echo(f"{file}: {log.header.get('command', 'trace')}, began {log.header['date']}", err=True)
    for entry in _whole_lines(log.entries):
        if from_s <= entry.t_s <= to_s and wire in (None, entry.wire):
            line = f"{entry.t_s:11.6f}  {entry.wire:<7}  {words(entry)}"
            if wanted.search(line):
                click.echo(line)


@trace.command()
@file_argument
@span_options[0]
@span_options[1]
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE")
def cut(file: Path, from_s: float, to_s: float, out: Path) -> None:
    """Write a part of a trace to a file of its own, times as they were.

    From the opening of a device on, it can be made a regression test (docs/trace.md).
    """
    from drivers.trace_file import write_trace

    log = _read(file)
    kept = [entry for entry in log.entries if from_s <= entry.t_s <= to_s]
    if not kept:
        raise ConfigError(f"{file}: nothing between {from_s:g} and {to_s:g} s; it ends at {_end_s(log):g} s")
    write_trace(out, log.header, kept)
    click.echo(f"{out}: {len(kept)} of {len(log.entries)} lines")


@trace.command()
@file_argument
@click.option(
    "--mcap",
    "mcap_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="OUT",
    help="MCAP, for Foxglove: a JSON topic for each wire.",
)
@click.option(
    "--pcap",
    "pcap_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="OUT",
    help="pcap, for Wireshark: the CAN frames.",
)
def export(file: Path, mcap_file: Path | None, pcap_file: Path | None) -> None:
    """Write a trace in the format of another tool."""
    from cli.trace_export import write_mcap, write_pcap

    if mcap_file is None and pcap_file is None:
        raise click.UsageError("give --mcap OUT, --pcap OUT, or both")
    log = _read(file)
    if mcap_file is not None:
        click.echo(f"{mcap_file}: {write_mcap(log, mcap_file)} messages")
    if pcap_file is not None:
        click.echo(f"{pcap_file}: {write_pcap(log, pcap_file)} CAN frames")


def words(entry: "Entry") -> str:
    """One entry for people, without its time and wire."""
    arrow = ARROWS.get(entry.kind, "  ")
    if entry.kind in ARROWS and entry.wire == "spindle":
        return f"{arrow} {frame_words(entry.data)}"
    if entry.kind in ARROWS and isinstance(entry.data, str):
        return f"{arrow} {_datagram_words(entry) or escaped(entry.data)}"
    if entry.kind in ARROWS:
        return f"{arrow} picture, {1000 * (entry.t_s - entry.data['exposed_s']):.1f} ms after its exposure began"
    if entry.kind == "call":
        return (
            f"{arrow} {entry.data['verb']}({', '.join(f'{key}={value}' for key, value in entry.data['args'].items())})"
        )
    if entry.kind == "error":
        return f"{arrow} ERROR {entry.data}"
    told = {key: value for key, value in entry.data.items() if key != "kind"}
    return f"{arrow} {entry.data['kind']} {json.dumps(told)}"


def frame_words(text: str) -> str:
    """A CAN frame, and what CANopen says of it."""
    from drivers.spindle.canopen_words import meaning
    from drivers.trace_file import ERROR, frame_of

    can_id, flags, data = frame_of(text)
    told = "error frame" if flags & ERROR else "" if flags else meaning(can_id, data)
    return f"{text:<20}  {told}".rstrip()


def _datagram_words(entry: "Entry") -> str | None:
    """What a datagram to or from a robot says; None for what is none."""
    from drivers.motion.bcap.words import meaning

    return meaning(entry.data.encode("latin-1"), asked=entry.kind == "out") if entry.data[:1] == SOH else None


def escaped(text: str) -> str:
    r"""Bytes as text: what cannot be seen is escaped, \n \r \x18, and a backslash is doubled."""
    return text.encode("unicode_escape").decode()


def _whole_lines(entries: "list[Entry]") -> "Iterator[Entry]":
    """The entries, with what came in on a serial wire put together to lines, each at the time of its first byte."""
    from dataclasses import replace

    begun: Entry | None = None
    for entry in entries:
        if not (entry.wire == "motion" and entry.kind == "in") or (begun is None and _datagram_words(entry)):
            yield entry
            continue
        for piece in re.findall(r"[^\n]*\n|[^\n]+", entry.data):
            begun = replace(entry, data=piece) if begun is None else replace(begun, data=begun.data + piece)
            if piece.endswith("\n"):
                yield begun
                begun = None
    if begun is not None:
        yield begun


def _read(file: Path) -> "TraceLog":
    from drivers.trace_file import read_trace

    log = read_trace(file)
    if log.damage:
        click.echo(f"{file}: {log.damage}", err=True)
    return log


def _end_s(log: "TraceLog") -> float:
    return max((entry.t_s for entry in log.entries), default=0.0)
