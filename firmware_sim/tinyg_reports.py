"""What a g2core board reports by itself: queue reports when the room changes, status reports at their interval."""

from collections.abc import Mapping
from typing import Any

_DEFAULT = ("line", "posx", "posy", "posz", "feed", "vel", "stat")


class Reports:
    """Which values a status report has, and what was last said."""

    def __init__(self, now_s: float, room: int) -> None:
        """Those that the board begins with."""
        self.names: tuple[str, ...] = _DEFAULT
        self._last: Mapping[str, Any] = {}
        self._due_s = now_s
        self._room = room

    def queue(self, room: int, *, wanted: bool) -> list[dict[str, Any]]:
        """A queue report, where the room in the planner is another than before."""
        changed = room != self._room
        self._room = room
        return [{"qr": room}] if changed and wanted else []

    def is_due(self, now_s: float, interval_s: float) -> bool:
        """Whether it is time for a status report; the next one is due an interval later."""
        if now_s < self._due_s:
            return False
        self._due_s = now_s + interval_s
        return True

    def status(self, values: Mapping[str, Any], *, filtered: bool) -> list[dict[str, Any]]:
        """A status report, filtered down to what has changed."""
        said = {key: value for key, value in values.items() if not filtered or self._last.get(key) != value}
        self._last = values
        return [{"sr": said}] if said else []
