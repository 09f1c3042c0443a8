"""A V4L2 device through OpenCV: set up, read back, and its pictures as JPEGs with the kernel's own time stamps."""

import contextlib
import errno
import fcntl
import math
import os
import struct
from pathlib import Path

import cv2
import numpy as np

from drivers.camera import jpeg
from drivers.camera.interface import Image
from drivers.clock import Clock
from drivers.errors import ConfigError, ConnectionLostError, DeviceBusyError, DeviceFaultError, DeviceTimeoutError
from drivers.lock import holders_of

_BUFFERS = 2
_MANUAL_EXPOSURE = 1
_STAMP_TRUSTED_WITHIN_S = 5.0
_AT_ONCE_S = 0.5
"""A grab that fails sooner was refused by the kernel; OpenCV waits for a late picture in whole seconds."""
_FOURCC = cv2.VideoWriter.fourcc(*"MJPG")
_NO_SUCH_CONTROL = -1.0
"""What OpenCV reads from a control that the camera does not have."""

_REQBUFS = 0xC0145608
_NO_BUFFERS = struct.pack("=5I", 0, 1, 1, 0, 0)
"""VIDIOC_REQBUFS of <linux/videodev2.h>: no buffers, for capturing, mapped into memory."""


class V4l2Stream:
    """A V4L2 device that sends MJPEG: two uncompressed ones do not fit on one USB 2 bus."""

    def __init__(
        self,
        path: str,
        clock: Clock,
        timeout_s: float,
        size_px: tuple[int, int],
        fps: float,
        exposure: float | None,
        gain: float | None,
        white_balance_k: float | None,
    ) -> None:
        """Open the camera and set it up; a picture is waited for at most ``timeout_s``, rounded up to seconds.

        Raises:
            ConnectionLostError: not openable as a capture device.
            DeviceBusyError: another program takes pictures with it.
            ConfigError: a setting that the camera does not hold.
        """
        self._path = path
        self._clock = clock
        self._timeout_s = timeout_s
        self._format = f"MJPG {size_px[0]} x {size_px[1]} at {fps:g} fps"
        self._has_sent = False
        _require_free(path)
        # This backend has no time-outs of its own to set; it waits 10 s unless the environment says otherwise.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(math.ceil(timeout_s)))
        self._capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
        try:
            if not self._capture.isOpened():
                raise ConnectionLostError(
                    f"{path}: cannot be opened as a V4L2 capture device; close other programs that use it, and check "
                    "that it is the capture node and not the metadata node (`v4l2-ctl --list-devices`)"
                )
            self._set("pixel format", cv2.CAP_PROP_FOURCC, _FOURCC)
            # OpenCV keeps the width back until it knows the height.
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
            self._set("height", cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
            self._check("width", cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
            self._set("fps", cv2.CAP_PROP_FPS, fps)
            self._set("buffers", cv2.CAP_PROP_BUFFERSIZE, _BUFFERS)
            self._set("conversion by OpenCV", cv2.CAP_PROP_CONVERT_RGB, 0)
            # Exposure is refused while it is automatic, colour temperature likewise.
            self._set("automatic exposure (1 = manual)", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
            self._set("exposure", cv2.CAP_PROP_EXPOSURE, exposure)
            self._set("gain", cv2.CAP_PROP_GAIN, gain)
            self._set("automatic white balance", cv2.CAP_PROP_AUTO_WB, 0)
            self._set("white_balance_k", cv2.CAP_PROP_WB_TEMPERATURE, white_balance_k)
        except BaseException:
            self._capture.release()
            raise

    def read(self) -> tuple[bytes | Image, float]:
        """The next whole picture, and when its exposure began.

        Raises:
            DeviceTimeoutError: none in time.
            ConnectionLostError: the camera is gone or broke off.
            DeviceFaultError: it refuses to stream, or its stamps are of another clock.
        """
        while True:
            asked_s = self._clock.now_s()
            if not self._capture.grab():
                raise self._failure(self._clock.now_s() - asked_s)
            self._has_sent = True
            stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if abs(self._clock.now_s() - stamp_s) > _STAMP_TRUSTED_WITHIN_S:
                raise DeviceFaultError(
                    f"{self._path}: stamps its pictures {stamp_s:.3f} s when CLOCK_MONOTONIC is "
                    f"{self._clock.now_s():.3f} s; without true stamps no picture can be called fresh"
                )
            good, raw = self._capture.retrieve()
            # A frame torn on the bus is dropped; the next one is a period away.
            if good and jpeg.is_whole(picture := np.asarray(raw, np.uint8).tobytes().rstrip(b"\0")):
                return picture, stamp_s

    def interrupt(self) -> None:
        """Nothing: the next picture, or the time-out, ends the wait."""

    def close(self) -> None:
        """Give the device back."""
        self._capture.release()

    def _failure(self, waited_s: float) -> DeviceTimeoutError | ConnectionLostError | DeviceFaultError:
        # OpenCV keeps the errno to itself; how long it waited, and what came before, tell the cases apart.
        if not Path(self._path).exists():
            return ConnectionLostError(f"{self._path}: the camera is gone; plug it in and open it again")
        if waited_s >= _AT_ONCE_S:
            return DeviceTimeoutError(f"{self._path}: no picture within {self._timeout_s:g} s")
        if self._has_sent:
            return ConnectionLostError(
                f"{self._path}: the camera broke off in the middle of its stream; check plug and hub, and open it again"
            )
        return DeviceFaultError(
            f"{self._path}: opens, but refuses to send {self._format}; as a rule the USB bus has no room left for it "
            "(ENOSPC, see `dmesg`); plug the cameras into two USB controllers, or lower [camera] size_px or fps"
        )

    def _set(self, name: str, key: int, value: float | None) -> None:
        if value is not None:
            self._capture.set(key, value)
            self._check(name, key, value)

    def _check(self, name: str, key: int, value: float) -> None:
        found = self._capture.get(key)
        if math.isclose(found, value, rel_tol=1e-3, abs_tol=1e-3):
            return
        shown = _fourcc_text if key == cv2.CAP_PROP_FOURCC else _number_text
        held = "the camera has no such control" if found == _NO_SUCH_CONTROL else f"reads back {shown(found)}"
        raise ConfigError(
            f"{self._path}: {name} set to {shown(value)} but {held}; `v4l2-ctl -d {self._path} --list-ctrls "
            "--list-formats-ext` shows what this camera allows for [camera]"
        )


def require_present(path: str) -> None:
    """Whether there is a node that may be opened.

    Raises:
        ConnectionLostError: there is not.
    """
    if not Path(path).exists():
        reason, step = "no such device", "plug the camera in, check the udev rules (udev/), then run `mill devices`"
    elif not os.access(path, os.R_OK | os.W_OK):
        reason, step = "permission denied", "install the udev rules (udev/) and plug the camera in again"
    else:
        return
    raise ConnectionLostError(f"{path}: cannot be opened ({reason}); {step}")


def identity(path: str) -> str:
    """The kernel's name for it and its serial number; the path where it has none."""
    node = Path("/sys/class/video4linux") / Path(path).resolve().name
    name = _first_line(node / "name") or "V4L2 camera"
    # video node -> USB interface -> USB device
    serial_number = _first_line((node / "device").resolve().parent / "serial")
    return f"{name} at {path}" if serial_number is None else f"{name} {serial_number}"


def _require_free(path: str) -> None:
    """Ask before OpenCV does, which waits out its time-out for each pixel format that a busy camera refuses."""
    with contextlib.suppress(OSError):  # what cannot be opened OpenCV finds as well
        node = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            fcntl.ioctl(node, _REQBUFS, _NO_BUFFERS)
        except OSError as error:
            if error.errno == errno.EBUSY:
                raise DeviceBusyError(
                    f"{path}: another program takes pictures with this camera: "
                    f"{holders_of(path) or 'one that cannot be seen from here'}; close it and try again"
                ) from None
        finally:
            os.close(node)


def _fourcc_text(code: float) -> str:
    return int(code).to_bytes(4, "little").decode("ascii", "backslashreplace")


def _number_text(value: float) -> str:
    return f"{value:g}"


def _first_line(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip() or None
    except OSError:
        return None
