"""One camera: a V4L2 device by its path, an MJPEG stream over HTTP, or any other URL that FFmpeg opens.

A thread of its own empties the camera as fast as it fills, so that the picture at hand is the newest one; JPEGs are
decoded when somebody asks for the picture, and only the newest. V4L2 cameras run at fixed exposure and white balance,
and every setting is read back; a URL's camera is set up on its own side.
"""

import atexit
import logging
import threading
from typing import Protocol

import cv2
import numpy as np

from drivers.camera import jpeg, v4l2
from drivers.camera.interface import Image
from drivers.camera.multipart import MultipartStream
from drivers.clock import Clock
from drivers.errors import (
    ConfigError,
    ConnectionLostError,
    DeviceError,
    DeviceFaultError,
    DeviceTimeoutError,
    MillError,
)
from drivers.lock import DeviceLock

_log = logging.getLogger(__name__)

_OPEN_S = 5.0
_READ_S = 2.0
_JOIN_S = 5.0
_REOPENINGS_IN_A_ROW = 3
_PERIODS_FROM_EXPOSURE_TO_ARRIVAL = 2


class _Stream(Protocol):
    """An open camera, as the grabber sees it."""

    def read(self) -> tuple[bytes | Image, float]:
        """The next picture, a JPEG or RGB, and when its exposure began. May last as long as the read time-out."""

    def interrupt(self) -> None:
        """Let a waiting ``read()`` end soon, from another thread."""

    def close(self) -> None:
        """Give the device back."""


class OpenCvSource:
    """A ``drivers.camera.stereo.FrameSource``; ``clock`` is CLOCK_MONOTONIC (``SystemClock``), as the stamps are."""

    def __init__(
        self,
        device_or_url: str,
        clock: Clock,
        *,
        size_px: tuple[int, int],
        fps: float,
        exposure: float | None = None,
        gain: float | None = None,
        white_balance_k: float | None = None,
    ) -> None:
        """Open the camera and begin to grab. ``exposure`` in the camera's own unit; needed for a V4L2 device.

        Raises:
            ConnectionLostError: absent or not openable; the message names path, reason and next step.
            DeviceBusyError: another process has it, or another program takes pictures with it.
            ConfigError: a setting that the camera does not hold.
        """
        self._name = device_or_url
        self._clock = clock
        self._size_px = size_px
        self._fps = fps
        self._settings = (exposure, gain, white_balance_k)
        if not _is_url(device_or_url):
            if exposure is None:
                raise ConfigError(f"{device_or_url}: a V4L2 camera needs a fixed exposure; set [camera] exposure")
            v4l2.require_present(device_or_url)
        # A server can feed two readers, but a small one feeds each at half the rate.
        self._lock = DeviceLock(device_or_url)
        self._closing = threading.Event()
        self._changed = threading.Condition()
        self._newest: tuple[bytes | Image, float] | None = None
        self._decoded: tuple[Image, float] | None = None
        self._failure: DeviceError | None = None
        self.reopenings = 0
        """How often the camera stalled and was opened again."""
        try:
            self._stream = self._open()
        except BaseException:
            self._lock.release()
            raise
        self._thread = threading.Thread(target=self._grab, name=f"grab {device_or_url}", daemon=True)
        self._thread.start()
        # A grabber that is still inside OpenCV when the interpreter goes away takes the whole process down.
        atexit.register(self.close)

    @property
    def identity(self) -> str:
        """Serial number where the camera tells one (its stream's ``X-Serial``, or the kernel), else the path or URL."""
        if isinstance(self._stream, _HttpStream) and self._stream.serial_number is not None:
            return self._stream.serial_number
        return self._name if _is_url(self._name) else v4l2.identity(self._name)

    def newest(self) -> tuple[Image, float] | None:
        """The freshest picture at hand, without waiting; None while there is none."""
        with self._changed:
            self._require_alive()
            frame = self._newest
        return None if frame is None else self._decode(*frame)

    def wait_newer(self, exposed_after_s: float, timeout_s: float) -> tuple[Image, float]:
        """A picture whose exposure began after ``exposed_after_s``.

        Raises:
            DeviceTimeoutError: none within ``timeout_s``.
            ConnectionLostError: the camera is gone.
            DeviceFaultError: a picture that cannot be decoded.
        """
        deadline_s = self._clock.now_s() + timeout_s
        with self._changed:
            while True:
                self._require_alive()
                if self._newest is not None and self._newest[1] > exposed_after_s:
                    frame = self._newest
                    break
                remaining_s = deadline_s - self._clock.now_s()
                if remaining_s <= 0:
                    raise DeviceTimeoutError(f"{self._name}: no new picture within {timeout_s:g} s; check the camera")
                self._changed.wait(remaining_s)
        return self._decode(*frame)

    def close(self) -> None:
        """Stop grabbing and give the camera back; a second call does nothing.

        Raises:
            DeviceTimeoutError: the grabber hangs in the driver; the camera stays taken until the process ends.
        """
        if self._closing.is_set():
            return
        self._closing.set()
        atexit.unregister(self.close)
        self._stream.interrupt()
        self._thread.join(_JOIN_S)
        if self._thread.is_alive():
            raise DeviceTimeoutError(f"{self._name}: does not let go within {_JOIN_S:g} s; unplug the camera")
        self._stream.close()
        self._lock.release()

    def _open(self) -> _Stream:
        if self._name.startswith(("http://", "https://")):
            return _HttpStream(self._name, self._clock, self._fps)
        if _is_url(self._name):
            return _FfmpegStream(self._name, self._clock, self._fps)
        return v4l2.V4l2Stream(self._name, self._clock, _READ_S, self._size_px, self._fps, *self._settings)

    def _grab(self) -> None:
        stalls = 0
        while not self._closing.is_set():
            try:
                frame = self._stream.read()
            except DeviceTimeoutError as error:
                # After a time-out a capture never recovers. The name is stable, so that the same camera comes back
                # or none; a camera that hung up or was pulled is never taken again without a person.
                stalls += 1
                if stalls > _REOPENINGS_IN_A_ROW:
                    self._fail(error)
                if self._failure is not None or not self._reopen(error):
                    return
            except (DeviceError, cv2.error) as error:
                self._fail(error)
                return
            else:
                stalls = 0
                with self._changed:
                    self._newest = frame
                    self._changed.notify_all()

    def _reopen(self, stall: DeviceTimeoutError) -> bool:
        if self._closing.is_set():
            return False
        _log.warning("%s; opening it again", stall)
        before = self.identity
        self._stream.close()
        try:
            self._stream = self._open()
            if self.identity != before:
                raise ConnectionLostError(f"{self._name}: was {before} before it stalled and is {self.identity} now")
        except (MillError, cv2.error) as error:
            self._fail(error)
            return False
        self.reopenings += 1
        return True

    def _fail(self, error: MillError | cv2.error) -> None:
        with self._changed:
            self._failure = error if isinstance(error, DeviceError) else DeviceFaultError(f"{self._name}: {error}")
            self._changed.notify_all()

    def _require_alive(self) -> None:
        if self._closing.is_set():
            raise ConnectionLostError(f"{self._name}: the camera was closed; open it again")
        if self._failure is not None:
            raise type(self._failure)(str(self._failure))

    def _decode(self, picture: bytes | Image, exposed_at_s: float) -> tuple[Image, float]:
        if not isinstance(picture, bytes):
            return picture, exposed_at_s
        if self._decoded is None or self._decoded[1] != exposed_at_s:
            image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR_RGB)
            if image is None:
                raise DeviceFaultError(f"{self._name}: sent {len(picture)} bytes that are no JPEG; check cable and hub")
            self._decoded = (np.asarray(image, np.uint8), exposed_at_s)
        return self._decoded


class _HttpStream:
    """MJPEG over HTTP. Without stamps of the server, exposure is taken to begin two periods before arrival."""

    def __init__(self, url: str, clock: Clock, fps: float) -> None:
        self._clock = clock
        self._delay_s = _PERIODS_FROM_EXPOSURE_TO_ARRIVAL / fps
        self._stream = MultipartStream(url, _READ_S)
        self.serial_number = self._stream.serial_number

    def read(self) -> tuple[bytes | Image, float]:
        while True:
            picture, exposed_at_s = self._stream.read()
            if jpeg.is_whole(picture):
                return picture, self._clock.now_s() - self._delay_s if exposed_at_s is None else exposed_at_s

    def interrupt(self) -> None:
        self._stream.interrupt()

    def close(self) -> None:
        self._stream.close()


class _FfmpegStream:
    """Any other URL. Its frames carry no time of ours, so exposure is taken to begin two periods before arrival."""

    def __init__(self, url: str, clock: Clock, fps: float) -> None:
        self._url = url
        self._clock = clock
        self._delay_s = _PERIODS_FROM_EXPOSURE_TO_ARRIVAL / fps
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(_OPEN_S * 1000)]
        limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(_READ_S * 1000)]
        self._capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, limits)
        if not self._capture.isOpened():
            raise ConnectionLostError(
                f"{url}: cannot be opened within {_OPEN_S:g} s; start the camera's server, or correct the URL in the "
                "rig file"
            )

    def read(self) -> tuple[bytes | Image, float]:
        began_s = self._clock.now_s()
        good, image = self._capture.read()
        now_s = self._clock.now_s()
        if not good:
            if now_s - began_s >= _READ_S / 2:
                raise DeviceTimeoutError(f"{self._url}: no picture within {_READ_S:g} s")
            raise ConnectionLostError(f"{self._url}: the stream ended; start the camera again")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8), now_s - self._delay_s

    def interrupt(self) -> None:
        """Nothing: the read time-out ends the wait."""

    def close(self) -> None:
        self._capture.release()


def _is_url(name: str) -> bool:
    return "://" in name
