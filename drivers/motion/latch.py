"""A serial line with one reader that latches faults, and a ``halt()`` for every other thread.

There is no thread. Whoever calls pumps the wire, and everything that is counted or latched is its own. Another thread
may call ``urgent()`` and ``halt()`` at the same time: they write at once, and all that ``halt()`` leaves behind is two
marks, one before its bytes and one behind them (docs/decisions/0004).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

from drivers.clock import Clock
from drivers.errors import ConnectionLostError, DeviceFaultError
from drivers.motion.transport import SerialLine

_PUMP_S = 0.05


@dataclass(frozen=True)
class Fault:
    """What latched."""

    words: str
    position_lost: bool


_HALTED = Fault("halted by halt()", position_lost=False)


class LatchingLine(ABC):
    """What every conversation with a motion controller shares, whatever it speaks."""

    def __init__(self, line: SerialLine, clock: Clock, *, stop: bytes) -> None:
        """``stop`` are the bytes with which ``halt()`` stops the machine."""
        self._line = line
        self._clock = clock
        self._stop = stop
        self._lost: str | None = None
        self._latched: Fault | None = None
        # Appending is atomic and counting up is not, and two threads may halt at once.
        self._halts_begun: list[None] = []
        self._halts_done: list[None] = []
        self._halts_released = 0

    @abstractmethod
    def _receive(self, data: bytes) -> None:
        """Take in what has arrived."""

    @property
    def name(self) -> str:
        """The line's name, for messages."""
        return self._line.name

    @property
    def descriptor(self) -> int | None:
        """The line's open file, if another process may be handed one."""
        return self._line.descriptor

    @property
    def is_lost(self) -> bool:
        """Whether the wire is known to be gone."""
        return self._lost is not None

    @property
    def fault(self) -> Fault | None:
        """Latched: the controller stopped, or was stopped. Homing releases it."""
        return self._latched or (_HALTED if self._is_halted else None)

    @property
    def halts(self) -> int:
        """How many halts are over. Who releases asks first thing, so that none that comes later is forgotten."""
        return len(self._halts_done)

    def urgent(self, data: bytes) -> None:
        """Put real-time bytes on the wire now. From any thread."""
        self._line.write(data)

    def halt(self) -> None:
        """Stop in one write, and latch. From any thread. What happens to the position the controller says by itself."""
        # Before the bytes, so that no line is written behind them unseen.
        self._halts_begun.append(None)
        try:
            self._line.write(self._stop)
        finally:
            # A release that comes between the two releases nothing: the bytes may still reach the wire behind it.
            self._halts_done.append(None)

    def latch(self, words: str, *, position_lost: bool) -> None:
        """Latch a fault; the first one stays, but a position that is lost later is lost."""
        first = self.fault or Fault(words, position_lost)
        self._latched = replace(first, position_lost=first.position_lost or position_lost)

    def check(self) -> None:
        """Raise what has latched.

        Raises:
            ConnectionLostError: the wire is gone.
            DeviceFaultError: a fault is latched.
        """
        if self._lost is not None:
            raise ConnectionLostError(self._lost)
        if self.fault is not None:
            kept = "lost" if self.fault.position_lost else "kept"
            raise DeviceFaultError(f"{self.name}: {self.fault.words}; position {kept}; home() releases the latch")

    def pump(self, timeout_s: float) -> None:
        """Take in what has arrived, waiting up to ``timeout_s`` for the first byte."""
        if self._lost is not None:
            raise ConnectionLostError(self._lost)
        try:
            data = self._line.read(timeout_s)
        except ConnectionLostError as error:
            self._lost = str(error)
            self.latch("connection lost", position_lost=True)
            raise
        self._receive(data)

    def pump_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Pump until ``done()`` or the time is over; whether it was done. What arrived in time always counts."""
        deadline_s = self._clock.now_s() + timeout_s
        while not done():
            remaining_s = deadline_s - self._clock.now_s()
            self.pump(min(_PUMP_S, max(0.0, remaining_s)))
            if remaining_s <= 0:
                return done()
        return True

    def close(self) -> None:
        """Give the line back."""
        self._lost = self._lost or f"{self.name}: the controller was closed; open it again"
        self._line.close()

    @property
    def _is_halted(self) -> bool:
        return len(self._halts_begun) > self._halts_released

    def _release(self, halts: int) -> None:
        """Forget what has latched, and the first ``halts`` halts."""
        self._latched = None
        self._halts_released = halts
