"""One picture of one camera, to tell which it is. The camera keeps the settings it has."""

import os
import re
from pathlib import Path

import cv2
import numpy as np

from drivers.camera.interface import Image
from drivers.camera.opencv import OpenCvSource
from drivers.clock import Clock
from drivers.errors import ConfigError, ConnectionLostError, DeviceTimeoutError
from drivers.lock import DeviceLock

WAIT_S = 5.0
SETTLING_PICTURES = 10
"""An automatic exposure is right after so many."""


def file_name(device_or_url: str) -> str:
    """The camera's name as that of a PNG file; what an address says before @ is left out."""
    name = re.sub(r"//[^/@]*@", "//", device_or_url) if "://" in device_or_url else Path(device_or_url).name
    return re.sub(r"[^A-Za-z0-9.]+", "-", name).strip("-.") + ".png"


def save_snapshot(device_or_url: str, path: Path, clock: Clock) -> None:
    """Write one picture as PNG.

    Raises:
        ConnectionLostError: the camera is absent or gives nothing.
        DeviceBusyError: another process, which the message names, has it.
        ConfigError: the file cannot be written.
    """
    image = snapshot(device_or_url, clock)
    good, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert good
    try:
        path.write_bytes(png.tobytes())
    except OSError as error:
        raise ConfigError(f"{path}: cannot write the picture: {error.strerror}; name another folder") from None


def snapshot(device_or_url: str, clock: Clock) -> Image:
    """One picture, (H, W, 3) uint8 RGB."""
    if "://" in device_or_url:
        # Size and rate are those of the server; the figures here tell only how old a picture without a stamp is.
        source = OpenCvSource(device_or_url, clock, size_px=(1, 1), fps=30.0)
        try:
            return source.wait_newer(clock.now_s(), WAIT_S)[0]
        finally:
            source.close()
    lock = DeviceLock(device_or_url)
    try:
        return _from_v4l2(device_or_url)
    finally:
        lock.release()


def _from_v4l2(path: str) -> Image:
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(round(WAIT_S)))
    capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
    try:
        if not capture.isOpened():
            raise ConnectionLostError(f"{path}: cannot be opened as a camera; close other programs that use it")
        for _ in range(SETTLING_PICTURES):
            good, image = capture.read()
            if not good:
                raise DeviceTimeoutError(f"{path}: no picture within {WAIT_S:g} s; check cable and hub")
    finally:
        capture.release()
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
