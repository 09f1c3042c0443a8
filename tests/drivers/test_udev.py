"""The udev rules: as text everywhere, and by udev itself on recorded devices where it and umockdev are installed."""

import fnmatch
import os
import re
import shutil
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from string import Template

import pytest

UDEV = Path(__file__).parents[2] / "udev"
RULE_FILES = [UDEV / "60-mill.rules", UDEV / "61-mill-rig.rules"]

PAIR = re.compile(r'([A-Z]+)(?:\{([\w/]+)\})?(==|!=|\+=|:=|=)"([^"]*)"')
MATCHES = {"ACTION", "ATTR", "ATTRS", "DRIVER", "ENV", "KERNEL", "SUBSYSTEM", "SUBSYSTEMS"}
SETS = {"ATTR": {"="}, "ENV": {"="}, "GOTO": {"="}, "IMPORT": {"="}, "LABEL": {"="}, "NAME": {"="}} | {
    key: {"+="} for key in ("OPTIONS", "SYMLINK", "TAG")
}

ADAPTERS = {
    "CH340": ("1a86", "7523"),
    "FT232R": ("0403", "6001"),
    "FT231X": ("0403", "6015"),
    "CP2102": ("10c4", "ea60"),
    "Arduino Uno": ("2341", "0043"),
    "Teensy": ("16c0", "0483"),
    "STM32": ("0483", "5740"),
    "Pico": ("2e8a", "000a"),
    "CANable": ("16d0", "117e"),
    "CANable, older": ("ad50", "60c4"),
    "candleLight": ("1d50", "606f"),
}

Pair = tuple[str, str, str, str]


def rules(path: Path) -> list[list[Pair]]:
    """Each rule as its (key, attribute, operator, value), refusing what is not one."""
    found = []
    for line in path.read_text().splitlines():
        if line and not line.startswith("#"):
            parts = line.split(", ")
            pairs = [PAIR.fullmatch(part) for part in parts]
            assert all(pairs), f"{path.name}: {line}"
            found.append([(pair[1], pair[2] or "", pair[3], pair[4]) for pair in pairs if pair])
    return found


ALL_RULES = [rule for path in RULE_FILES for rule in rules(path)]


def ids_of(rule: list[Pair], attribute: str) -> set[str]:
    return {
        value
        for key, name, _, values in rule
        if key in {"ATTR", "ATTRS"} and name == attribute
        for value in values.split("|")
    }


@pytest.mark.parametrize("path", RULE_FILES, ids=lambda path: path.name)
def test_every_line_is_a_rule_with_known_keys(path: Path) -> None:
    for rule in rules(path):
        for key, _, operator, _ in rule:
            if operator in {"==", "!="}:
                assert key in MATCHES
            else:
                assert operator in SETS[key]


@pytest.mark.parametrize("path", RULE_FILES, ids=lambda path: path.name)
def test_every_jump_goes_forward_to_a_label(path: Path) -> None:
    seen: set[str] = set()
    for rule in reversed(rules(path)):
        for key, _, _, value in rule:
            if key == "LABEL":
                seen.add(value)
            if key == "GOTO":
                assert value in seen


def test_no_rule_opens_a_device_to_everybody() -> None:
    assert not any("MODE" in path.read_text() or "0666" in path.read_text() for path in RULE_FILES)
    tagged = [rule for rule in ALL_RULES if ("TAG", "", "+=", "uaccess") in rule]
    assert len(tagged) == 2


def test_the_tag_comes_before_udev_hands_out_access() -> None:
    assert all(path.name < "73-seat-late.rules" for path in RULE_FILES)


@pytest.mark.parametrize("adapter", ADAPTERS)
def test_every_adapter_is_named_and_left_alone_by_modem_manager(adapter: str) -> None:
    vendor, product = ADAPTERS[adapter]
    of_adapter = [
        rule for rule in ALL_RULES if vendor in ids_of(rule, "idVendor") and product in ids_of(rule, "idProduct")
    ]
    named = [
        rule
        for rule in of_adapter
        if any(key == "NAME" or (key, name) == ("ENV", "MILL_ROLE") for key, name, *_ in rule)
    ]
    assert len(named) == 1
    if adapter != "candleLight":
        assert any(("ENV", "ID_MM_DEVICE_IGNORE", "=", "1") in rule for rule in of_adapter)
    if adapter in {"Teensy", "STM32"}:
        assert ids_of(named[0], "product"), "a shared id needs the product's name as well"


def test_ftdi_adapters_hand_bytes_on_at_once() -> None:
    assert [("ATTR", "latency_timer", "=", "1")] in ALL_RULES


def test_cameras_are_taken_at_the_node_that_gives_pictures() -> None:
    names = [rule for rule in ALL_RULES if any(value in {"mill-left", "mill-right"} for *_, value in rule)]
    assert len(names) == 2
    assert all(("ATTR", "index", "==", "0") in rule for rule in names)


SOCKET = "pci-0000:00:14.0-usb-0:{port}:1.0"
BUS = "/devices/pci0000:00/0000:00:14.0/usb1"
HOST = f"""\
P: {BUS.removesuffix("/usb1")}
E: SUBSYSTEM=pci
E: DRIVER=xhci_hcd

P: {BUS}
E: SUBSYSTEM=usb
E: DEVTYPE=usb_device

"""


@dataclass(frozen=True)
class Plugged:
    """A device in a socket: what the kernel tells of it, and our names for it."""

    port: int
    node: str
    ids: tuple[str, str]
    product: str
    serial: str
    names: set[str]
    index: str = "0"

    @property
    def path(self) -> str:
        inner = f"video4linux/{self.node}" if self.is_camera else f"{self.node}/tty/{self.node}"
        return f"{BUS}/1-{self.port}/1-{self.port}:1.0/{inner}"

    @property
    def is_camera(self) -> bool:
        return self.node.startswith("video")

    @property
    def parents(self) -> list[dict[str, str]]:
        usb = {"SUBSYSTEM": "usb", "idVendor": self.ids[0], "idProduct": self.ids[1], "product": self.product}
        return [{"SUBSYSTEM": "usb"}, usb | ({"serial": self.serial} if self.serial else {})]

    def recorded(self) -> str:
        """As umockdev-record writes it."""
        attributes = "".join(f"A: {key}={value}\n" for key, value in self.parents[1].items() if key != "SUBSYSTEM")
        usb = f"{BUS}/1-{self.port}"
        own = f"A: index={self.index}\n" if self.is_camera else ""
        subsystem, major = ("video4linux", 81) if self.is_camera else ("tty", 188)
        return (
            f"{HOST}P: {usb}\nE: SUBSYSTEM=usb\nE: DEVTYPE=usb_device\n{attributes}\n"
            f"P: {usb}/1-{self.port}:1.0\nE: SUBSYSTEM=usb\nE: DEVTYPE=usb_interface\n"
            "A: bInterfaceNumber=00\nA: bInterfaceClass=ff\n\n"
            f"P: {self.path}\nN: {self.node}\nE: DEVNAME=/dev/{self.node}\nE: SUBSYSTEM={subsystem}\n"
            f"E: MAJOR={major}\nE: MINOR=0\n{own}"
        )


PLUGGED = {
    "CH340, by its socket": Plugged(
        4,
        "ttyUSB0",
        ("1a86", "7523"),
        "USB Serial",
        "",
        {"mill-motion", f"mill-motion-{SOCKET.format(port=4)}"},
    ),
    "FTDI, by its serial number": Plugged(
        4, "ttyUSB1", ("0403", "6001"), "FT232R", "A10NB2XY", {"mill-motion", "mill-motion-A10NB2XY"}
    ),
    "FT231X": Plugged(4, "ttyUSB1", ("0403", "6015"), "FT231X USB UART", "DN01", {"mill-motion", "mill-motion-DN01"}),
    "CP2102": Plugged(
        4,
        "ttyUSB0",
        ("10c4", "ea60"),
        "CP2102 USB to UART Bridge Controller",
        "0001",
        {"mill-motion", "mill-motion-0001"},
    ),
    "Arduino Uno": Plugged(4, "ttyACM0", ("2341", "0043"), "", "7543", {"mill-motion", "mill-motion-7543"}),
    "Teensy": Plugged(4, "ttyACM0", ("16c0", "0483"), "USB Serial", "88", {"mill-motion", "mill-motion-88"}),
    "Teensy with something else": Plugged(4, "ttyACM0", ("16c0", "0483"), "Keyboard", "88", set()),
    "Pico": Plugged(4, "ttyACM0", ("2e8a", "000a"), "Pico", "E660", {"mill-motion", "mill-motion-E660"}),
    "CANable, older": Plugged(4, "ttyACM1", ("ad50", "60c4"), "CANtact", "17", {"mill-spindle", "mill-spindle-17"}),
    "STM32 with grblHAL": Plugged(4, "ttyACM0", ("0483", "5740"), "grblHAL", "77", {"mill-motion", "mill-motion-77"}),
    "STM32 with something else": Plugged(4, "ttyACM0", ("0483", "5740"), "Oven", "77", set()),
    "CANable": Plugged(4, "ttyACM1", ("16d0", "117e"), "CANable", "0042", {"mill-spindle", "mill-spindle-0042"}),
    "left camera": Plugged(
        1, "video0", ("046d", "0825"), "Microscope", "", {"mill-left", f"mill-camera-{SOCKET.format(port=1)}"}
    ),
    "right camera": Plugged(
        2, "video2", ("046d", "0825"), "Microscope", "", {"mill-right", f"mill-camera-{SOCKET.format(port=2)}"}
    ),
    "a camera's other node": Plugged(1, "video1", ("046d", "0825"), "Microscope", "", set(), index="1"),
    "a modem": Plugged(4, "ttyUSB2", ("12d1", "1001"), "Modem", "", set()),
}


@pytest.mark.parametrize("device", PLUGGED.values(), ids=PLUGGED.keys())
def test_a_plugged_in_device_gets_its_names(device: Plugged, tmp_path: Path) -> None:
    """As the rules read, and as udev itself says where it, umockdev and namespaces are there to ask."""
    done = as_the_rules_read({"SUBSYSTEM": "video4linux" if device.is_camera else "tty", "index": device.index}, device)
    assert done.names == device.names
    assert ("uaccess" in done.tags) == bool(device.names)
    if device.names and not device.is_camera:
        assert done.properties["ID_MM_DEVICE_IGNORE"] == "1"
    said = said_by_udev(device, tmp_path)
    if said is not None:
        assert set(re.findall(r"mill\S*rules:\d+ LINK '([^']+)'", said)) == device.names
        if device.names:
            assert re.search(r"TAGS=\S*:uaccess:", said)
            assert device.is_camera or "ID_MM_DEVICE_IGNORE=1" in said


@pytest.mark.parametrize("adapter", ADAPTERS)
def test_modem_manager_is_told_at_the_usb_device_itself(adapter: str) -> None:
    """It asks there, and not at the port. A network interface is nothing that it greets."""
    vendor, product = ADAPTERS[adapter]
    own = {"SUBSYSTEM": "usb", "DEVTYPE": "usb_device", "idVendor": vendor, "idProduct": product}
    done = as_the_rules_read(own, PLUGGED["a modem"])
    assert done.properties.get("ID_MM_DEVICE_IGNORE") == (None if adapter == "candleLight" else "1")
    assert (done.names, done.tags) == (set(), set())


@pytest.mark.parametrize(("driver", "timer"), [("ftdi_sio", {"latency_timer": "1"}), ("ch341-uart", {})])
def test_the_latency_timer_is_set_where_the_driver_has_one(driver: str, timer: dict[str, str]) -> None:
    done = as_the_rules_read({"SUBSYSTEM": "usb-serial", "DRIVER": driver}, PLUGGED["FT231X"])
    assert done.attributes == timer


@pytest.mark.parametrize(("ids", "name"), [(("1d50", "606f"), "mill-spindle"), (("0bda", "8153"), "")])
def test_candle_light_is_a_network_interface_with_a_name(ids: tuple[str, str], name: str) -> None:
    done = as_the_rules_read({"SUBSYSTEM": "net"}, Plugged(4, "can0", ids, "adapter", "0042", set()))
    assert (done.interface_name, done.names) == (name, set())


@dataclass
class Done:
    """What the rules do to one device."""

    names: set[str] = field(default_factory=set)
    tags: set[str] = field(default_factory=set)
    properties: dict[str, str] = field(default_factory=dict)
    attributes: dict[str, str] = field(default_factory=dict)
    interface_name: str = ""


def as_the_rules_read(own: dict[str, str], device: Plugged) -> Done:
    """What becomes of one uevent; ``own`` is the node, ``device`` what it hangs on."""
    own = {"ACTION": "add"} | own
    imported = {"usb_id": {"ID_SERIAL_SHORT": device.serial}, "path_id": {"ID_PATH": SOCKET.format(port=device.port)}}
    done = Done()
    skip_to = ""
    for rule in ALL_RULES:
        if skip_to and ("LABEL", "", "=", skip_to) not in rule:
            continue
        skip_to = ""
        for key, name, operator, value in rule:
            if operator in {"==", "!="}:
                found = {
                    "ATTRS": [parent.get(name, "") for parent in device.parents],
                    "SUBSYSTEMS": [parent["SUBSYSTEM"] for parent in device.parents] + [own["SUBSYSTEM"]],
                    "ENV": [done.properties.get(name, own.get(name, ""))],
                    "ATTR": [own.get(name, "")],
                }.get(key, [own.get(key, "")])
                matched = any(fnmatch.fnmatchcase(text, glob) for text in found for glob in value.split("|"))
                if matched == (operator == "!="):
                    break
            elif key == "ENV":
                done.properties[name] = value
            elif key == "ATTR":
                done.attributes[name] = value
            elif key == "IMPORT":
                done.properties |= imported[value]
            elif key == "SYMLINK":
                done.names.add(Template(value.replace("$env", "$")).substitute(done.properties))
            elif key == "TAG":
                done.tags.add(value)
            elif key == "NAME":
                done.interface_name = value
            elif key == "GOTO":
                skip_to = value
    return done


def said_by_udev(device: Plugged, tmp_path: Path) -> str | None:
    """In a mount namespace with our rules in place, and as nobody, for udevadm as root makes links in the real /dev."""
    recording = tmp_path / "device.umockdev"
    recording.write_text(device.recorded())
    as_nobody = "setpriv --reuid=65534 --regid=65534 --clear-groups" if os.geteuid() == 0 else ""
    script = f"""
        set -e
        command -v umockdev-run udevadm setpriv > /dev/null
        mount -t tmpfs -o mode=755 tmpfs /run
        mount --bind {UDEV} /etc/udev/rules.d
        cp {recording} /run/device.umockdev
        chmod 644 /run/device.umockdev
        echo ready
        cd /
        exec {as_nobody} umockdev-run --device /run/device.umockdev -- udevadm test --action=add /sys{device.path}
    """
    namespace = ["unshare", "--mount"] if os.geteuid() == 0 else ["unshare", "--map-root-user", "--mount"]
    if shutil.which("unshare") is None:
        return None
    done = subprocess.run([*namespace, "sh", "-c", script], capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    if "ready" not in done.stdout:
        return None
    assert "DEVPATH=" in said, said
    complaints = [
        line for line in said.splitlines() if re.search(r"6[01]-mill\S*rules:\d+ (Invalid|Unknown|Fail)", line)
    ]
    assert not complaints
    return said
