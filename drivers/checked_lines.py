r"""Append-only files of JSON lines that tell the truth even when the process is killed: run records and traces.

A line is ``CHECK JSON\n``. Each is one raw ``write()``, so that a killed process leaves at most its last line torn.
Keys keep the order they were given in. A file has one of two kinds of check:

    sum    eight hex digits, CRC-32 over the JSON's bytes: tells damage
    link   32 hex digits, half a SHA-256 over the link of the line before, a space, and the JSON's bytes: a chain, which
           also tells lines that were changed, removed or put in by somebody who did not make all that follow anew
"""

import contextlib
import errno
import hashlib
import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import ConfigError

_encoded = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


LINK_DIGITS = 32


@dataclass(frozen=True)
class ChainEnd:
    """Where a chain ends: how many lines, and the last one's link."""

    lines: int
    head: str


class LineWriter:
    """Writes a file that was not there before. ``append`` may be called from any thread, of a chain from one only."""

    def __init__(self, path: Path, follows: str | None = None) -> None:
        """Create it.

        Args:
            path: where.
            follows: the link that the first line of a chain follows from; None for lines with sums.

        Raises:
            FileExistsError: it is there.
            OSError: it cannot be made.
        """
        self._path = path
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
        self._file: int | None = os.open(path, flags, 0o644)
        self._full = False
        self._end = None if follows is None else (0, follows)
        """Lines of the chain, and the last one's link; a tuple is made faster than a ``ChainEnd``."""
        self._begun: tuple[bytes, tuple[int, str]] | None = None
        """The line that is being written, and the end once it is."""

    @property
    def is_open(self) -> bool:
        """Whether it was not closed yet."""
        return self._file is not None

    @property
    def chain(self) -> ChainEnd | None:
        """Where the chain ends so far; None for lines with sums."""
        return None if self._end is None else ChainEnd(*self._end)

    def append(self, record: Mapping[str, Any], *, sync: bool = False) -> None:
        """Append one line of plain JSON values; with ``sync`` it is on the disk before this returns.

        Raises:
            OSError: the disk takes no more; only the first time, so that what makes the machine safe is not held up.
        """
        if self._file is None or self._full:
            return
        body = _encoded(record).encode()
        try:
            if self._begun is not None:
                self._settle()
            line = checked(body) if self._end is None else self._linked(self._end, body)
            if os.write(self._file, line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if self._begun is not None:
                self._end, self._begun = self._begun[1], None
            if sync:
                os.fdatasync(self._file)
        except OSError as error:
            self._full = True
            raise OSError(error.errno, error.strerror, str(self._path)) from error

    def _linked(self, before: tuple[int, str], body: bytes) -> bytes:
        lines, head = before
        check = link(head, body)
        line = _line(check, body)
        self._begun = (line, (lines + 1, check))
        return line

    def _settle(self) -> None:
        """Take note of the line that was begun, if it is whole: Ctrl-C may have come between the two."""
        if self._file is not None and self._begun is not None:
            line, end = self._begun
            start = os.fstat(self._file).st_size - len(line)
            if start >= 0 and os.pread(self._file, len(line), start) == line:
                self._end = end
            self._begun = None

    def go_on_in(self, path: Path) -> None:
        """From now on append to another file, which is there already."""
        if self._file is not None:
            other = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CLOEXEC)
            os.dup2(other, self._file, inheritable=False)
            os.close(other)
        self._path = path

    def close(self) -> None:
        """Bring it to the disk; a second call does nothing."""
        if self._file is None:
            return
        with contextlib.suppress(OSError):
            self._settle()
        file, self._file = self._file, None
        try:
            if not self._full:
                os.fdatasync(file)
        finally:
            os.close(file)


def checked(body: bytes) -> bytes:
    """One line with its sum, from the bytes of its JSON."""
    return _line(_sum(body), body)


def link(before: str, body: bytes) -> str:
    """The link of a line, from that of the line before and the bytes of its JSON."""
    return hashlib.sha256(before.encode() + b" " + body).hexdigest()[:LINK_DIGITS]


def linked(before: ChainEnd, body: bytes) -> tuple[ChainEnd, bytes]:
    """Where a chain ends with one line more, and that line, from the bytes of its JSON."""
    after = ChainEnd(before.lines + 1, link(before.head, body))
    return after, _line(after.head, body)


def _sum(body: bytes) -> str:
    return f"{zlib.crc32(body):08x}"


def _line(check: str, body: bytes) -> bytes:
    return b"%s %s\n" % (check.encode(), body)


@dataclass(frozen=True)
class Lines:
    """A file read back. ``damage`` says in words what was lost, None where nothing was."""

    records: list[dict[str, Any]]
    damage: str | None
    chain: ChainEnd | None
    """Where the chain ends; None for lines with sums."""


class LineReader:
    """Takes a file's lines in order, whole or as it grows, and judges each."""

    def __init__(self, path: Path, follows: str = "") -> None:
        """``follows`` is the link that the first line follows from, should the file be a chain."""
        self._path = path
        self._number = 0
        self._chain: ChainEnd | None = ChainEnd(0, follows)

    @property
    def number(self) -> int:
        """How many lines were taken."""
        return self._number

    @property
    def chain(self) -> ChainEnd | None:
        """Where the chain ends so far; None for lines with sums, and before the first line."""
        return self._chain if self._number else None

    def take(self, line: bytes) -> dict[str, Any]:
        """The record of a line, which is given without its end.

        Raises:
            ConfigError: it is not as it was written, or does not follow from the line before.
        """
        number = self._number + 1
        check, _, body = line.partition(b" ")
        if number == 1 and len(check) != LINK_DIGITS:
            self._chain = None
        if self._chain is None:
            if check != _sum(body).encode():
                raise ConfigError(
                    f"{self._path} line {number}: the checksum does not match; the file is damaged, restore it from "
                    "a copy"
                )
        elif check != link(self._chain.head, body).encode():
            before = f"line {self._number}" if self._number else "the header"
            raise ConfigError(
                f"{self._path} line {number}: does not follow from {before}: it was changed, or lines were removed or "
                "put in before it; the record is damaged, restore it from a copy"
            )
        else:
            self._chain = ChainEnd(number, check.decode())
        record: dict[str, Any] = json.loads(body)
        self._number = number
        return record


def read_lines(path: Path, follows: str = "") -> Lines:
    """All records; a torn last line, as a kill leaves it, is dropped.

    Args:
        path: of the file.
        follows: the link that the first line of a chain follows from.

    Raises:
        OSError: it cannot be read.
        ConfigError: a line that is not as it was written, or does not follow from the line before.
    """
    *lines, last = path.read_bytes().split(b"\n")
    reader = LineReader(path, follows)
    records = [reader.take(line) for line in lines]
    damage = None
    if last:
        try:
            records.append(reader.take(last))
        except ConfigError:
            number = len(lines) + 1
            damage = f"{path.name} line {number}: torn, as a killed process leaves it; the rest is whole"
    return Lines(records, damage, reader.chain)


def plain(value: Any, digits: int = 6) -> Any:
    """JSON of numpy and of floats, rounded; NaN and infinity become None, for JSON has neither."""
    if isinstance(value, Mapping):
        return {str(key): plain(item, digits) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), digits)
    if isinstance(value, list | tuple):
        return [plain(item, digits) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return round(float(value), digits) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
