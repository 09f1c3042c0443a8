"""A record as it grows: its events one by one, while another process writes it."""

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from drivers.checked_lines import LineReader
from milling.record import beginning, read_header


class Tail:
    """Reads a run's events in order; one line is in memory at a time."""

    def __init__(self, folder: Path) -> None:
        """Open a record, whole or growing.

        Raises:
            ConfigError: no run there.
        """
        self.folder = folder
        self.header = read_header(folder)
        self._path = folder / "events.jsonl"
        self._lines = LineReader(self._path, beginning((folder / "header.json").read_bytes()))
        self._file = self._path.open("rb")
        self._begun = b""

    @property
    def damage(self) -> str | None:
        """In words what a killed process left of its last line; None where the last line is whole."""
        return f"{self._path.name} line {self._lines.number + 1}: torn; the rest is whole" if self._begun else None

    def news(self) -> Iterator[dict[str, Any]]:
        """What was written since the last call. A line that is not whole yet waits for its end.

        Raises:
            ConfigError: a line is damaged.
        """
        while piece := self._file.readline():
            self._begun += piece
            if not self._begun.endswith(b"\n"):
                return
            line, self._begun = self._begun[:-1], b""
            yield self._lines.take(line)

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
