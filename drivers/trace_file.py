"""The trace of a session: every byte and frame on the wires, what the program asked of the devices, what it decided.

Checked lines (``drivers.checked_lines``) of ``{"n", "t", "wire", "kind", "data"}``:

    n       number, given before the thing happens; a reader sorts by it
    t       seconds of the clock since the trace began, to the microsecond
    wire    "motion", "spindle", "left", "right"; "run" for decisions, "trace" for the header
    kind    "out" and "in" for what was written and read, "call" for what the program asked of a device, "error" for
            what a wire or a call raised, "event" for a decision, "header" for the first line
    data    out and in: a string. On a serial wire its characters are the bytes (Latin-1), on a CAN bus it is a frame in
            candump's notation, "201#0F0030750000"; call: {"verb", "args"}; of a camera {"exposed_s"}; error: its words

A line is written after the bytes are on the wire, so that a stop waits for no disk. Nothing is synced before ``close``:
a killed process loses nothing, a machine that loses its power the last seconds.
"""

import contextlib
import itertools
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from drivers.checked_lines import LineWriter, plain, read_lines
from drivers.clock import Clock
from drivers.errors import ConfigError, MillError

SCHEMA = 1
EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
"""Above the identifier, as Linux's can.h has them."""

_DIGITS = 9
"""Of a number that a device was given: enough to make the same bytes of it again."""
_FRAME = re.compile(r"([0-9A-F]{3}|[0-9A-F]{8})#(R[0-8]?|(?:[0-9A-F]{2}){0,8})")

Mark = tuple[int, float]
"""The number and the time of something that is about to happen."""


class Trace:
    """Writes one file. Takes notes from any thread; a disk that is full ends the trace, never the session."""

    def __init__(
        self, path: Path, clock: Clock, header: Mapping[str, Any], *, on_loss: Callable[[str], None] = lambda _: None
    ) -> None:
        """Create the file.

        Args:
            path: where; must not exist yet.
            clock: stamps the lines, relative to now.
            header: JSON; ``schema``, ``date`` and ``clock_s``, the clock's time at t = 0, are added.
            on_loss: told once, in words, when the disk takes no more.

        Raises:
            ConfigError: the file exists.
        """
        try:
            self._lines = LineWriter(path)
        except FileExistsError as error:
            raise ConfigError(f"{path}: exists already and is kept; name another --trace file") from error
        self._path = path
        self._clock = clock
        self._start_s = clock.now_s()
        self._numbers = itertools.count()
        self._on_loss = on_loss
        date = datetime.now(UTC).isoformat()
        about = {"schema": SCHEMA, "date": date, "clock_s": round(self._start_s, 6), **header}
        self.note(self.mark(), "trace", "header", about)

    def mark(self) -> Mark:
        """Take number and time of what happens next."""
        return next(self._numbers), round(self._clock.now_s() - self._start_s, 6)

    def note(self, mark: Mark, wire: str, kind: str, data: object) -> None:
        """Write one line; ``data`` is plain JSON."""
        number, t_s = mark
        try:
            self._lines.append({"n": number, "t": t_s, "wire": wire, "kind": kind, "data": data})
        except OSError as error:
            self._on_loss(f"{self._path}: the trace ends here ({error.strerror}); the session goes on")

    def event(self, kind: str, **fields: Any) -> None:
        """A decision, as a ``drivers.recorder.Recorder`` takes it."""
        self.note(self.mark(), "run", "event", {"kind": kind, **plain(fields)})

    @contextlib.contextmanager
    def call(self, wire: str, verb: str, *, is_urgent: bool = False, **args: Any) -> Iterator[None]:
        """Note that a device is asked for something; an urgent one is written down when it is done."""
        mark = self.mark()
        data = {"verb": verb, "args": plain(args, _DIGITS)}
        if not is_urgent:
            self.note(mark, wire, "call", data)
        try:
            yield
        except MillError as error:
            self.note(self.mark(), wire, "error", str(error))
            raise
        finally:
            if is_urgent:
                self.note(mark, wire, "call", data)

    def seconds(self, time_s: float) -> float:
        """A time of the clock in seconds of the trace."""
        return round(time_s - self._start_s, 6)

    def close(self) -> None:
        """Bring it to the disk; a second call does nothing."""
        try:
            self._lines.close()
        except OSError as error:
            self._on_loss(f"{self._path}: the end of the trace may be missing ({error.strerror})")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True)
class Entry:
    """One line of a trace."""

    number: int
    t_s: float
    wire: str
    kind: str
    data: Any

    def to_json(self) -> dict[str, Any]:
        """The line as it stands in the file."""
        return {"n": self.number, "t": self.t_s, "wire": self.wire, "kind": self.kind, "data": self.data}


@dataclass(frozen=True)
class TraceLog:
    """A trace read back, in the order in which things happened. ``damage`` says what was lost, None where nothing."""

    header: dict[str, Any]
    entries: list[Entry]
    damage: str | None

    @property
    def began(self) -> datetime:
        """The date and time of t = 0."""
        return datetime.fromisoformat(self.header["date"])


def read_trace(path: Path) -> TraceLog:
    """Read a trace; a torn last line, as a kill leaves it, is dropped and named in ``damage``.

    Raises:
        ConfigError: there is no trace, or it is damaged.
    """
    try:
        lines = read_lines(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); name a file that --trace has written") from error
    try:
        entries = [Entry(each["n"], each["t"], each["wire"], each["kind"], each["data"]) for each in lines.records]
    except KeyError:
        entries = []
    if not entries or entries[0].kind != "header":
        raise ConfigError(f"{path}: is no trace; name a file that --trace has written")
    header = entries[0].data
    if header.get("schema") != SCHEMA:
        raise ConfigError(f"{path}: schema {header.get('schema')!r}, this version reads {SCHEMA}")
    return TraceLog(header, sorted(entries[1:], key=lambda entry: entry.number), lines.damage)


def write_trace(path: Path, header: Mapping[str, Any], entries: list[Entry]) -> None:
    """Write a trace of these entries, as ``mill trace cut`` does.

    Raises:
        ConfigError: the file exists.
    """
    try:
        lines = LineWriter(path)
    except FileExistsError as error:
        raise ConfigError(f"{path}: exists already and is kept; name another file") from error
    with contextlib.closing(lines):
        for entry in [Entry(0, 0.0, "trace", "header", dict(header)), *entries]:
            lines.append(entry.to_json())


def frame_text(can_id: int, data: bytes, *, flags: int = 0) -> str:
    """A frame in candump's notation: three digits of identifier, eight for an extended or an error frame."""
    # candump shows the flag of an error frame with its identifier, and tells an extended one by its eight digits.
    head = f"{can_id | flags & ERROR:08X}" if flags & (EXTENDED | ERROR) else f"{can_id:03X}"
    return f"{head}#R" if flags & REMOTE else f"{head}#{data.hex().upper()}"


def frame_of(text: str) -> tuple[int, int, bytes]:
    """Identifier, flags and data of a frame in candump's notation.

    Raises:
        ConfigError: it is none.
    """
    match = _FRAME.fullmatch(text)
    if match is None:
        raise ConfigError(f"trace: {text!r} is no CAN frame")
    head, body = match.groups()
    can_id = int(head, 16)
    kind = ERROR if can_id & ERROR else EXTENDED if len(head) == 8 else 0
    if body.startswith("R"):
        return can_id & ~ERROR, kind | REMOTE, b""
    return can_id & ~ERROR, kind, bytes.fromhex(body)
