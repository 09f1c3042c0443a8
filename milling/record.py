r"""The run's record: a folder that tells the truth even when the process is killed.

    header.json       what ran: job, rig, versions, seed; written once, atomically
    events.jsonl      append-only, one raw ``write()`` per event; ``fdatasync`` on changes of state
    frames/*.jpg      pictures, at a bounded rate; the first thing dropped when the disk fills
    result.json       the outcome, written at close, atomically

A line of ``events.jsonl`` is ``CRC32 JSON\n``: eight hex digits over the JSON's bytes. Keys keep the order they were
given in, and numbers are rounded to the nanometre and microsecond, so that one seed gives the same bytes twice.
"""

import errno
import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from drivers.clock import Clock
from drivers.errors import ConfigError
from milling.eyes import RIGHT

SYNCED = frozenset(
    {"state", "contact", "stopped", "done", "reopened", "floor", "latched", "spindle", "outcome", "error", "trajectory"}
)
"""Kinds of event that are on the disk before the run goes on."""

SCHEMA = 1
_FRAME_PERIOD_S = 2.0


class RunRecorder:
    """A ``drivers.recorder.Recorder`` that writes one run's folder."""

    def __init__(
        self,
        folder: Path,
        header: Mapping[str, Any],
        clock: Clock,
        *,
        frame_period_s: float = _FRAME_PERIOD_S,
        on_loss: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Create the folder, which must not hold a run yet.

        Args:
            folder: where; created with its parents.
            header: JSON; ``schema`` is added.
            clock: stamps the events, relative to now.
            frame_period_s: at most one picture of a name in this time; those of the right eye, which nothing is
                decided from, never come closer than 2 s.
            on_loss: told once, in words, when the disk takes no more pictures.
        """
        self.folder = folder
        self._clock = clock
        self._start_s = clock.now_s()
        self._frame_period_s = frame_period_s
        self._frame_at_s: dict[str, float] = {}
        self._frames = 0
        self._frames_lost = False
        self._full = False
        self._on_loss = on_loss
        try:
            (folder / "frames").mkdir(parents=True, exist_ok=True)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
            self._file: int | None = os.open(folder / "events.jsonl", flags, 0o644)
        except FileExistsError as error:
            raise ConfigError(f"{folder}: holds a run already; choose another folder") from error
        write_atomically(folder / "header.json", {"schema": SCHEMA, **header})

    def event(self, kind: str, **fields: Any) -> None:
        """Append one event; on the disk before this returns where ``kind`` is a change of state.

        Raises:
            OSError: the disk takes no more; only the first time, so that what makes the machine safe is not held up.
        """
        if self._file is None or self._full:
            return
        record = {"t": round(self._clock.now_s() - self._start_s, 6), "kind": kind, **_plain(fields)}
        body = json.dumps(record, separators=(",", ":"), allow_nan=False).encode()
        line = b"%08x %s\n" % (zlib.crc32(body), body)
        try:
            if os.write(self._file, line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if kind in SYNCED:
                os.fdatasync(self._file)
        except OSError as error:
            self._full = True
            raise OSError(error.errno, error.strerror, str(self.folder / "events.jsonl")) from error

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Keep a picture unless one of this name was kept just now."""
        now_s = self._clock.now_s()
        period_s = max(self._frame_period_s, _FRAME_PERIOD_S) if name in RIGHT.values() else self._frame_period_s
        if self._file is None or now_s - self._frame_at_s.get(name, float("-inf")) < period_s:
            return
        import cv2

        self._frame_at_s[name] = now_s
        self._frames += 1
        path = f"frames/{self._frames:05d}-{name}.jpg"
        good, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])
        if not good:
            raise ValueError(f"a picture of shape {image.shape} cannot be kept as JPEG")
        try:
            (self.folder / path).write_bytes(data.tobytes())
        except OSError as error:
            if not self._frames_lost:
                self._frames_lost = True
                self._on_loss(f"{self.folder}: pictures are no longer kept ({error.strerror}); events still are")
            return
        self.event("frame", name=name, file=path)

    def close(self, result: Mapping[str, Any] | None = None) -> None:
        """Write the result, and close; a second call does nothing."""
        if self._file is None:
            return
        if not self._full:
            os.fdatasync(self._file)
        os.close(self._file)
        self._file = None
        if result is not None:
            write_atomically(self.folder / "result.json", _plain(result))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True)
class Run:
    """A record read back. ``damage`` says in words what was lost, None where nothing was."""

    folder: Path
    header: dict[str, Any]
    events: list[dict[str, Any]]
    result: dict[str, Any] | None
    damage: str | None

    def of_kind(self, kind: str) -> Iterator[dict[str, Any]]:
        """The events of one kind, in order."""
        return (event for event in self.events if event["kind"] == kind)


def read_run(folder: Path) -> Run:
    """Read a run's folder. A torn last line, as a kill leaves it, is dropped and named in ``damage``.

    Raises:
        ConfigError: no run there, or a line that is damaged in the middle of the record.
    """
    try:
        header = json.loads((folder / "header.json").read_text())
        lines = (folder / "events.jsonl").read_bytes().split(b"\n")
    except FileNotFoundError as error:
        raise ConfigError(f"{folder}: no run here ({Path(error.filename).name} is missing)") from error
    except ValueError as error:
        raise ConfigError(f"{folder}/header.json: {error}; the record is damaged, restore it from a copy") from error
    if header.get("schema") != SCHEMA:
        raise ConfigError(f"{folder}/header.json: schema {header.get('schema')!r}, this version reads {SCHEMA}")
    events: list[dict[str, Any]] = []
    damage = None
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        checksum, _, body = line.partition(b" ")
        if checksum == b"%08x" % zlib.crc32(body):
            events.append(json.loads(body))
        elif number == len(lines):
            damage = f"events.jsonl line {number}: torn, as a killed process leaves it; the rest is whole"
        else:
            raise ConfigError(
                f"{folder}/events.jsonl line {number}: the checksum does not match; the record is damaged, "
                "restore it from a copy"
            )
    result_file = folder / "result.json"
    try:
        result = json.loads(result_file.read_text()) if result_file.exists() else None
    except ValueError as error:
        raise ConfigError(f"{result_file}: {error}; the record is damaged, restore it from a copy") from error
    return Run(folder, header, events, result, damage)


def write_atomically(path: Path, content: Any) -> None:
    """Replace a JSON file so that a reader or a crash sees the old or the new one, never half."""
    temporary = path.with_suffix(".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        json.dump(content, file, indent=1, allow_nan=False)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _plain(value: Any) -> Any:
    """JSON of numpy and rounded floats; NaN and infinity become None, for JSON has neither."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return round(float(value), 6) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
