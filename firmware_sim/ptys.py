"""A serial port for other processes: the far end of a pseudo-terminal."""

import contextlib
import fcntl
import os
import pty
import tty

PENDING_MAX = 4096
"""What waits for a host that does not read, beyond what the kernel keeps; as on a real port, more is lost."""


class SerialPty:
    """Raw bytes, no echo. The port survives hosts that close and open it again; nobody here ever waits for one."""

    def __init__(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._pending = bytearray()
        self._closed = False
        # Held open here, the slave keeps the port alive while no host has it.
        self.path = os.ttyname(self._slave)

    def fileno(self) -> int:
        """For select."""
        return self._master

    def read(self) -> bytes:
        """What the host has written."""
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        """Send to the host what fits; the rest waits for the next call."""
        if data and len(self._pending) < PENDING_MAX:
            self._pending += data
        if self._pending:
            with contextlib.suppress(BlockingIOError):
                del self._pending[: os.write(self._master, self._pending)]

    def occupy(self) -> None:
        """Have it open as another program does that wants it for itself alone (flock, as pyserial's exclusive mode)."""
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(self._slave, fcntl.LOCK_EX | fcntl.LOCK_NB)

    @property
    def closed(self) -> bool:
        """Whether the port has ended."""
        return self._closed

    def close(self) -> None:
        """End the port; a host that has it open reads an end of file. A second call does nothing."""
        if not self._closed:
            self._closed = True
            os.close(self._slave)
            os.close(self._master)
