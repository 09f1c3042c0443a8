"""`mill devices` where it opens devices: asked, photographed, and written down as a rig file, on a served bench."""

import contextlib
import json
import os
import signal
import subprocess
import termios
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
from mill_command import mill
from pytest_mock import MockerFixture
from rig_file import GOOD
from served_bench import MILL, served_bench

from cli.config import GrblMotion, ModbusSpindleTable, load_rig
from cli.devices import watched
from cli.suggest import rig_suggestion
from drivers.camera.snapshot import file_name
from drivers.discovery import FoundDevice
from drivers.identify import Identified
from drivers.lock import DeviceLock, owner_of
from drivers.trace_file import read_trace
from firmware_sim.clock import SimClock


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with served_bench(tmp_path_factory.mktemp("bench")) as served:
        yield served.rig_file


@pytest.fixture(autouse=True)
def _nothing_else_is_plugged_in(mocker: MockerFixture) -> None:
    mocker.patch("serial.tools.list_ports.comports", return_value=[])


def ports(rig: Path) -> tuple[str, str]:
    config = load_rig(rig)
    assert isinstance(config.motion, GrblMotion)
    return config.motion.port, str(config.spindle.model_dump()["channel"])


def settings_of(port: str) -> list[object]:
    fd = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        return list(termios.tcgetattr(fd))
    finally:
        os.close(fd)


def test_devices_say_who_they_are_and_ports_are_left_as_they_were(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = [settings_of(port) for port in ports(bench)]
    assert mill("devices", "--rig", str(bench), "--identify", "--json", "-") == 0
    said = capsys.readouterr()
    found = {device["path"]: device for device in json.loads(said.out)["devices"]}
    motion, spindle = ports(bench)
    assert found[motion]["identified"]["role"] == "motion"
    assert found[motion]["identified"]["firmware"] == "1.1h"
    assert "SLCAN adapter V1013" in found[spindle]["identified"]["words"]
    assert "Grbl 1.1h" in said.err
    assert [settings_of(port) for port in ports(bench)] == before
    assert [owner_of(port) for port in ports(bench)] == [None, None]


def test_a_port_that_is_held_is_not_asked(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    motion, _ = ports(bench)
    lock = DeviceLock(motion)
    try:
        assert mill("devices", "--rig", str(bench), "--identify", "--json", "-") == 0
    finally:
        lock.release()
    found = {device["path"]: device for device in json.loads(capsys.readouterr().out)["devices"]}
    assert f"pid {os.getpid()}" in found[motion]["owner"]
    assert "identified" not in found[motion]


def test_a_suggested_rig_file_opens_the_bench(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new.toml"
    assert mill("devices", "--rig", str(bench), "--suggest", str(path)) == 0
    assert f"mill doctor --rig {path}" in capsys.readouterr().out
    config = load_rig(path)
    assert ports(path) == ports(bench)
    assert isinstance(config.motion, GrblMotion)
    assert config.motion.firmware == "1.1h"
    assert config.camera.model_dump()["left"] == load_rig(bench).camera.model_dump()["left"]
    assert mill("jog", "--rig", str(path)) == 0
    text = path.read_text()
    assert mill("devices", "--rig", str(bench), "--suggest", str(path)) == 2
    assert "not written over" in capsys.readouterr().err
    assert path.read_text() == text
    assert mill("devices", "--rig", str(bench), "--suggest") == 0
    assert capsys.readouterr().out == text


def test_an_inverter_of_the_rig_file_is_asked_at_its_own_speed_and_suggested_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = tmp_path / "asked.jsonl"
    with served_bench(tmp_path, ["--spindle", "modbus"]) as served:
        rig = str(served.rig_file)
        words = ("devices", "--rig", rig, "--identify", "--trace", str(trace), "--json", "-")
        assert mill(*words) == 0
        found = {device["path"]: device for device in json.loads(capsys.readouterr().out)["devices"]}
        config = load_rig(served.rig_file)
        assert isinstance(config.spindle, ModbusSpindleTable)
        assert isinstance(config.motion, GrblMotion)
        identified = found[config.spindle.port]["identified"]
        assert (identified["role"], identified["make"]) == ("spindle", "modbus")
        assert "Delta VFD, identity code" in identified["words"]
        assert mill("devices", "--rig", rig, "--suggest", str(tmp_path / "new.toml")) == 0
    suggested = load_rig(tmp_path / "new.toml").spindle
    assert isinstance(suggested, ModbusSpindleTable)
    same = {"port", "baud", "framing", "station"}
    assert suggested.model_dump(include=same) == config.spindle.model_dump(include=same)
    entries = read_trace(trace).entries
    assert {entry.wire for entry in entries} == {config.motion.port, config.spindle.port}
    asked = [
        entry.data.encode("latin-1") for entry in entries if (entry.wire, entry.kind) == (config.spindle.port, "out")
    ]
    read_holding_registers = 3
    assert [frame[1] for frame in asked] == [read_holding_registers] * 2, "nothing is written to it"
    assert mill("devices", "--trace", str(tmp_path / "other.jsonl")) == 2
    assert "add --identify or --suggest" in capsys.readouterr().err


def test_each_camera_gives_a_picture_under_its_name(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "pictures"
    assert mill("devices", "--rig", str(bench), "--pictures", str(folder), "--json", "-") == 0
    found = [device for device in json.loads(capsys.readouterr().out)["devices"] if device["kind"] == "camera"]
    assert len({device["picture"] for device in found}) == 2
    for device in found:
        assert Path(device["picture"]) == folder / file_name(device["path"])
        assert cv2.imread(device["picture"]).shape == (540, 960, 3)


def test_a_camera_that_gives_no_picture_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(GOOD.replace("/dev/mill-left", "http://127.0.0.1:9/left"))
    assert mill("devices", "--rig", str(rig), "--pictures", str(tmp_path / "pictures")) == 1
    assert "no picture: http://127.0.0.1:9/left" in capsys.readouterr().out
    assert list((tmp_path / "pictures").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("/dev/mill-left", "mill-left.png"),
        ("/dev/v4l/by-path/pci-0000:00:14.0-usb-0:1:1.0", "pci-0000-00-14.0-usb-0-1-1.0.png"),
        ("http://me:secret@10.0.0.2:81/left?size=1", "http-10.0.0.2-81-left-size-1.png"),
    ],
)
def test_pictures_are_called_after_cameras(name: str, file: str) -> None:
    assert file_name(name) == file


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--watch", "--identify"], "--watch opens nothing"),
        (["--suggest", "-", "--json", "-"], "both want stdout"),
    ],
)
def test_what_excludes_each_other_is_named(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("devices", *words) == 2
    assert says in capsys.readouterr().err


# --- rig files from what was found


def device(kind: str, path: str, *stable: str, product: str | None = None) -> FoundDevice:
    return FoundDevice(kind, path, stable, "1a86:7523", None, product, None, None, "ch341")  # type: ignore[arg-type]


SCOPE = 'Micro"scope\x1b\n'
GRBL = Identified("motion", "Grbl 1.1h", firmware="1.1h")
BENCHES: dict[str, tuple[list[FoundDevice], dict[str, Identified]]] = {
    "nothing": ([], {}),
    "one of each": (
        [
            device("serial", "/dev/ttyUSB0", "/dev/mill-motion"),
            device("can", "can0"),
            device("camera", "/dev/video0", "/dev/mill-camera-1", product=SCOPE),
        ],
        {"/dev/ttyUSB0": GRBL, "can0": Identified("spindle", "CANopen node 7", node_ids=(7,))},
    ),
    "more than needed": (
        [
            *(device("serial", f"/dev/ttyUSB{index}") for index in range(3)),
            *(device("camera", f"/dev/video{index}") for index in range(3)),
            device("can", "can1"),
        ],
        {
            "/dev/ttyUSB0": GRBL,
            "/dev/ttyUSB1": GRBL,
            "/dev/ttyUSB2": Identified(None, "nobody answered"),
            "can1": Identified(None, "no heartbeat within 2 s"),
        },
    ),
    "a g2core board": (
        [device("serial", "/dev/ttyACM0")],
        {"/dev/ttyACM0": Identified("motion", "g2core 101.03", firmware="101.03", make="tinyg")},
    ),
    "a robot": (
        [FoundDevice("robot", "192.168.0.1:5007", (), None, None, None, None, None)],
        {"192.168.0.1:5007": Identified("motion", "DENSO b-CAP 2.12", make="bcap")},
    ),
    "strange names": ([device("serial", '/dev/a"b\\c'), device("camera", "http://x/l")], {'/dev/a"b\\c': GRBL}),
}


@pytest.mark.parametrize("plugged", BENCHES.values(), ids=BENCHES.keys())
def test_whatever_is_found_the_rig_file_can_be_read(
    plugged: tuple[list[FoundDevice], dict[str, Identified]], tmp_path: Path
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(rig_suggestion(*plugged))
    load_rig(path)
    for found in plugged[0]:
        if found.kind == "robot":
            continue
        assert found.name in path.read_text().replace("\\\\", "\\").replace('\\"', '"')


def test_the_make_that_answered_is_the_backend(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    for name, backend in (("a g2core board", "tinyg"), ("a robot", "bcap"), ("one of each", "grbl")):
        path.write_text(rig_suggestion(*BENCHES[name]))
        motion = load_rig(path).motion.model_dump()
        assert motion["backend"] == backend
    path.write_text(rig_suggestion(*BENCHES["a robot"]))
    robot = load_rig(path).motion.model_dump()
    assert (robot["host"], robot["port"]) == ("192.168.0.1", 5007)


def test_what_is_known_is_used_and_the_rest_is_said(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text := rig_suggestion(*BENCHES["one of each"]))
    config = load_rig(path)
    spindle, camera = config.spindle.model_dump(), config.camera.model_dump()
    assert (spindle["interface"], spindle["channel"], spindle["node_id"]) == ("socketcan", "can0", 7)
    assert (camera["left"], camera["right"]) == ("/dev/mill-camera-1", "/dev/mill-right")
    assert "1 of 2 cameras found" in text
    text = rig_suggestion(*BENCHES["more than needed"])
    assert "# also found: /dev/ttyUSB1, Grbl 1.1h" in text
    assert "# also found: /dev/video2" in text
    assert "# /dev/ttyUSB2: nobody answered" in text
    assert text.count("none was found") == 0
    assert rig_suggestion([], {}).count("none was found") == 2


# --- watching


class Hands(SimClock):
    """A clock in whose seconds somebody plugs and pulls."""

    def __init__(self, *worlds: list[FoundDevice]) -> None:
        super().__init__()
        self.worlds = iter(worlds)
        self.now: list[FoundDevice] = next(self.worlds)

    def sleep_s(self, duration_s: float) -> None:
        super().sleep_s(duration_s)
        try:
            self.now = next(self.worlds)
        except StopIteration:
            raise KeyboardInterrupt from None


def test_plugging_and_pulling_is_noticed_within_a_second() -> None:
    port, camera = device("serial", "/dev/ttyUSB0"), device("camera", "/dev/video0")
    moved = device("serial", "/dev/ttyUSB1")
    clock = Hands([port], [port], [port, camera], [moved, camera], [moved])
    began_s, seen = clock.now_s(), []
    with contextlib.suppress(KeyboardInterrupt):
        for change, which, after_s in watched(lambda: clock.now, clock.now, clock):
            seen.append((change, which.path, round(after_s)))
    assert seen == [
        ("plugged", "/dev/video0", 2),
        ("gone", "/dev/ttyUSB0", 3),
        ("plugged", "/dev/ttyUSB1", 3),
        ("gone", "/dev/video0", 4),
    ]
    assert clock.now_s() - began_s == pytest.approx(5.0)


def test_a_port_that_appears_while_watching_is_told_until_ctrl_c(tmp_path: Path) -> None:
    rig, port, results = tmp_path / "rig.toml", tmp_path / "ttyMOTION", tmp_path / "devices.json"
    rig.write_text(GOOD.replace("/dev/mill-motion", str(port)))
    pipe = subprocess.PIPE
    words = ["devices", "--watch", "--rig", str(rig), "--json", str(results)]
    # A shell that runs the tests in the background has its children ignore Ctrl-C.
    listening = ["env", "--default-signal=INT", *MILL, *words]
    with subprocess.Popen(listening, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        try:
            while "watching" not in process.stdout.readline():
                pass
            port.touch()
            assert process.stdout.readline().split()[:3] == ["plugged", "serial", str(port)]
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=20.0) == 0
        finally:
            process.kill()
    (change,) = json.loads(results.read_text())["changes"]
    assert (change["change"], change["device"]["path"]) == ("plugged", str(port))
