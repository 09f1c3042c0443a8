"""One question, one answer; urgent bytes in between."""

from drivers.clock import Clock
from drivers.errors import DeviceFaultError, DeviceTimeoutError
from drivers.motion.transport import SerialLine

HOLD, GO_ON, STOP = b"\x01", b"\x02", b"\x03"


class Wire:
    """One thread asks; ``urgent()`` from any."""

    def __init__(self, line: SerialLine, clock: Clock) -> None:
        self._line = line
        self._clock = clock
        self._received = b""

    @property
    def name(self) -> str:
        """The port, for messages."""
        return self._line.name

    @property
    def descriptor(self) -> int | None:
        """The open port, for a supervisor."""
        return self._line.descriptor

    def urgent(self, byte: bytes) -> None:
        """Write at once."""
        self._line.write(byte)

    def ask(self, question: str, *, within_s: float) -> str:
        """The answer to one line.

        Raises:
            DeviceTimeoutError: none in time.
            DeviceFaultError: the device refused.
        """
        self._line.write(question.encode() + b"\n")
        deadline_s = self._clock.now_s() + within_s
        while b"\n" not in self._received:
            remaining_s = deadline_s - self._clock.now_s()
            if remaining_s <= 0:
                raise DeviceTimeoutError(f"{self.name}: silent for {within_s:g} s after {question!r}; check the cable")
            self._received += self._line.read(remaining_s)
        answer, _, self._received = self._received.partition(b"\n")
        text = answer.decode("ascii", "replace")
        if text.startswith("no "):
            raise DeviceFaultError(f"{self.name}: {question!r} refused: {text.removeprefix('no ')}")
        return text

    def close(self) -> None:
        """Give the port back."""
        self._line.close()
