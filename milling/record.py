r"""The run's record: a folder that tells the truth even when the process is killed.

    header.json       what ran: job, rig, versions, seed; written once, atomically
    events.jsonl      append-only, one raw ``write()`` per event; ``fdatasync`` on changes of state
    frames/*.jpg      pictures, at a bounded rate; the first thing dropped when the disk fills
    result.json       the outcome, written at close, atomically

``events.jsonl`` is a chain of lines (``drivers.checked_lines``) that begins with the header's bytes and ends where the
result says; a picture's event holds its SHA-256. Numbers are rounded to the nanometre and microsecond, so that one seed
gives the same bytes twice.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from drivers.checked_lines import ChainEnd, LineWriter, link, plain, read_lines
from drivers.clock import Clock
from drivers.errors import ConfigError
from milling.eyes import RIGHT

SYNCED = frozenset(
    {"state", "contact", "stopped", "done", "reopened", "floor", "latched", "spindle", "outcome", "error", "trajectory"}
)
"""Kinds of event that are on the disk before the run goes on."""

SCHEMA = 1
CHAIN = "chain"
"""Where ``result.json`` tells the number of events and the last one's link."""
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
        self._on_loss = on_loss
        text = json_text({"schema": SCHEMA, **header})
        try:
            (folder / "frames").mkdir(parents=True, exist_ok=True)
            self._lines = LineWriter(folder / "events.jsonl", follows=beginning(text))
        except FileExistsError as error:
            raise ConfigError(f"{folder}: holds a run already; choose another folder") from error
        write_atomically(folder / "header.json", text)

    def event(self, kind: str, **fields: Any) -> None:
        """Append one event; on the disk before this returns where ``kind`` is a change of state.

        Raises:
            OSError: the disk takes no more; only the first time, so that what makes the machine safe is not held up.
        """
        record = {"t": round(self._clock.now_s() - self._start_s, 6), "kind": kind, **plain(fields)}
        self._lines.append(record, sync=kind in SYNCED)

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Keep a picture unless one of this name was kept just now."""
        now_s = self._clock.now_s()
        period_s = max(self._frame_period_s, _FRAME_PERIOD_S) if name in RIGHT.values() else self._frame_period_s
        if not self._lines.is_open or now_s - self._frame_at_s.get(name, float("-inf")) < period_s:
            return
        import cv2

        self._frame_at_s[name] = now_s
        self._frames += 1
        path = f"frames/{self._frames:05d}-{name}.jpg"
        good, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])
        if not good:
            raise ValueError(f"a picture of shape {image.shape} cannot be kept as JPEG")
        jpeg = data.tobytes()
        try:
            (self.folder / path).write_bytes(jpeg)
        except OSError as error:
            if not self._frames_lost:
                self._frames_lost = True
                self._on_loss(f"{self.folder}: pictures are no longer kept ({error.strerror}); events still are")
            return
        self.event("frame", name=name, file=path, sha256=hashlib.sha256(jpeg).hexdigest())

    def vouch(self, file: str) -> None:
        """Bind another file of the folder to the record: that it changes later can be told."""
        data = (self.folder / file).read_bytes()
        self.event("file", file=file, sha256=hashlib.sha256(data).hexdigest())

    def close(self, result: Mapping[str, Any] | None = None) -> None:
        """Write the result, and close; a second call does nothing."""
        if not self._lines.is_open:
            return
        self._lines.close()
        if result is not None:
            end = self._lines.chain
            assert end is not None
            write_atomically(self.folder / "result.json", json_text(plain({**result, CHAIN: asdict(end)})))

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
    chain: ChainEnd | None = None
    """Where the chain of events ends; None in records that were written without one."""

    def of_kind(self, kind: str) -> Iterator[dict[str, Any]]:
        """The events of one kind, in order."""
        return (event for event in self.events if event["kind"] == kind)


def read_run(folder: Path) -> Run:
    """Read a run's folder. A torn last line, as a kill leaves it, is dropped and named in ``damage``.

    Raises:
        ConfigError: no run there, a line that is damaged or does not follow from the one before, or an end that is not
            the one that the result tells.
    """
    header, text = read_header(folder), (folder / "header.json").read_bytes()
    lines = read_lines(folder / "events.jsonl", beginning(text))
    result_file = folder / "result.json"
    result = _object_in(result_file) if result_file.exists() else None
    told, found = (result or {}).get(CHAIN), None if lines.chain is None else asdict(lines.chain)
    if told is not None and told != found:
        raise ConfigError(
            f"{folder}/events.jsonl line {len(lines.records)}: is not the end that result.json tells: lines were "
            "removed or put in there; the record is damaged, restore it from a copy"
        )
    return Run(folder, header, lines.records, result, lines.damage, lines.chain)


def read_header(folder: Path) -> dict[str, Any]:
    """What ran: the header of a run's folder.

    Raises:
        ConfigError: no run there, or of another schema.
    """
    for name in ("header.json", "events.jsonl"):
        if not (folder / name).is_file():
            raise ConfigError(f"{folder}: no run here ({name} is missing)")
    header = _object_in(folder / "header.json")
    if header.get("schema") != SCHEMA:
        raise ConfigError(f"{folder}/header.json: schema {header.get('schema')!r}, this version reads {SCHEMA}")
    return header


def beginning(header: bytes) -> str:
    """The link that the first event follows from, of the header's bytes."""
    return link("", header)


def json_text(content: Any) -> bytes:
    """JSON for people and machines."""
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def write_atomically(path: Path, text: bytes) -> None:
    """Replace a file so that a reader or a crash sees the old or the new one, never half."""
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _object_in(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}; the record is damaged, restore it from a copy") from error
    if not isinstance(content, dict):
        raise ConfigError(
            f"{path}: holds {type(content).__name__}, and a JSON object is due; the record is damaged, restore it from "
            "a copy"
        )
    return content
