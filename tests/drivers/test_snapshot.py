"""A picture to tell cameras apart; the capture is feigned, as only its answers matter here."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pytest_mock import MockerFixture

from drivers.camera.snapshot import SETTLING_PICTURES, save_snapshot
from drivers.clock import SystemClock
from drivers.errors import ConnectionLostError, DeviceBusyError, DeviceTimeoutError
from drivers.lock import DeviceLock

CLOCK = SystemClock()


class Brightening:
    """A camera whose automatic exposure settles picture by picture, and that must not be set."""

    def __init__(self, pictures: int, *, opens: bool = True) -> None:
        self.left, self.opens = pictures, opens
        self.level = self.released = 0

    def isOpened(self) -> bool:  # noqa: N802  (OpenCV's name)
        return self.opens

    def read(self) -> tuple[bool, Any]:
        self.left, self.level = self.left - 1, self.level + 20
        return self.left >= 0, np.full((54, 96, 3), (0, 0, self.level), np.uint8)

    def release(self) -> None:
        self.released += 1


@pytest.fixture
def device(tmp_path: Path) -> str:
    path = tmp_path / "mill-left"
    path.touch()
    return str(path)


def feign(mocker: MockerFixture, *captures: Brightening) -> None:
    mocker.patch("drivers.camera.snapshot.cv2.VideoCapture", side_effect=captures)


def test_a_picture_to_tell_cameras_apart_changes_no_setting(mocker: MockerFixture, device: str, tmp_path: Path) -> None:
    capture = Brightening(100)
    feign(mocker, capture)
    save_snapshot(device, tmp_path / "left.png", CLOCK)
    assert cv2.imread(str(tmp_path / "left.png"))[0, 0].tolist() == [0, 0, 20 * SETTLING_PICTURES]
    assert capture.released == 1
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
