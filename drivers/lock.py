"""One process at a time on one device, and a name for the one that has it.

A lock file for each device is held with ``flock``: it binds root as well, and the kernel lets go of it when the process
dies, however it dies, so that a stale lock does not exist. The file tells who holds it. That is needed beside the
kernel's own exclusive mode of serial ports, which root ignores and which names nobody.
"""

import contextlib
import fcntl
import hashlib
import os
import sys
import tempfile
from pathlib import Path

from drivers.errors import DeviceBusyError

_SHARED_PLACES = (Path("/run/lock"), Path(tempfile.gettempdir()))
_START_TIME = 19
"""Its place in ``/proc/PID/stat`` behind the command name."""


class DeviceLock:
    """Held from construction until ``release()``.

    Raises:
        DeviceBusyError: another process, which the message names, holds the device.
    """

    def __init__(self, device: str) -> None:
        path = lock_path(device)
        self._fd = _open(path)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._fd)
            owner = _read(path) or "a process that did not leave its name"
            raise DeviceBusyError(
                f"{device}: in use by {owner} (lock file {path}); stop that process, or wait until it ends"
            ) from None
        self.sign(_command())

    @classmethod
    def inherited(cls, fd: int) -> "DeviceLock":
        """The lock that the process which started this one has taken, held for as long as either has it open."""
        lock = cls.__new__(cls)
        lock._fd = fd
        return lock

    def fileno(self) -> int:
        """The open lock file, to be handed to a process started by this one."""
        return self._fd

    def sign(self, command: str) -> None:
        """Write down that this process holds it, and what it is doing."""
        os.ftruncate(self._fd, 0)
        pid = os.getpid()
        os.pwrite(self._fd, f"pid {pid} ({command})\nstarted {_stat(pid)[_START_TIME]}\n".encode(), 0)

    def hand_over(self) -> None:
        """Leave it to the process that has inherited it; what is written there stays."""
        os.close(self._fd)
        self._fd = -1

    def release(self) -> None:
        """Let go; a second call does nothing."""
        if self._fd >= 0:
            os.ftruncate(self._fd, 0)
            os.close(self._fd)
            self._fd = -1


def lock_path(device: str) -> Path:
    """The lock file of a device, the same for every name that leads to it."""
    place = next(place for place in _SHARED_PLACES if os.access(place, os.W_OK))
    if "://" in device:
        # An address may hold a password, and be longer than a file's name.
        return place / f"mill-url-{hashlib.sha256(device.encode()).hexdigest()[:32]}.lock"
    return place / ("mill" + os.path.realpath(device).replace("/", "-") + ".lock")


def can_device(interface: str) -> str:
    """What the lock of a CAN network interface, which has no device node, is called."""
    return f"/sys/class/net/{interface}"


def udp_device(host: str, port: int) -> str:
    """What the lock of a device on the network, which has no device node, is called."""
    return f"/net/udp/{host}:{port}"


def owner_of(device: str) -> str | None:
    """Who holds the device, "pid 123 (mill run)", or None; takes and changes nothing."""
    path = lock_path(device)
    owner = _read(path)
    if owner is None:
        return None
    # What a killed process wrote is still there; it counts only while that very process lives.
    pid = int(owner.split()[1])
    with contextlib.suppress(OSError):
        started = path.read_text(errors="replace").splitlines()[1].removeprefix("started ")
        state, *_ = fields = _stat(pid)
        # A zombie holds nothing: it waits only for its parent to hear that it ended.
        if state != "Z" and started == fields[_START_TIME]:
            return owner
    return None


def holders_of(device: str, *, far_end: bool = True) -> str:
    """Which other processes have the device node open, "pid 123 (minicom)"; empty where none can be seen.

    Whoever serves a pty has it open too, and is to its users what an adapter is: ``far_end=False`` leaves it out.
    """
    node, own, found = os.path.realpath(device), str(os.getpid()), []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if process.name == own or not any(os.path.realpath(fd) == node for fd in (process / "fd").iterdir()):
                continue
            if far_end or not _serves(process, node):
                words = (process / "cmdline").read_bytes().rstrip(b"\0").split(b"\0")
                command = " ".join(word.decode(errors="replace") for word in words).replace("\n", " ")
                found.append(f"pid {process.name} ({command[:200]})")
    return ", ".join(found)


def _serves(process: Path, node: str) -> bool:
    """Whether a process has the other end of a pty."""
    if not node.startswith("/dev/pts/"):
        return False
    index = f"tty-index:\t{Path(node).name}\n"
    return any(index in info.read_text(errors="replace") for info in (process / "fdinfo").iterdir())


def _open(path: Path) -> int:
    flags = os.O_RDWR | os.O_CLOEXEC
    with contextlib.suppress(FileNotFoundError):
        # Without O_CREAT: the kernel's protection of sticky directories refuses that for another user's file.
        return os.open(path, flags)
    fd = os.open(path, flags | os.O_CREAT, 0o600)
    # Whoever may use the device may need to lock it after us.
    os.fchmod(fd, 0o666)
    return fd


def _read(path: Path) -> str | None:
    try:
        lines = path.read_text(errors="replace").splitlines()
    except OSError:
        return None
    return lines[0] if len(lines) == 2 and lines[0].startswith("pid ") else None


def _command() -> str:
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]).replace("\n", " ")[:200]


def _stat(pid: int) -> list[str]:
    """What the kernel says of a process, from its state on."""
    stat = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    # The command name may hold spaces and brackets; the fields that count follow the last bracket.
    return stat.rpartition(")")[2].split()
