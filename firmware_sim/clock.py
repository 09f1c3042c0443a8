"""The virtual bench's clock: sleeping is what lets the world go on."""

import threading
from collections.abc import Callable

TICK_S = 0.002
"""The longest step that any board is asked to take at once."""


class SimClock:
    """A ``drivers.clock.Clock`` that stands still until somebody sleeps on it.

    Time advances in ticks of at most 2 ms, and at every tick each attached board is brought to the new time, in the
    order of attachment. The lock is held for one tick at a time, so that a second thread can put bytes on a wire
    while the first one waits for an answer; with one thread it costs nothing worth naming.
    """

    def __init__(self, start_s: float = 0.0) -> None:
        self.lock = threading.RLock()
        self._now_s = start_s
        self._boards: list[Callable[[float], None]] = []

    def attach(self, advance_to: Callable[[float], None]) -> None:
        """Bring ``advance_to(time_s)`` along from now on; it is called with times that never go back."""
        with self.lock:
            self._boards.append(advance_to)
            advance_to(self._now_s)

    def now_s(self) -> float:
        """Virtual seconds."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Let ``duration_s`` pass in the virtual world; zero or less returns at once."""
        if duration_s > 0:
            self.run_until(self._now_s + duration_s)

    def run_until(self, time_s: float) -> None:
        """Advance to ``time_s``; a time that has passed already returns at once."""
        while self._now_s < time_s:
            with self.lock:
                self._now_s = min(time_s, self._now_s + TICK_S)
                for advance_to in self._boards:
                    advance_to(self._now_s)
