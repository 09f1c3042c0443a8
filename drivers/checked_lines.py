r"""Append-only files of JSON lines that tell the truth even when the process is killed: run records and traces.

A line is ``CRC32 JSON\n``: eight hex digits over the JSON's bytes. Each is one raw ``write()``, so that a killed
process leaves at most its last line torn. Keys keep the order they were given in.
"""

import errno
import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import ConfigError

_encoded = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


class LineWriter:
    """Writes a file that was not there before. ``append`` may be called from any thread."""

    def __init__(self, path: Path) -> None:
        """Create it.

        Raises:
            FileExistsError: it is there.
            OSError: it cannot be made.
        """
        self._path = path
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
        self._file: int | None = os.open(path, flags, 0o644)
        self._full = False

    @property
    def is_open(self) -> bool:
        """Whether it was not closed yet."""
        return self._file is not None

    def append(self, record: Mapping[str, Any], *, sync: bool = False) -> None:
        """Append one line of plain JSON values; with ``sync`` it is on the disk before this returns.

        Raises:
            OSError: the disk takes no more; only the first time, so that what makes the machine safe is not held up.
        """
        if self._file is None or self._full:
            return
        line = checked(_encoded(record).encode())
        try:
            if os.write(self._file, line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if sync:
                os.fdatasync(self._file)
        except OSError as error:
            self._full = True
            raise OSError(error.errno, error.strerror, str(self._path)) from error

    def go_on_in(self, path: Path) -> None:
        """From now on append to another file, which is there already."""
        if self._file is not None:
            other = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
            os.dup2(other, self._file, inheritable=False)
            os.close(other)
        self._path = path

    def close(self) -> None:
        """Bring it to the disk; a second call does nothing."""
        if self._file is None:
            return
        file, self._file = self._file, None
        try:
            if not self._full:
                os.fdatasync(file)
        finally:
            os.close(file)


def checked(body: bytes) -> bytes:
    """One line of the file, from the bytes of its JSON."""
    return b"%08x %s\n" % (zlib.crc32(body), body)


def read_lines(path: Path) -> tuple[list[dict[str, Any]], str | None]:
    """All records, and in words what was lost: a torn last line, as a kill leaves it, is dropped.

    Raises:
        OSError: it cannot be read.
        ConfigError: a line that is damaged in the middle of the file.
    """
    lines = path.read_bytes().split(b"\n")
    records: list[dict[str, Any]] = []
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        checksum, _, body = line.partition(b" ")
        if checksum == b"%08x" % zlib.crc32(body):
            records.append(json.loads(body))
        elif number == len(lines):
            return records, f"{path.name} line {number}: torn, as a killed process leaves it; the rest is whole"
        else:
            raise ConfigError(
                f"{path} line {number}: the checksum does not match; the file is damaged, restore it from a copy"
            )
    return records, None


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
