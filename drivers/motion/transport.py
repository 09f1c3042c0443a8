"""The wires as the motion drivers see them: bytes in order, or datagrams."""

from typing import Protocol, runtime_checkable


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


@runtime_checkable
class SharedLine(SerialLine, Protocol):
    """A line whose incoming bytes another process may see first."""

    def read_through(self, file: int) -> None:
        """Read from this open file, which is the line's own from here on, until it ends; then from the wire again."""


class DatagramLine(Protocol):
    """Whole datagrams, which may get lost, doubled or overtaken. One reader; writers from any thread."""

    @property
    def name(self) -> str:
        """The address or name that error messages show."""

    def write(self, data: bytes) -> None:
        """Send ``data`` as one datagram; never waits behind a reader.

        Raises:
            ConnectionLostError: nobody is there.
        """

    def read(self, timeout_s: float) -> bytes:
        """One datagram, waiting up to ``timeout_s`` for it; b"" when none came.

        Raises:
            ConnectionLostError: nobody is there.
        """

    def close(self) -> None:
        """Give the line back; a second call does nothing."""
