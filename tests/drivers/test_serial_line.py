"""Ports as the operating system gives them: ptys here, and the failures of hardware that a pty has not."""

import contextlib
import errno
import os
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from pytest_mock import MockerFixture

from drivers.errors import ConnectionLostError, DeviceBusyError
from drivers.lock import owner_of
from drivers.motion.serial_line import open_serial


@pytest.fixture
def pty() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(master)
    yield master, os.ttyname(slave)
    os.close(slave)
    with contextlib.suppress(OSError):
        os.close(master)


def test_bytes_go_both_ways(pty: tuple[int, str]) -> None:
    master, path = pty
    line = open_serial(path, 115_200)
    assert line.name == path
    line.write(b"?\x18!~")
    assert os.read(master, 100) == b"?\x18!~"
    assert line.read(0.0) == b""
    os.write(master, b"ok\r\n")
    assert line.read(1.0) == b"ok\r\n"
    line.close()
    line.close()


def test_what_another_process_hands_on_is_read_until_it_hands_on_no_more(pty: tuple[int, str]) -> None:
    master, path = pty
    line = open_serial(path, 115_200)
    hears, hands_on = os.pipe()
    line.read_through(hears)
    os.write(master, b"from the wire")
    assert line.read(0.0) == b""
    os.write(hands_on, b"handed on")
    assert line.read(1.0) == b"handed on"
    os.write(hands_on, b"at last")
    os.close(hands_on)
    assert line.read(1.0) == b"at last"
    assert line.read(1.0) == b""
    assert line.read(1.0) == b"from the wire"
    line.close()


def test_one_who_hands_on_replaces_another_and_closing_forgets_both(pty: tuple[int, str]) -> None:
    line = open_serial(pty[1], 115_200)
    first, second = os.pipe(), os.pipe()
    line.read_through(first[0])
    line.read_through(second[0])
    line.close()
    for hears in (first[0], second[0]):
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(hears)
    os.close(first[1])
    os.close(second[1])


def test_a_second_opening_names_the_first(pty: tuple[int, str]) -> None:
    _, path = pty
    line = open_serial(path, 115_200)
    with pytest.raises(DeviceBusyError, match=f"{path}.*pid {os.getpid()}"):
        open_serial(path, 115_200)
    line.close()
    open_serial(path, 115_200).close()
    assert owner_of(path) is None


def test_an_absent_device_names_path_reason_and_next_step() -> None:
    with pytest.raises(ConnectionLostError, match=r"/dev/mill-absent: .*No such file or directory.*`mill devices`"):
        open_serial("/dev/mill-absent", 115_200)


def test_what_is_no_serial_port_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.touch()
    with pytest.raises(ConnectionLostError, match=f"{path}: cannot be opened"):
        open_serial(str(path), 115_200)
    assert owner_of(str(path)) is None


@pytest.mark.parametrize(
    ("code", "error", "step"),
    [
        (errno.EACCES, ConnectionLostError, "udev rules"),
        (errno.EAGAIN, DeviceBusyError, "fuser"),
        (errno.EBUSY, DeviceBusyError, "fuser"),
    ],
)
def test_what_the_system_refuses_is_explained(
    pty: tuple[int, str], mocker: MockerFixture, code: int, error: type[Exception], step: str
) -> None:
    _, path = pty
    mocker.patch("serial.Serial", side_effect=serial.SerialException(code, os.strerror(code)))
    with pytest.raises(error, match=f"{path}.*{step}"):
        open_serial(path, 115_200)
    assert owner_of(path) is None


def test_the_other_side_vanishing_is_told_at_reading_and_at_writing(pty: tuple[int, str]) -> None:
    master, path = pty
    line = open_serial(path, 115_200)
    os.close(master)
    with pytest.raises(ConnectionLostError, match=f"{path}.*gone"):
        line.read(1.0)
    with pytest.raises(ConnectionLostError, match=f"{path}.*gone"):
        line.write(b"!")
    line.close()


def test_a_wire_that_takes_nothing_is_gone(pty: tuple[int, str]) -> None:
    _, path = pty
    line = open_serial(path, 115_200)
    with pytest.raises(ConnectionLostError, match="took no byte"):
        line.write(b"?" * 1_000_000)
    line.close()


def test_a_closed_line_says_so(pty: tuple[int, str]) -> None:
    _, path = pty
    line = open_serial(path, 115_200)
    line.close()
    with pytest.raises(ConnectionLostError, match="closed"):
        line.read(0.0)
    with pytest.raises(ConnectionLostError, match="closed"):
        line.write(b"?")
