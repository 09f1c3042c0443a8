r"""What people found out about a run afterwards: ``labels.jsonl`` beside its record, which stays as it is.

One line a label, in the order in which they were told; the newest of a name counts, and an empty value takes it back.
The lines are a chain that begins with the record's header (``drivers.checked_lines``). Each time the file is replaced
by one with the old lines and the new ones, so that it is never half written.
"""

import fcntl
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from drivers.checked_lines import ChainEnd, linked, read_lines
from drivers.errors import ConfigError
from milling.record import beginning, write_atomically

LABELS = "labels.jsonl"
MEANINGS: Mapping[str, tuple[str, ...]] = {"membrane": ("intact", "torn"), "flap": ("free", "attached")}
"""Labels whose values are the same in every lab; any other name takes a text."""
MOST_LETTERS = 1000
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")


@dataclass(frozen=True)
class Label:
    """One finding: ``date`` is UTC, ISO 8601."""

    date: str
    by: str
    name: str
    value: str


def checked_labels(found: Mapping[str, str]) -> dict[str, str]:
    """Names and values as they may be kept.

    Raises:
        ConfigError: a name or a value that may not.
    """
    kept = {}
    for name, text in found.items():
        value = " ".join(text.split())
        allowed = MEANINGS.get(name)
        if not _NAME.fullmatch(name):
            raise ConfigError(
                f"label {name!r}: a name is lower-case letters, digits and _, such as histology; correct it"
            )
        if value and allowed and value not in allowed:
            raise ConfigError(f"label {name}={value}: allowed {', '.join(allowed)}, or nothing to take it back")
        if len(value) > MOST_LETTERS or not value.isprintable():
            raise ConfigError(f"label {name}: {len(value)} letters, allowed {MOST_LETTERS} printable ones; shorten it")
        kept[name] = value
    return kept


def add_labels(folder: Path, found: Mapping[str, str], *, by: str, date: str) -> None:
    """Add labels to a run's folder.

    Raises:
        ConfigError: one that may not be kept, or labels that are damaged; nothing was written.
        OSError: the disk takes no more; the old labels are there.
    """
    added = [Label(date, by, name, value) for name, value in checked_labels(found).items()]
    path = folder / LABELS
    with _alone(folder):
        _, end = _read(folder)
        text = path.read_bytes().rstrip(b"\n") + b"\n" if path.exists() else b""
        for label in added:
            body = json.dumps(asdict(label), ensure_ascii=False, separators=(",", ":")).encode()
            end, line = linked(end, body)
            text += line
        write_atomically(path, text)


def read_labels(folder: Path) -> list[Label]:
    """All labels in the order they were told.

    Raises:
        ConfigError: a line that was changed, or that does not follow from the line before.
    """
    return _read(folder)[0]


def newest(labels: list[Label]) -> dict[str, Label]:
    """The one of each name that counts."""
    last = {label.name: label for label in labels}
    return {name: label for name, label in sorted(last.items()) if label.value}


def _read(folder: Path) -> tuple[list[Label], ChainEnd]:
    path, start = folder / LABELS, beginning((folder / "header.json").read_bytes())
    if not path.exists():
        return [], ChainEnd(0, start)
    lines = read_lines(path, start)
    try:
        labels = [Label(**record) for record in lines.records]
    except TypeError:
        labels = []
    if not labels or lines.chain is None or lines.damage:
        raise ConfigError(f"{path}: {lines.damage or 'holds no labels'}; restore it from a copy")
    return labels, lines.chain


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two people who label the same run wait for each other."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
