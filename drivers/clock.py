"""Time is passed in: nothing in mill reads a clock that it was not given."""

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic seconds. On the virtual bench, sleeping is what lets the world go on."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start; never goes back."""

    def sleep_s(self, duration_s: float) -> None:
        """Let ``duration_s`` pass; zero or less returns at once."""


class SystemClock:
    """The machine's own monotonic clock, the one that frame and bus time stamps use."""

    def now_s(self) -> float:
        """CLOCK_MONOTONIC, in seconds."""
        return time.monotonic()

    def sleep_s(self, duration_s: float) -> None:
        """Sleep; zero or less returns at once."""
        if duration_s > 0:
            time.sleep(duration_s)
