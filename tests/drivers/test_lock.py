import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.errors import DeviceBusyError
from drivers.lock import DeviceLock, lock_path, owner_of

HOLDER = (
    "import sys, drivers.lock; lock = drivers.lock.DeviceLock(sys.argv[1]); print('held', flush=True); sys.stdin.read()"
)


def hold_in_another_process(device: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, device], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


@pytest.fixture
def device(tmp_path: Path) -> str:
    return str(tmp_path / "ttyMILL0")


def test_the_owner_is_named(device: str) -> None:
    with hold_in_another_process(device) as process:
        with pytest.raises(DeviceBusyError, match=rf"{device}.*pid {process.pid} \(-c {device}\).*stop that process"):
            DeviceLock(device)
        assert owner_of(device) == f"pid {process.pid} (-c {device})"
        process.communicate()
    DeviceLock(device).release()
    assert owner_of(device) is None


def test_a_killed_owner_leaves_no_lock(device: str) -> None:
    with hold_in_another_process(device) as process:
        process.send_signal(signal.SIGKILL)
    assert lock_path(device).read_text(), "it had no time to clean up"
    assert owner_of(device) is None
    DeviceLock(device).release()


def test_one_process_cannot_have_it_twice(device: str) -> None:
    lock = DeviceLock(device)
    with pytest.raises(DeviceBusyError, match=f"pid {os.getpid()}"):
        DeviceLock(device)
    lock.release()
    lock.release()
    DeviceLock(device).release()


def test_every_name_of_a_device_leads_to_the_same_lock(tmp_path: Path, device: str) -> None:
    link = tmp_path / "mill-motion"
    link.symlink_to(device)
    lock = DeviceLock(str(link))
    with pytest.raises(DeviceBusyError):
        DeviceLock(device)
    lock.release()


def test_asking_who_owns_a_device_leaves_no_trace(device: str) -> None:
    assert owner_of(device) is None
    assert not lock_path(device).exists()


def test_a_lock_file_of_nonsense_is_nobodys(device: str) -> None:
    lock_path(device).write_text("pid x\n\n\n")
    assert owner_of(device) is None
    lock_path(device).write_text("pid\nstarted")
    assert owner_of(device) is None
    DeviceLock(device).release()
