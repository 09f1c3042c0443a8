"""What is connected: serial ports, CAN interfaces and cameras, read from the system without opening any of them."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.lock import can_device, holders_of, owner_of, udp_device

_CAN_INTERFACE_TYPE = "280"
_STABLE_PLACES = ("dev", "dev/serial/by-id", "dev/serial/by-path", "dev/v4l/by-id", "dev/v4l/by-path")
"""udev's own links, and ours (udev/60-mill.rules), which lie in /dev itself."""


@dataclass(frozen=True)
class FoundDevice:
    """Something that a rig file could name."""

    kind: Literal["serial", "can", "camera", "robot"]
    path: str
    """The device node, a CAN interface, or a robot's HOST:PORT. It may change when the device is plugged in again."""
    stable_paths: tuple[str, ...]
    """Names that stay, ours first: what a rig file should use."""
    usb_id: str | None
    """Vendor and product, "1a86:7523"."""
    serial_number: str | None
    product: str | None
    problem: str | None
    """Why this process could not open it, and what to do."""
    owner: str | None
    """The mill process that holds it."""
    driver: str | None = None
    """The kernel's driver, "ch341"."""
    holder: str | None = None
    """The processes that have it open, of mill or not, as far as this user may see them."""

    @property
    def name(self) -> str:
        """What a rig file should call it."""
        return next(iter(self.stable_paths), self.path)

    @property
    def held_by(self) -> str | None:
        """Who has it, as far as known."""
        return self.owner or self.holder


def find_devices(
    named_ports: Iterable[str] = (),
    named_cameras: Iterable[str] = (),
    named_robots: Iterable[tuple[str, int]] = (),
    *,
    root: Path = Path("/"),
) -> list[FoundDevice]:
    """Everything found, and what was named: ports that no bus lists, such as ptys, cameras with a URL, robots."""
    robots = [
        FoundDevice("robot", f"{host}:{port}", (), None, None, None, None, owner_of(udp_device(host, port)))
        for host, port in named_robots
    ]
    return [*_serial_ports(named_ports, root), *_can_interfaces(root), *_cameras(named_cameras, root), *robots]


def _serial_ports(named_ports: Iterable[str], root: Path) -> Iterator[FoundDevice]:
    from serial.tools import list_ports

    listed = {os.path.realpath(port.device): port for port in list_ports.comports()}
    for port in sorted(listed.values(), key=lambda port: port.device):
        yield FoundDevice(
            kind="serial",
            path=port.device,
            stable_paths=_links_to(port.device, root),
            usb_id=None if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            serial_number=port.serial_number,
            product=port.product,
            problem=_problem(port.device),
            owner=owner_of(port.device),
            driver=_driver(root / "sys/class/tty" / Path(port.device).name),
            holder=_holder(port.device),
        )
    for path in named_ports:
        if os.path.realpath(path) not in listed and Path(path).exists():
            owner, holder = owner_of(path), _holder(path)
            yield FoundDevice("serial", path, (), None, None, None, _problem(path), owner, holder=holder)


def _can_interfaces(root: Path) -> Iterator[FoundDevice]:
    for interface in sorted((root / "sys/class/net").glob("*")):
        if _text(interface / "type") == _CAN_INTERFACE_TYPE:
            is_up = int(_text(interface / "flags") or "0", 16) & 1
            step = f"down; run `ip link set {interface.name} up type can bitrate 1000000` as root"
            yield FoundDevice(
                kind="can",
                path=interface.name,
                stable_paths=(),
                usb_id=_usb_id(interface / "device"),
                serial_number=_usb_text(interface / "device", "serial"),
                product=_usb_text(interface / "device", "product"),
                problem=None if is_up else step,
                owner=owner_of(can_device(interface.name)),
                driver=_driver(interface),
            )


def _cameras(named: Iterable[str], root: Path) -> Iterator[FoundDevice]:
    for node in sorted((root / "sys/class/video4linux").glob("video*")):
        # The other nodes of a camera hand out metadata, not pictures.
        if _text(node / "index") == "0":
            path = str(root / "dev" / node.name)
            yield FoundDevice(
                kind="camera",
                path=path,
                stable_paths=_links_to(path, root),
                usb_id=_usb_id(node / "device"),
                serial_number=_usb_text(node / "device", "serial"),
                product=_text(node / "name"),
                problem=_problem(path),
                owner=owner_of(path),
                driver=_driver(node),
                holder=_holder(path),
            )
    for url in named:
        if "://" in url:
            yield FoundDevice("camera", url, (), None, None, None, None, owner_of(url))


def _links_to(path: str, root: Path) -> tuple[str, ...]:
    target = os.path.realpath(path)
    links = (link for place in _STABLE_PLACES for link in sorted((root / place).glob("*")) if link.is_symlink())
    found = [str(link) for link in links if os.path.realpath(link) == target]
    return tuple(sorted(found, key=lambda link: not Path(link).name.startswith("mill-")))


def _driver(node: Path) -> str | None:
    """The driver of the hardware behind a node of /sys/class."""
    driver = node / "device/driver"
    return driver.resolve().name if driver.exists() else None


def _holder(path: str) -> str | None:
    return holders_of(path, far_end=False) or None


def _problem(path: str) -> str | None:
    if not Path(path).exists():
        return "the device node is gone; plug it in again"
    if not os.access(path, os.R_OK | os.W_OK):
        return "no permission; install the udev rules (udev/README.md) and plug it in again"
    return None


def _usb_id(device: Path) -> str | None:
    vendor, product = _usb_text(device, "idVendor"), _usb_text(device, "idProduct")
    return f"{vendor}:{product}" if vendor and product else None


def _usb_text(device: Path, name: str) -> str | None:
    """An attribute of the USB device that an interface of it belongs to."""
    return _text(device.resolve().parent / name) if device.exists() else None


def _text(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None
