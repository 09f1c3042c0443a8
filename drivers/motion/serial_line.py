"""A serial port or a pty as a ``SerialLine``, over pyserial.

pyserial opens and configures the port; bytes go through the file descriptor itself, because pyserial reconfigures the
port at every change of its timeout.
"""

import contextlib
import errno
import os
import select
import termios
from collections.abc import Iterator

import serial

from drivers.errors import ConnectionLostError, DeviceBusyError, DeviceError
from drivers.lock import DeviceLock, holders_of

_WRITE_S = 0.2
_CHUNK = 4096


class PortLine:
    """An open port. Reading waits in ``select`` and holds nothing that a writer needs."""

    def __init__(self, port: serial.Serial, lock: DeviceLock) -> None:
        self._port = port
        self._lock = lock
        self._fd = port.fileno()
        self._through: int | None = None
        self._open = True

    @property
    def name(self) -> str:
        """The path it was opened by."""
        return str(self._port.port)

    @property
    def descriptor(self) -> int | None:
        """The open port."""
        return self._fd if self._open else None

    def hand_on_at_once(self) -> None:
        """Tell a USB adapter that can do so to hold no short replies back; a pty has no such mode."""
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            self._port.set_low_latency_mode(True)

    def read_through(self, file: int) -> None:
        """Read what another process, which reads the wire, hands on; the wire itself again once it hands on no more."""
        self._hear_directly()
        self._through = file

    def write(self, data: bytes) -> None:
        """Put bytes on the wire; a wire that takes none for 0.2 s is gone."""
        while data:
            self._require_open()
            try:
                data = data[os.write(self._fd, data) :]
            except BlockingIOError:
                if not select.select([], [self._fd], [], _WRITE_S)[1]:
                    raise ConnectionLostError(
                        f"{self.name}: the wire took no byte for {_WRITE_S:g} s; unplug and replug the controller"
                    ) from None
            except OSError as error:
                raise self._gone(error) from error

    def read(self, timeout_s: float) -> bytes:
        """Whatever has arrived, waiting up to ``timeout_s`` for the first byte."""
        self._require_open()
        file = self._fd if self._through is None else self._through
        try:
            if not select.select([file], [], [], max(0.0, timeout_s))[0]:
                return b""
            data = os.read(file, _CHUNK)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:
            self._require_open()
            raise self._gone(error) from error
        if not data and file == self._through:
            self._hear_directly()
            return b""
        if not data:
            # Readable without a byte is how a pty and a pulled USB adapter say that nobody is there.
            raise self._gone(OSError(errno.EIO, "end of file"))
        return data

    def close(self) -> None:
        """Give the port and its lock back."""
        if self._open:
            self._open = False
            try:
                self._hear_directly()
                self._port.close()
            finally:
                self._lock.release()

    def _hear_directly(self) -> None:
        if self._through is not None:
            os.close(self._through)
            self._through = None

    def _require_open(self) -> None:
        if not self._open:
            raise ConnectionLostError(f"{self.name}: the port was closed; open it again")

    def _gone(self, error: OSError | ValueError) -> ConnectionLostError:
        return ConnectionLostError(
            f"{self.name}: the other side is gone ({error}); check cable and power, then `mill devices` and home again"
        )


def open_serial(port: str, baud: int, *, framing: str = "8N1") -> PortLine:
    """Open a port for this process alone; ``framing`` is data bits, parity (N, E, O) and stop bits.

    Raises:
        ConnectionLostError: absent or not openable; the message names path, reason and next step.
        DeviceBusyError: another process, which the message names, has it.
    """
    line = _open(port, baud, framing)
    line.hand_on_at_once()
    return line


@contextlib.contextmanager
def borrowed_serial(port: str, baud: int, *, framing: str = "8N1") -> Iterator[PortLine]:
    """A port for a few questions to whoever is there: its settings are afterwards what they were.

    Opening a port raises DTR, whoever opens it; some boards start anew on that.

    Raises:
        ConnectionLostError: absent or not openable; the message names path, reason and next step.
        DeviceBusyError: another process, which the message names, has it.
    """
    if holders := holders_of(port, far_end=False):
        raise DeviceBusyError(f"{port}: in use by {holders}; close that program, or ask again when it has ended")
    try:
        fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise ConnectionLostError(_absent(port, error)) from error
    try:
        try:
            found = termios.tcgetattr(fd)
        except termios.error as error:
            raise ConnectionLostError(_absent(port, OSError(errno.ENOTTY, os.strerror(errno.ENOTTY)))) from error
        with contextlib.closing(_open(port, baud, framing)) as line:
            try:
                yield line
            finally:
                # A port that was pulled meanwhile keeps no settings.
                with contextlib.suppress(termios.error):
                    termios.tcsetattr(fd, termios.TCSANOW, found)
    finally:
        os.close(fd)


def _open(port: str, baud: int, framing: str = "8N1") -> PortLine:
    # Before the lock, so that a wrong path is told as what it is.
    if not os.path.exists(port):  # noqa: PTH110  (a path as the user wrote it, not one of ours)
        raise ConnectionLostError(_absent(port, OSError(errno.ENOENT, os.strerror(errno.ENOENT))))
    lock = DeviceLock(port)
    try:
        opened = serial.Serial(port, baud, int(framing[0]), framing[1], int(framing[2]), timeout=0, exclusive=True)
    except (serial.SerialException, OSError) as error:
        lock.release()
        raise _refusal(port, error) from error
    return PortLine(opened, lock)


def _refusal(port: str, error: OSError) -> DeviceError:
    if error.errno in (errno.EAGAIN, errno.EBUSY):
        holders = holders_of(port) or f"another program that cannot be seen; `sudo fuser {port}` names it"
        return DeviceBusyError(f"{port}: in use by {holders}; close that program")
    return ConnectionLostError(_absent(port, error))


def _absent(port: str, error: OSError) -> str:
    if error.errno in (errno.EACCES, errno.EPERM):
        step = "install the udev rules (udev/README.md) and plug it in again, or ask for access to the port"
    else:
        step = "check cable and power, then run `mill devices` to see what is connected"
    return f"{port}: cannot be opened ({os.strerror(error.errno) if error.errno else error}); {step}"
