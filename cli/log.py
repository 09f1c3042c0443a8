"""`--log FILE`: what happens in a run as JSON lines, for a lab's log collector; every line bears the run's id.

The record holds everything, in its own form; this is the part that a person would be told, as Loki, Elastic or
journald read it. It goes through Python's ``logging``, so that the warnings of libraries are in it as well.
"""

import errno
import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cli.output import for_people
from drivers.checked_lines import plain
from drivers.errors import ConfigError, MillError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from drivers.recorder import Recorder

LEVELS: Mapping[str, int] = {
    "state": logging.INFO,
    "stage": logging.INFO,
    "spindle": logging.INFO,
    "floor": logging.INFO,
    "idle": logging.INFO,
    "lap": logging.INFO,
    "stopped": logging.INFO,
    "done": logging.INFO,
    "reopened": logging.INFO,
    "stalled": logging.INFO,
    "calibration.verified": logging.INFO,
    "outcome": logging.INFO,
    "bad_reading": logging.WARNING,
    "latched": logging.ERROR,
    "error": logging.ERROR,
}
"""Kinds of event that are told; the others come many times a second."""

_log = logging.getLogger("mill")


class JsonLines(logging.Formatter):
    """One JSON object a line: time (UTC), level, run, logger, message, and the fields of an event."""

    def __init__(self, about: Mapping[str, Any]) -> None:
        super().__init__()
        self._about = dict(about)

    def format(self, record: logging.LogRecord) -> str:
        """A line without its end."""
        told = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            **self._about,
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "told", {}),
        }
        if record.exc_info:
            told["traceback"] = self.formatException(record.exc_info)
        return json.dumps(told, default=str)


class LogFile(logging.Handler):
    """Adds lines to a file that others may write to as well, each with one raw write that never waits for a reader.

    A file that takes no more costs the log, not the run.
    """

    def __init__(self, path: Path, on_loss: Callable[[str], None]) -> None:
        """Open it.

        Raises:
            OSError: it cannot be.
        """
        super().__init__()
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK | os.O_CLOEXEC
        self._path, self._on_loss = path, on_loss
        self._file: int | None = os.open(path, flags, 0o644)

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line, if none was refused yet."""
        if self._file is None:
            return
        line = self.format(record).encode() + b"\n"
        try:
            if os.write(self._file, line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self.close()
            self._on_loss(f"{self._path}: the log ends here ({error.strerror}); the run goes on")

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        super().close()
        if self._file is not None:
            os.close(self._file)
            self._file = None


class Logged:
    """A recorder that passes everything on, and logs what a person would be told."""

    def __init__(self, recorder: "Recorder") -> None:
        self._recorder = recorder

    def event(self, kind: str, **fields: Any) -> None:
        """Record, then log: numbers and words of the event; lists are for the record."""
        self._recorder.event(kind, **fields)
        level = LEVELS.get(kind)
        if level is None:
            return
        if kind == "outcome" and fields["outcome"] != "complete":
            level = logging.WARNING
        told = plain({key: value for key, value in fields.items() if isinstance(value, str | int | float | None)})
        words = [str(value) for value in told.values() if isinstance(value, str) and value]
        _log.log(level, ": ".join([kind, *words]), extra={"told": {"kind": kind, **told}})

    def frame(self, name: str, image: "npt.NDArray[np.uint8]") -> None:
        """Record."""
        self._recorder.frame(name, image)


@contextmanager
def logged(path: Path | None, on_loss: Callable[[str], None], **about: Any) -> "Iterator[None]":
    """While it lasts, ``logging`` goes into the file as well, each line with ``about``; without a path nothing does.

    Raises:
        ConfigError: the file cannot be opened.
    """
    if path is None:
        yield
        return
    try:
        handler = LogFile(path, on_loss)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror}); name another --log file") from error
    handler.setFormatter(JsonLines(about))
    root, level = logging.getLogger(), _log.level
    root.addHandler(handler)
    _log.setLevel(logging.INFO)
    try:
        _log.info("begins")
        yield
    except KeyboardInterrupt:
        _log.warning("interrupted")
        raise
    except MillError as error:
        _log.error(for_people(error))
        raise
    except Exception as error:
        _log.error(f"{type(error).__name__}: {error}", exc_info=True)
        raise
    finally:
        _log.setLevel(level)
        root.removeHandler(handler)
        handler.close()
