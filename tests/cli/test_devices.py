"""`mill devices`: what is plugged in, by names that can be copied into a rig file."""

import json
import os
import pty
from collections.abc import Iterator
from pathlib import Path

import pytest
from mill_command import mill
from pytest_mock import MockerFixture
from rig_file import GOOD
from serial.tools.list_ports_common import ListPortInfo

from drivers.lock import DeviceLock


@pytest.fixture
def port() -> Iterator[str]:
    """A serial port that can be opened."""
    near, far = pty.openpty()
    yield os.ttyname(far)
    os.close(near)
    os.close(far)


def plug_in(mocker: MockerFixture, *devices: str) -> None:
    """The operating system lists these ports."""
    found = []
    for device in devices:
        info = ListPortInfo(device)
        info.vid, info.pid, info.serial_number, info.product = 0x1A86, 0x7523, "A50285BI", "USB2.0-Serial"
        found.append(info)
    mocker.patch("serial.tools.list_ports.comports", return_value=found)


def rows(said: str, device: str) -> list[str]:
    return [line for line in said.splitlines() if device in line.split()]


def test_a_port_is_one_line_with_what_tells_it_from_others(
    port: str, mocker: MockerFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    plug_in(mocker, port)
    assert mill("devices") == 0
    said = capsys.readouterr().out
    assert said.startswith("kind")
    (line,) = rows(said, port)
    assert line.split() == ["serial", port, "1a86:7523", "A50285BI", "USB2.0-Serial", "ready"]


def test_who_holds_a_port_and_what_became_of_one_are_said(
    port: str, mocker: MockerFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    plug_in(mocker, port, "/dev/ttyGONE")
    lock = DeviceLock(port)
    try:
        assert mill("devices") == 0
    finally:
        lock.release()
    said = capsys.readouterr().out
    assert f"held by pid {os.getpid()}" in rows(said, port)[0]
    assert "the device node is gone; plug it in again" in rows(said, "/dev/ttyGONE")[0]


def test_ports_of_a_rig_file_are_listed_too(
    port: str, tmp_path: Path, mocker: MockerFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    plug_in(mocker)
    rig = tmp_path / "rig.toml"
    rig.write_text(GOOD.replace("/dev/mill-spindle", port))
    assert mill("devices", "--rig", str(rig)) == 0
    assert rows(capsys.readouterr().out, port)[0].split() == ["serial", port, "ready"]


def test_results_for_machines_hold_the_same(
    port: str, tmp_path: Path, mocker: MockerFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    plug_in(mocker, port)
    assert mill("devices", "--json", "-") == 0
    printed = json.loads(capsys.readouterr().out)
    results = tmp_path / "devices.json"
    assert mill("devices", "--json", str(results)) == 0
    assert json.loads(results.read_text()) == printed
    assert port in capsys.readouterr().out
    (found,) = [device for device in printed["devices"] if device["path"] == port]
    assert printed["command"] == "devices"
    assert (found["kind"], found["usb_id"], found["serial_number"]) == ("serial", "1a86:7523", "A50285BI")
    assert (found["problem"], found["owner"]) == (None, None)


def test_a_place_that_takes_no_results_is_one_line(
    tmp_path: Path, mocker: MockerFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    plug_in(mocker)
    (tmp_path / "file").touch()
    assert mill("devices", "--json", str(tmp_path / "file" / "devices.json")) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert str(tmp_path / "file") in said.err
