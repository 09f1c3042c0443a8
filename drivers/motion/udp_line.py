"""A UDP socket as a ``DatagramLine``."""

import os
import select
import socket

from drivers.errors import ConnectionLostError
from drivers.lock import DeviceLock, udp_device

_LARGEST = 65_535


class UdpLine:
    """A socket that hears one peer only. Reading waits in ``select`` and holds nothing that a writer needs."""

    def __init__(self, host: str, port: int, opened: socket.socket, lock: DeviceLock) -> None:
        self._name = f"udp:{host}:{port}"
        self._socket = opened
        self._lock = lock
        self._open = True

    @property
    def name(self) -> str:
        """The peer's address."""
        return self._name

    @property
    def is_closed(self) -> bool:
        """Whether it was given back."""
        return not self._open

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def write(self, data: bytes) -> None:
        """Send one datagram; one that the system has no room for is lost, as any datagram may be."""
        self._require_open()
        try:
            self._socket.send(data)
        except BlockingIOError:
            return
        except OSError as error:
            raise self._gone(error) from error

    def read(self, timeout_s: float) -> bytes:
        """One datagram, waiting up to ``timeout_s`` for it."""
        self._require_open()
        try:
            if not select.select([self._socket], [], [], max(0.0, timeout_s))[0]:
                return b""
            return self._socket.recv(_LARGEST)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:
            self._require_open()
            raise self._gone(error) from error

    def close(self) -> None:
        """Give the socket and its lock back."""
        if self._open:
            self._open = False
            try:
                self._socket.close()
            finally:
                self._lock.release()

    def _require_open(self) -> None:
        if not self._open:
            raise ConnectionLostError(f"{self._name}: the line was closed; open it again")

    def _gone(self, error: OSError | ValueError) -> ConnectionLostError:
        return ConnectionLostError(
            f"{self._name}: nobody is there ({error}); check the network cable, the controller's power and its address"
        )


def open_udp(host: str, port: int) -> UdpLine:
    """A line to one peer, for this process alone.

    Raises:
        ConnectionLostError: no such host, or no way to it.
        DeviceBusyError: another process, which the message names, speaks to that peer.
    """
    lock = DeviceLock(udp_device(host, port))
    try:
        return UdpLine(host, port, connected(host, port), lock)
    except BaseException:
        lock.release()
        raise


def connected(host: str, port: int) -> socket.socket:
    """A socket that hears one peer only, and never waits.

    Raises:
        ConnectionLostError: no such host, or no way to it.
    """
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.setblocking(False)
        opened.connect((host, port))
    except OSError as error:
        opened.close()
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error
        raise ConnectionLostError(
            f"udp:{host}:{port}: cannot be reached ({reason}); correct [motion] host and port, or look at the network"
        ) from error
    return opened
