"""The V4L2 side of OpenCvSource, through OpenCV's own V4L2 code, on emulated cameras (``v4l2_device.py``).

The driver runs in a process of its own with ``v4l2_preload.c`` in front of the C library. It is compiled here; where
there is no C compiler, these tests are skipped.
"""

import errno
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import v4l2_structs as v4l2
from pytest_mock import MockerFixture
from v4l2_device import Knob, UsbBus, V4l2Device, shade_of

from drivers.camera.opencv import OpenCvSource
from drivers.clock import SystemClock
from drivers.errors import ConfigError, ConnectionLostError

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
COMPILER = shutil.which("cc")
CLOCK = SystemClock()
SIZE_PX = (960, 540)
SETTINGS: dict[str, Any] = {"size_px": SIZE_PX, "fps": 30.0, "exposure": 150, "gain": 4, "white_balance_k": 4600}
with_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc) for the emulated V4L2 device")


class Child:
    """``v4l2_child.py``, asked line by line."""

    def __init__(self, preload: Path) -> None:
        # One second is the least that OpenCV can wait.
        quick = {"LD_PRELOAD": str(preload), "PYTHONPATH": str(ROOT), "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT": "1"}
        command = [sys.executable, str(HERE / "v4l2_child.py")]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, **quick}, bufsize=0
        )

    def ask(self, name: str, *arguments: Any) -> Any:
        """What it answers, or ``(class, words)`` of the error that it raised."""
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(json.dumps([name, arguments]).encode() + b"\n")
        assert select.select([stdout], [], [], 30.0)[0], f"no answer to {name}{arguments}"
        outcome, result = json.loads(stdout.readline())
        return result if outcome == "ok" else (outcome, result)

    def open(self, device: V4l2Device, **settings: Any) -> Any:
        return self.ask("open", str(device.path), {**SETTINGS, **settings})

    def fails(self, name: str, *arguments: Any) -> tuple[str, str]:
        outcome = self.ask(name, *arguments)
        assert isinstance(outcome, tuple | list), f"{name} was to fail, but gave {outcome}"
        assert "\n" not in outcome[1]
        return outcome[0], outcome[1]

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture(scope="session")
def preload(tmp_path_factory: pytest.TempPathFactory) -> Path:
    assert COMPILER is not None
    library = tmp_path_factory.mktemp("v4l2") / "preload.so"
    flags = ["-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([COMPILER, *flags, "-o", library, HERE / "v4l2_preload.c", "-lpthread"], check=True)
    return library


@pytest.fixture(scope="module")
def process(preload: Path) -> Iterator[Child]:
    child = Child(preload)
    yield child
    child.end()


@pytest.fixture
def child(process: Child) -> Iterator[Child]:
    yield process
    process.ask("close")


@pytest.fixture
def plug(tmp_path: Path) -> Iterator[Any]:
    """Plugs a camera in; all are pulled at the end."""
    with ExitStack() as plugged:

        def plug_in(name: str = "mill-left", **properties: Any) -> V4l2Device:
            device = V4l2Device(tmp_path / name, **properties)
            plugged.callback(device.unplug)
            return device

        yield plug_in


def wait_until(done: Any) -> None:
    deadline_s = time.monotonic() + 10
    while not done():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


@with_compiler
def test_settings_are_held_and_manual_comes_before_what_it_releases(child: Child, plug: Any) -> None:
    device = plug()
    assert str(device.path) in child.open(device)
    wait_until(lambda: "streamon" in device.asked)
    assert (device.format, device.size_px, device.rate_fps) == ("MJPG", SIZE_PX, 30)
    held = {number: knob.value for number, knob in device.knobs.items()}
    assert held == {
        v4l2.EXPOSURE_AUTO: v4l2.EXPOSURE_MANUAL,
        v4l2.EXPOSURE: 150,
        v4l2.GAIN: 4,
        v4l2.WHITE_BALANCE_AUTO: 0,
        v4l2.WHITE_BALANCE_K: 4600,
    }
    assert {refusal for refusal in device.refused if refusal[0] != "dqbuf"} == set()


@with_compiler
@pytest.mark.parametrize(("size_px", "fps"), [((640, 480), 30), ((960, 540), 15)])
def test_the_sizes_and_rates_that_a_camera_has(child: Child, plug: Any, size_px: tuple[int, int], fps: int) -> None:
    device = plug()
    child.open(device, size_px=size_px, fps=fps)
    assert child.ask("wait_newer", 5.0)["size_px"] == list(size_px)
    assert (device.size_px, device.rate_fps) == (size_px, fps)


@with_compiler
def test_pictures_carry_the_time_when_their_own_exposure_began(child: Child, plug: Any) -> None:
    device = plug()
    child.open(device)
    for _ in range(5):
        picture = child.ask("wait_newer", 5.0)
        (number,) = (
            number for number, stamp_s in enumerate(device.stamps_s) if abs(stamp_s - picture["exposed_at_s"]) < 2e-6
        )
        assert abs(picture["shade"] - shade_of(number)) <= 1


@with_compiler
def test_a_slow_consumer_gets_the_newest_picture(child: Child, plug: Any) -> None:
    device = plug()
    child.open(device)
    child.ask("wait_newer", 5.0)
    seen = len(device.stamps_s)
    wait_until(lambda: len(device.stamps_s) > seen + 30)
    picture = child.ask("newest")
    # Two buffers hold pictures of some 0.07 s; a second lies behind a driver that hands them out in order.
    assert picture["now_s"] - picture["exposed_at_s"] < 0.5


@with_compiler
@pytest.mark.parametrize(
    ("control", "knob", "words"),
    [
        (v4l2.EXPOSURE, Knob(3, 2047, 3, step=10), "exposure set to 150 but reads back 143"),
        (v4l2.EXPOSURE, Knob(3, 2047, 3, automatic=(v4l2.GAIN, 99)), "exposure set to 150 but reads back 3"),
        (v4l2.EXPOSURE_AUTO, Knob(3, 3, 3), "automatic exposure (1 = manual) set to 1 but reads back 3"),
        (v4l2.GAIN, Knob(8, 100, 8), "gain set to 4 but reads back 8"),
        (v4l2.GAIN, None, "gain set to 4 but the camera has no such control"),
        (v4l2.WHITE_BALANCE_AUTO, Knob(1, 1, 1), "automatic white balance set to 0 but reads back 1"),
        (v4l2.WHITE_BALANCE_K, Knob(2800, 4000, 4000), "white_balance_k set to 4600 but reads back 4000"),
    ],
)
def test_a_control_that_the_camera_does_not_hold_is_refused(
    child: Child, plug: Any, control: int, knob: Knob | None, words: str
) -> None:
    device = plug()
    if knob is None:
        del device.knobs[control]
    else:
        device.knobs[control] = knob
    kind, message = child.open(device)
    assert kind == "ConfigError"
    assert f"{device.path}: {words}; `v4l2-ctl -d {device.path} --list-ctrls" in message
    device.knobs.clear()
    device.knobs.update(V4l2Device.fresh_knobs())
    assert str(device.path) in child.open(device)  # nothing was left open or locked


@with_compiler
@pytest.mark.parametrize(
    ("properties", "words"),
    [
        ({"formats": ("YUYV",)}, "pixel format set to MJPG but reads back YUYV"),
        ({"sizes_px": ((640, 540),)}, "width set to 960 but reads back 640"),
        ({"sizes_px": ((960, 480),)}, "height set to 540 but reads back 480"),
        ({"rates_fps": (15,)}, "fps set to 30 but reads back 15"),
    ],
)
def test_a_format_that_the_camera_does_not_have_is_refused(
    child: Child, plug: Any, properties: dict[str, Any], words: str
) -> None:
    kind, message = child.open(plug(**properties))
    assert kind == "ConfigError"
    assert words in message
    assert "--list-formats-ext` shows what this camera allows" in message


@with_compiler
def test_a_node_that_does_not_capture_is_refused(child: Child, plug: Any) -> None:
    device = plug()
    device.is_metadata_node = True
    kind, message = child.open(device)
    assert kind == "ConnectionLostError"
    assert "metadata node" in message


@with_compiler
def test_a_camera_of_another_program_is_refused_at_once(child: Child, plug: Any) -> None:
    device = plug()
    device.busy = True
    began_s = time.monotonic()
    kind, message = child.open(device)
    assert kind == "DeviceBusyError"
    assert "another program takes pictures with this camera" in message
    assert time.monotonic() - began_s < 5.0


@with_compiler
def test_two_users_of_one_camera_are_refused_by_name(child: Child, plug: Any) -> None:
    device = plug()
    child.open(device)
    kind, message = child.open(device)
    assert kind == "DeviceBusyError"
    assert f"pid {child.process.pid}" in message


@with_compiler
def test_two_cameras_on_one_bus_fit_as_mjpg_and_not_uncompressed(child: Child, plug: Any) -> None:
    bus = UsbBus()
    left, right = plug("mill-left", bus=bus, sizes_px=(SIZE_PX,)), plug("mill-right", bus=bus, sizes_px=(SIZE_PX,))
    left.rates_fps = right.rates_fps = (15,)
    assert child.ask("grabs", str(left.path), "YUYV")
    assert not child.ask("grabs", str(right.path), "YUYV")
    assert ("streamon", errno.ENOSPC) in right.refused
    child.ask("close")
    child.open(left, fps=15)
    child.open(right, fps=15)
    pair = child.ask("capture_pair", SIZE_PX, 1 / 15)
    assert abs(pair["skew_s"]) <= 1 / 15


@with_compiler
def test_a_full_bus_is_told_and_what_to_do_about_it(child: Child, plug: Any) -> None:
    bus = UsbBus(bytes_per_s=40e6)
    left, right = plug("mill-left", bus=bus), plug("mill-right", bus=bus)
    left.mjpg_is_smaller_by = right.mjpg_is_smaller_by = 1
    child.open(left)
    child.ask("wait_newer", 5.0)
    child.open(right)
    kind, message = child.fails("wait_newer", 5.0)
    assert kind == "DeviceFaultError"
    assert f"{right.path}: opens, but refuses to send MJPG 960 x 540 at 30 fps" in message
    assert "USB bus has no room left for it (ENOSPC" in message
    assert "two USB controllers, or lower [camera] size_px or fps" in message


@with_compiler
def test_pictures_of_a_wrong_size_are_a_fault(child: Child, plug: Any) -> None:
    left, right = plug("mill-left"), plug("mill-right")
    right.picture_size_px = (640, 480)
    child.open(left)
    child.open(right)
    kind, message = child.fails("capture_pair", SIZE_PX, 1 / 30)
    assert kind == "DeviceFaultError"
    assert "(480, 640, 3)" in message
    assert "check [camera] size_px" in message


@with_compiler
def test_torn_pictures_are_dropped(child: Child, plug: Any) -> None:
    device = plug()
    child.open(device)
    child.ask("wait_newer", 5.0)
    device.torn = True
    exposed = len(device.stamps_s)
    wait_until(lambda: len(device.stamps_s) > exposed + 5)
    torn_from = device.stamps_s[exposed + 1]
    assert child.ask("newest")["exposed_at_s"] < torn_from
    device.torn = False
    assert child.ask("wait_newer", 5.0)["exposed_at_s"] > torn_from


@with_compiler
def test_stamps_of_another_clock_are_refused(child: Child, plug: Any) -> None:
    device = plug()
    device.stamp_offset_s = 1e6
    child.open(device)
    kind, message = child.fails("wait_newer", 5.0)
    assert kind == "DeviceFaultError"
    assert "CLOCK_MONOTONIC" in message


@with_compiler
def test_a_stalled_camera_is_opened_again_with_the_same_settings(child: Child, plug: Any) -> None:
    device = plug()
    child.open(device)
    child.ask("wait_newer", 5.0)
    openings = device.openings
    device.stalled = True
    device.knobs.update(V4l2Device.fresh_knobs())
    wait_until(lambda: device.openings > openings)
    device.stalled = False
    child.ask("wait_newer", 5.0)
    assert child.ask("reopenings") == 1
    assert device.knobs[v4l2.EXPOSURE].value == 150


@with_compiler
def test_a_camera_that_comes_back_with_other_settings_is_a_fault(child: Child, plug: Any) -> None:
    device = plug()
    child.open(device)
    child.ask("wait_newer", 5.0)
    device.stalled = True
    device.knobs[v4l2.EXPOSURE] = Knob(20, 20, 20)
    kind, message = child.fails("wait_newer", 5.0)
    assert kind == "DeviceFaultError"
    assert "exposure set to 150 but reads back 20" in message


@with_compiler
def test_a_camera_that_only_stalls_is_given_up(child: Child, plug: Any) -> None:
    device = plug()
    device.stalled = True
    child.open(device)
    kind, message = child.fails("wait_newer", 15.0)
    assert kind == "DeviceTimeoutError"
    assert "no picture within" in message
    assert child.ask("reopenings") == 3


@with_compiler
def test_a_pulled_camera_is_lost_and_not_taken_again(child: Child, plug: Any) -> None:
    device = plug()
    child.open(device)
    child.ask("wait_newer", 5.0)
    device.unplug()
    kind, message = child.fails("wait_newer", 5.0)
    assert kind == "ConnectionLostError"
    assert f"{device.path}: the camera is gone; plug it in" in message
    other = plug()
    assert child.fails("wait_newer", 0.5)[0] == "ConnectionLostError"
    assert other.openings == 0


@with_compiler
def test_a_camera_that_is_back_before_anybody_looked_is_not_taken_again_either(child: Child, plug: Any) -> None:
    device = plug()
    child.open(device)
    child.ask("wait_newer", 5.0)
    openings = device.openings
    device.hang_up.set()
    kind, message = child.fails("wait_newer", 5.0)
    assert kind == "ConnectionLostError"
    assert "broke off in the middle of its stream" in message
    assert device.openings == openings


@with_compiler
def test_a_camera_that_does_not_let_go_is_reported(preload: Path, plug: Any) -> None:
    device = plug()
    child = Child(preload)
    try:
        child.open(device)
        child.ask("wait_newer", 5.0)
        device.hangs.set()
        kind, message = child.fails("close")
        assert kind == "DeviceTimeoutError"
        assert "does not let go within 5 s; unplug the camera" in message
    finally:
        child.end()


def test_a_fixed_exposure_is_required(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"set \[camera\] exposure"):
        OpenCvSource(str(tmp_path), CLOCK, size_px=SIZE_PX, fps=30.0)


def test_an_absent_camera_names_path_reason_and_next_step(tmp_path: Path) -> None:
    path = str(tmp_path / "mill-right")
    with pytest.raises(
        ConnectionLostError, match=r"cannot be opened \(no such device\); plug the camera in"
    ) as refused:
        OpenCvSource(path, CLOCK, **SETTINGS)
    assert path in str(refused.value)


def test_a_forbidden_camera_says_so(mocker: MockerFixture, tmp_path: Path) -> None:
    mocker.patch("drivers.camera.v4l2.os.access", return_value=False)
    with pytest.raises(ConnectionLostError, match=r"permission denied\); install the udev rules"):
        OpenCvSource(str(tmp_path), CLOCK, **SETTINGS)
