"""A serial line as the motion drivers see it."""

from typing import Protocol


class SerialLine(Protocol):
    """Bytes in order, no framing. One reader; writers from any thread."""

    @property
    def name(self) -> str:
        """The path or name that error messages show."""

    @property
    def descriptor(self) -> int | None:
        """The open file that another process may be handed; None where there is none."""

    def write(self, data: bytes) -> None:
        """Put bytes on the wire; never waits behind a reader.

        Raises:
            ConnectionLostError: the other side is gone.
        """

    def read(self, timeout_s: float) -> bytes:
        """Whatever has arrived, waiting up to ``timeout_s`` for the first byte; b"" when none came.

        Raises:
            ConnectionLostError: the other side is gone.
        """

    def close(self) -> None:
        """Give the line back; a second call does nothing."""
