"""The V4L2 side of OpenCvSource; OpenCV itself is feigned, since no V4L2 device can be made in a test."""

import os
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pytest_mock import MockerFixture

from drivers.camera.opencv import OpenCvSource
from drivers.camera.snapshot import SETTLING_PICTURES, save_snapshot
from drivers.clock import SystemClock
from drivers.errors import ConfigError, ConnectionLostError, DeviceBusyError, DeviceFaultError, DeviceTimeoutError
from drivers.lock import DeviceLock

CLOCK = SystemClock()
SETTINGS: dict[str, Any] = {"size_px": (96, 54), "fps": 30.0, "exposure": 150.0, "gain": 4.0, "white_balance_k": 4600.0}
JPEG = cv2.imencode(".jpg", np.full((54, 96, 3), (0, 0, 200), np.uint8))[1]


class FeignedCapture:
    """cv2.VideoCapture on a camera that keeps what it is told, except what ``holds`` says otherwise."""

    def __init__(
        self, holds: dict[int, float] | None = None, *, opens: bool = True, stamp_s: float | None = None
    ) -> None:
        self.properties: dict[int, float] = {cv2.CAP_PROP_FRAME_WIDTH: 640.0, cv2.CAP_PROP_FRAME_HEIGHT: 480.0}
        self.width = 640.0
        self.order: list[int] = []
        self.holds = holds or {}
        self.opens = opens
        self.stamp_s = stamp_s
        self.frame = np.concatenate([JPEG.reshape(1, -1), np.zeros((1, 40), np.uint8)], axis=1)
        self.pace = threading.Event()
        self.grabs = True
        self.released = 0

    def isOpened(self) -> bool:  # noqa: N802  (OpenCV's name)
        return self.opens

    def set(self, key: int, value: float) -> bool:
        self.order.append(key)
        if key == cv2.CAP_PROP_FRAME_WIDTH:  # as OpenCV does, it waits for the height
            self.width = value
            return True
        if key == cv2.CAP_PROP_FRAME_HEIGHT:
            self.properties[cv2.CAP_PROP_FRAME_WIDTH] = self.holds.get(cv2.CAP_PROP_FRAME_WIDTH, self.width)
        self.properties[key] = self.holds.get(key, value)
        return key not in self.holds

    def get(self, key: int) -> float:
        if key == cv2.CAP_PROP_POS_MSEC:
            return 1000 * (CLOCK.now_s() if self.stamp_s is None else self.stamp_s)
        return self.properties[key]

    def grab(self) -> bool:
        self.pace.wait(0.002)
        return self.grabs

    def retrieve(self) -> tuple[bool, Any]:
        return True, self.frame

    def release(self) -> None:
        self.released += 1


@pytest.fixture
def device(tmp_path: Path) -> str:
    path = tmp_path / "mill-left"
    path.touch()
    return str(path)


def feign(mocker: MockerFixture, *captures: FeignedCapture) -> Any:
    return mocker.patch("drivers.camera.opencv.cv2.VideoCapture", side_effect=captures)


def test_settings_are_written_in_the_order_that_cameras_need(mocker: MockerFixture, device: str) -> None:
    capture = FeignedCapture()
    opened = feign(mocker, capture)
    eye = OpenCvSource(device, CLOCK, **SETTINGS)
    opened.assert_called_once_with(device, cv2.CAP_V4L2)
    assert capture.order == [
        cv2.CAP_PROP_FOURCC,
        cv2.CAP_PROP_FRAME_WIDTH,
        cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS,
        cv2.CAP_PROP_BUFFERSIZE,
        cv2.CAP_PROP_CONVERT_RGB,
        cv2.CAP_PROP_AUTO_EXPOSURE,
        cv2.CAP_PROP_EXPOSURE,
        cv2.CAP_PROP_GAIN,
        cv2.CAP_PROP_AUTO_WB,
        cv2.CAP_PROP_WB_TEMPERATURE,
    ]
    assert capture.properties[cv2.CAP_PROP_FOURCC] == int.from_bytes(b"MJPG", "little")
    assert capture.properties[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert capture.properties[cv2.CAP_PROP_AUTO_WB] == 0
    image, _ = eye.wait_newer(CLOCK.now_s(), 5.0)
    assert image.shape == (54, 96, 3)
    assert image[27, 48, 0] > 190
    assert device in eye.identity
    eye.close()
    assert capture.released == 1


@pytest.mark.parametrize(
    ("key", "found", "words"),
    [
        (cv2.CAP_PROP_FOURCC, float(int.from_bytes(b"YUYV", "little")), "pixel format set to"),
        (cv2.CAP_PROP_FRAME_WIDTH, 640.0, "width set to 96 but reads back 640"),
        (cv2.CAP_PROP_FPS, 15.0, "fps set to 30 but reads back 15"),
        (cv2.CAP_PROP_AUTO_EXPOSURE, 3.0, "automatic exposure"),
        (cv2.CAP_PROP_EXPOSURE, 156.0, "exposure set to 150 but reads back 156"),
        (cv2.CAP_PROP_GAIN, 0.0, "gain set to 4"),
        (cv2.CAP_PROP_AUTO_WB, 1.0, "automatic white balance set to 0"),
        (cv2.CAP_PROP_WB_TEMPERATURE, 4000.0, "white_balance_k set to 4600"),
    ],
)
def test_a_setting_that_the_camera_does_not_hold_is_refused(
    mocker: MockerFixture, device: str, key: int, found: float, words: str
) -> None:
    capture = FeignedCapture({key: found})
    feign(mocker, capture)
    with pytest.raises(ConfigError, match=words) as refused:
        OpenCvSource(device, CLOCK, **SETTINGS)
    assert device in str(refused.value)
    assert "v4l2-ctl" in str(refused.value)
    assert capture.released == 1
    DeviceLock(device).release()  # nothing was left locked


def test_a_fixed_exposure_is_required(device: str) -> None:
    with pytest.raises(ConfigError, match=r"set \[camera\] exposure"):
        OpenCvSource(device, CLOCK, size_px=(96, 54), fps=30.0)


def test_an_absent_camera_names_path_reason_and_next_step(tmp_path: Path) -> None:
    path = str(tmp_path / "mill-right")
    with pytest.raises(
        ConnectionLostError, match=r"cannot be opened \(no such device\); plug the camera in"
    ) as refused:
        OpenCvSource(path, CLOCK, **SETTINGS)
    assert path in str(refused.value)


def test_a_forbidden_camera_says_so(mocker: MockerFixture, device: str) -> None:
    mocker.patch("drivers.camera.opencv.os.access", return_value=False)
    with pytest.raises(ConnectionLostError, match=r"permission denied\); install the udev rules"):
        OpenCvSource(device, CLOCK, **SETTINGS)


def test_a_node_that_does_not_capture_is_refused(mocker: MockerFixture, device: str) -> None:
    feign(mocker, FeignedCapture(opens=False))
    with pytest.raises(ConnectionLostError, match="metadata node"):
        OpenCvSource(device, CLOCK, **SETTINGS)


def test_two_users_of_one_camera_are_refused_by_name(mocker: MockerFixture, device: str) -> None:
    feign(mocker, FeignedCapture())
    eye = OpenCvSource(device, CLOCK, **SETTINGS)
    with pytest.raises(DeviceBusyError, match=f"pid {os.getpid()}"):
        OpenCvSource(device, CLOCK, **SETTINGS)
    eye.close()
    DeviceLock(device).release()


def test_stamps_of_another_clock_are_refused(mocker: MockerFixture, device: str) -> None:
    feign(mocker, FeignedCapture(stamp_s=0.0))
    eye = OpenCvSource(device, CLOCK, **SETTINGS)
    with pytest.raises(DeviceFaultError, match="CLOCK_MONOTONIC"):
        eye.wait_newer(-1.0, 5.0)
    eye.close()


def test_a_stalled_camera_is_opened_again_with_the_same_settings(mocker: MockerFixture, device: str) -> None:
    stalled, healthy = FeignedCapture(), FeignedCapture()
    stalled.grabs = False
    feign(mocker, stalled, healthy)
    eye = OpenCvSource(device, CLOCK, **SETTINGS)
    eye.wait_newer(0.0, 5.0)
    assert eye.reopenings == 1
    assert healthy.order == stalled.order
    eye.close()


def test_a_camera_that_comes_back_with_other_settings_is_a_fault(mocker: MockerFixture, device: str) -> None:
    stalled, other = FeignedCapture(), FeignedCapture({cv2.CAP_PROP_EXPOSURE: 20.0})
    stalled.grabs = False
    feign(mocker, stalled, other)
    eye = OpenCvSource(device, CLOCK, **SETTINGS)
    with pytest.raises(DeviceFaultError, match="exposure set to 150 but reads back 20"):
        eye.wait_newer(0.0, 5.0)
    eye.close()


def test_a_camera_that_only_stalls_is_given_up(mocker: MockerFixture, device: str) -> None:
    captures = [FeignedCapture() for _ in range(4)]
    for capture in captures:
        capture.grabs = False
    feign(mocker, *captures)
    eye = OpenCvSource(device, CLOCK, **SETTINGS)
    with pytest.raises(DeviceTimeoutError, match="no picture within"):
        eye.wait_newer(0.0, 5.0)
    assert eye.reopenings == 3
    eye.close()


def test_a_pulled_camera_is_lost_and_not_taken_again(mocker: MockerFixture, device: str) -> None:
    capture = FeignedCapture()
    opened = feign(mocker, capture)
    eye = OpenCvSource(device, CLOCK, **SETTINGS)
    eye.wait_newer(0.0, 5.0)
    Path(device).unlink()
    capture.grabs = False
    with pytest.raises(ConnectionLostError, match="the camera is gone"):
        eye.wait_newer(CLOCK.now_s() + 60, 5.0)
    assert opened.call_count == 1
    eye.close()


def test_a_driver_that_does_not_let_go_is_reported(mocker: MockerFixture, device: str) -> None:
    capture = FeignedCapture()
    hangs = threading.Event()
    mocker.patch.object(capture, "grab", side_effect=lambda: hangs.wait(20))
    mocker.patch("drivers.camera.opencv._JOIN_S", 0.05)
    feign(mocker, capture)
    eye = OpenCvSource(device, CLOCK, **SETTINGS)
    with pytest.raises(DeviceTimeoutError, match="does not let go within"):
        eye.close()
    hangs.set()
    eye._thread.join(5)
    eye._lock.release()  # type: ignore[union-attr]  (the process would have ended)


class Brightening(FeignedCapture):
    """A camera whose automatic exposure settles picture by picture."""

    def __init__(self, pictures: int, *, opens: bool = True) -> None:
        super().__init__(opens=opens)
        self.left = pictures
        self.level = 0

    def read(self) -> tuple[bool, Any]:
        self.left, self.level = self.left - 1, self.level + 20
        return self.left >= 0, np.full((54, 96, 3), (0, 0, self.level), np.uint8)


def test_a_picture_to_tell_cameras_apart_changes_no_setting(mocker: MockerFixture, device: str, tmp_path: Path) -> None:
    capture = Brightening(100)
    feign(mocker, capture)
    save_snapshot(device, tmp_path / "left.png", CLOCK)
    assert cv2.imread(str(tmp_path / "left.png"))[0, 0].tolist() == [0, 0, 20 * SETTLING_PICTURES]
    assert (capture.order, capture.released) == ([], 1)
    DeviceLock(device).release()


def test_no_picture_is_told_and_nothing_stays_locked(mocker: MockerFixture, device: str, tmp_path: Path) -> None:
    feign(mocker, Brightening(3), Brightening(0, opens=False))
    with pytest.raises(DeviceTimeoutError, match=f"{device}: no picture within"):
        save_snapshot(device, tmp_path / "left.png", CLOCK)
    with pytest.raises(ConnectionLostError, match="close other programs"):
        save_snapshot(device, tmp_path / "left.png", CLOCK)
    lock = DeviceLock(device)
    with pytest.raises(DeviceBusyError, match=f"pid {os.getpid()}"):
        save_snapshot(device, tmp_path / "left.png", CLOCK)
    lock.release()
