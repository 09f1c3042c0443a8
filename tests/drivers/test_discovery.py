import os
import subprocess
import sys
from pathlib import Path

import pytest
from pytest_mock import MockerFixture
from serial.tools.list_ports_common import ListPortInfo

from drivers.discovery import find_devices
from drivers.lock import DeviceLock, can_device, holders_of


@pytest.fixture
def root(tmp_path: Path, mocker: MockerFixture) -> Path:
    """A machine with an FTDI adapter, a CAN interface and a camera with two nodes, as sysfs shows them."""
    usb = tmp_path / "sys/devices/usb1"
    for name, attributes in {
        "1-2": {"idVendor": "1d50", "idProduct": "606f", "serial": "0042", "product": "candleLight"},
        "1-3": {"idVendor": "046d", "idProduct": "0825", "product": "Microscope"},
    }.items():
        (usb / name / f"{name}:1.0").mkdir(parents=True)
        for key, value in attributes.items():
            (usb / name / key).write_text(value + "\n")
        driver = tmp_path / "sys/bus/usb/drivers" / {"1-2": "gs_usb", "1-3": "uvcvideo"}[name]
        driver.mkdir(parents=True)
        (usb / name / f"{name}:1.0/driver").symlink_to(driver)
    port_node = tmp_path / "sys/class/tty/ttyUSB0/device"
    port_node.mkdir(parents=True)
    (tmp_path / "sys/bus/usb-serial/drivers/ftdi_sio").mkdir(parents=True)
    (port_node / "driver").symlink_to(tmp_path / "sys/bus/usb-serial/drivers/ftdi_sio")
    for interface, kind, flags in (("can0", "280", "0x1003"), ("can1", "280", "0x1002"), ("eth0", "1", "0x1003")):
        net = tmp_path / "sys/class/net" / interface
        net.mkdir(parents=True)
        (net / "type").write_text(kind + "\n")
        (net / "flags").write_text(flags + "\n")
        if interface == "can0":
            (net / "device").symlink_to(usb / "1-2/1-2:1.0")
    for index in (0, 1):
        node = tmp_path / f"sys/class/video4linux/video{index}"
        node.mkdir(parents=True)
        (node / "index").write_text(f"{index}\n")
        (node / "name").write_text("Microscope: USB\n")
        (node / "device").symlink_to(usb / "1-3/1-3:1.0")
    dev = tmp_path / "dev"
    (dev / "v4l/by-path").mkdir(parents=True)
    (dev / "serial/by-id").mkdir(parents=True)
    for name in ("ttyUSB0", "video0", "video1"):
        (dev / name).touch()
    (dev / "v4l/by-path/pci-usb-0:3:1.0").symlink_to("../../video0")
    (dev / "mill-left").symlink_to("video0")
    (dev / "serial/by-id/usb-FTDI").symlink_to("../../ttyUSB0")
    port = ListPortInfo(str(dev / "ttyUSB0"))
    port.vid, port.pid, port.serial_number, port.product = 0x0403, 0x6001, "A10NB2XY", "FT232R"
    mocker.patch("serial.tools.list_ports.comports", return_value=[port])
    return tmp_path


def test_each_kind_is_found_with_what_tells_it_apart(root: Path) -> None:
    port, can0, can1, camera = find_devices(root=root)
    assert (port.kind, port.usb_id, port.serial_number, port.product) == ("serial", "0403:6001", "A10NB2XY", "FT232R")
    assert port.stable_paths == (str(root / "dev/serial/by-id/usb-FTDI"),)
    assert (can0.kind, can0.path, can0.usb_id, can0.serial_number, can0.problem) == (
        "can",
        "can0",
        "1d50:606f",
        "0042",
        None,
    )
    assert "ip link set can1 up" in (can1.problem or "")
    assert (camera.kind, camera.path, camera.usb_id) == ("camera", str(root / "dev/video0"), "046d:0825")
    assert camera.stable_paths == (str(root / "dev/mill-left"), str(root / "dev/v4l/by-path/pci-usb-0:3:1.0"))
    assert all(device.problem is None for device in (port, camera))
    assert [device.driver for device in (port, can0, can1, camera)] == ["ftdi_sio", "gs_usb", None, "uvcvideo"]


def test_ports_that_no_bus_lists_are_found_by_name(root: Path) -> None:
    pty = root / "dev/pts7"
    pty.touch()
    link = root / "dev/mill-motion"
    link.symlink_to("ttyUSB0")
    found = find_devices([str(pty), str(root / "absent"), str(link)], root=root)
    assert [device.path for device in found if device.kind == "serial"] == [str(root / "dev/ttyUSB0"), str(pty)]


def test_the_owner_and_a_missing_permission_are_told(root: Path, mocker: MockerFixture) -> None:
    port = str(root / "dev/ttyUSB0")
    lock = DeviceLock(port)
    access = os.access
    mocker.patch("os.access", lambda path, mode: path != port and access(path, mode))
    found = find_devices(root=root)[0]
    lock.release()
    assert f"pid {os.getpid()}" in (found.owner or "")
    assert "udev/README.md" in (found.problem or "")


def test_a_holder_that_is_no_mill_process_is_told(root: Path) -> None:
    port = str(root / "dev/ttyUSB0")
    holder = [sys.executable, "-c", "import sys; sys.stdin.read()", "terminal"]
    with (
        Path(port).open() as node,
        subprocess.Popen(holder, stdin=subprocess.PIPE, pass_fds=[node.fileno()]) as process,
    ):
        found = find_devices(root=root)[0]
        process.communicate()
    assert (found.owner, found.problem) == (None, None)
    assert found.held_by == found.holder
    assert (found.holder or "").startswith(f"pid {process.pid} (")
    assert "terminal" in (found.holder or "")


def test_who_serves_a_pty_does_not_hold_it() -> None:
    server = "import os, pty, sys; m, s = pty.openpty(); print(os.ttyname(s), flush=True); sys.stdin.read()"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", server], stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        path = process.stdout.readline().strip()
        assert f"pid {process.pid} " in holders_of(path)
        assert [device.held_by for device in find_devices([path]) if device.path == path] == [None]
        process.communicate()


def test_cameras_with_an_address_are_listed_as_they_are_named(root: Path) -> None:
    *_, last = find_devices((), ["http://10.0.0.2/left", str(root / "dev/video0")], root=root)
    assert (last.kind, last.name) == ("camera", "http://10.0.0.2/left")


def test_the_owner_of_a_can_interface_is_told(root: Path) -> None:
    lock = DeviceLock(can_device("can0"))
    owners = {device.path: device.owner for device in find_devices(root=root) if device.kind == "can"}
    lock.release()
    assert f"pid {os.getpid()}" in (owners["can0"] or "")
    assert owners["can1"] is None


def test_a_node_that_is_gone_is_told(root: Path) -> None:
    (root / "dev/ttyUSB0").unlink()
    assert "plug it in" in (find_devices(root=root)[0].problem or "")


def test_this_machine_can_be_looked_at() -> None:
    assert all(device.path for device in find_devices())
