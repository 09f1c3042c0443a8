"""A UDP port for other processes: the far end of a datagram line."""

import contextlib
import socket

_LARGEST = 65_535


class UdpPort:
    """A port of its own on this machine. It answers whoever asked last; nobody here ever waits for one."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._peer: tuple[str, int] | None = None
        self._closed = False
        self.host, self.port = self._socket.getsockname()

    @property
    def path(self) -> str:
        """Host and port in one word."""
        return f"{self.host}:{self.port}"

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """The next datagram; b"" where there is none."""
        # A host that has gone is told by an error of the datagram sent to it, and is none of ours.
        with contextlib.suppress(BlockingIOError, ConnectionError):
            data, self._peer = self._socket.recvfrom(_LARGEST)
            return data
        return b""

    def write(self, data: bytes) -> None:
        """One datagram to whoever asked last."""
        if data and self._peer is not None:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                self._socket.sendto(data, self._peer)

    @property
    def closed(self) -> bool:
        """Whether the port has ended."""
        return self._closed

    def close(self) -> None:
        """End the port; a second call does nothing."""
        if not self._closed:
            self._closed = True
            self._socket.close()
