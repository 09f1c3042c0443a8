"""An emulated UVC camera behind ``v4l2_preload.c``: OpenCV's own V4L2 code talks to it from another process.

It behaves as uvcvideo does: an unknown size or format becomes the nearest one it has, exposure and colour temperature
are refused while they are automatic, buffers carry the CLOCK_MONOTONIC time when exposure began, and a camera for which
the USB bus has no room left refuses to stream with ENOSPC.
"""

import contextlib
import ctypes
import errno
import mmap
import os
import select
import socket
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import v4l2_structs as v4l2

_GREATEST_SHADE = 200
_SHADE_STEP = 8
_MJPG_IS_SMALLER_BY = 10


@dataclass
class UsbBus:
    """What cameras on one bus share; by default USB 2, of which video may take some 24 MB/s."""

    bytes_per_s: float = 24e6
    taken: dict[int, float] = field(default_factory=dict)

    def take(self, camera: int, bytes_per_s: float) -> bool:
        others = sum(taken for other, taken in self.taken.items() if other != camera)
        if others + bytes_per_s > self.bytes_per_s:
            return False
        self.taken[camera] = bytes_per_s
        return True

    def release(self, camera: int) -> None:
        self.taken.pop(camera, None)


@dataclass
class Knob:
    """A control; ``step`` as the camera counts, ``automatic`` the control that must be at the value to set this."""

    minimum: int
    maximum: int
    value: int
    step: int = 1
    automatic: tuple[int, int] | None = None

    def nearest(self, value: int) -> int:
        held = min(max(value, self.minimum), self.maximum)
        return self.minimum + (held - self.minimum) // self.step * self.step


class V4l2Device:
    """Plugged in from construction until ``unplug()``; a test may turn its public attributes at any time."""

    def __init__(
        self,
        path: Path,
        *,
        formats: tuple[str, ...] = ("YUYV", "MJPG"),
        sizes_px: tuple[tuple[int, int], ...] = ((640, 480), (960, 540)),
        rates_fps: tuple[int, ...] = (30, 15),
        bus: UsbBus | None = None,
        delay_s: float = 0.002,
    ) -> None:
        self.path = path
        self.formats, self.sizes_px, self.rates_fps = formats, sizes_px, rates_fps
        self.knobs = self.fresh_knobs()
        self.bus = UsbBus() if bus is None else bus
        self.delay_s = delay_s
        """From the beginning of an exposure until its buffer is filled."""
        self.mjpg_is_smaller_by = _MJPG_IS_SMALLER_BY
        """How much less than uncompressed pictures the camera reserves on the bus; some reserve as much."""
        self.is_metadata_node = False
        self.busy = False
        """Another program streams."""
        self.hangs = threading.Event()
        """No ioctl returns any more, until ``unplug()``."""
        self.hang_up = threading.Event()
        """Whoever has the camera open loses it; the node stays, as after a short break of the plug."""
        self.stamp_offset_s = 0.0
        self.torn = False
        self.stalled = False
        self.picture_size_px: tuple[int, int] | None = None
        """What the JPEGs hold, where it is not what the format says."""
        self.stamps_s: list[float] = []
        """Of all pictures exposed, whether somebody took them or not; the index is the picture's number."""
        self.asked: list[str] = []
        """The names of the ioctls, in order."""
        self.openings = 0
        self.refused: list[tuple[str, int]] = []
        self.format, self.size_px, self.rate_fps = formats[0], sizes_px[0], rates_fps[0]
        self._memory = -1
        self._slot_bytes = 0
        self._queued: deque[int] = deque()
        self._filled: deque[tuple[int, int, float, int]] = deque()
        self._streaming = False
        self._next_s = 0.0
        self._node: socket.socket | None = None
        self._control: socket.socket | None = None
        self._pulled, self._hand = os.pipe()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen(1)
        self._thread = threading.Thread(target=self._serve, name=f"V4L2 {path.name}", daemon=True)
        self._thread.start()

    @staticmethod
    def fresh_knobs() -> dict[int, Knob]:
        """As at power-up: everything automatic."""
        return {
            v4l2.GAIN: Knob(0, 100, 0),
            v4l2.WHITE_BALANCE_AUTO: Knob(0, 1, 1),
            v4l2.WHITE_BALANCE_K: Knob(2800, 6500, 4000, automatic=(v4l2.WHITE_BALANCE_AUTO, 0)),
            v4l2.EXPOSURE_AUTO: Knob(1, 3, v4l2.EXPOSURE_APERTURE_PRIORITY, step=2),
            v4l2.EXPOSURE: Knob(3, 2047, 250, automatic=(v4l2.EXPOSURE_AUTO, v4l2.EXPOSURE_MANUAL)),
        }

    def unplug(self) -> None:
        """Pull the plug: the node goes, then whoever has it open is told. A second call does nothing."""
        if self._hand >= 0:
            self.path.unlink(missing_ok=True)
            os.close(self._hand)
            self._hand = -1
            self._thread.join()

    def _serve(self) -> None:
        with contextlib.closing(self._listener):
            while True:
                sources = [source for source in (self._listener, self._control) if source is not None]
                wait_s = max(0.0, self._next_s + self.delay_s - time.monotonic()) if self._streaming else None
                ready, _, _ = select.select([self._pulled, *sources], [], [], wait_s)
                if self._pulled in ready:
                    break
                if self._listener in ready:
                    self._welcome(self._listener.accept()[0])
                elif self._control in ready:
                    self._answer()
                if self._streaming and time.monotonic() >= self._next_s + self.delay_s:
                    self._expose()
                if self.hang_up.is_set():
                    self._hang_up()
        self._hang_up()
        os.close(self._pulled)

    def _welcome(self, node: socket.socket) -> None:
        self._hang_up()
        self.openings += 1
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._memory = os.memfd_create("buffers")
        socket.send_fds(node, [b"."], [self._memory, theirs.fileno()])
        theirs.close()
        node.setblocking(False)
        self._node, self._control = node, ours

    def _hang_up(self) -> None:
        self._stop()
        for end in (self._node, self._control):
            if end is not None:
                end.close()
        if self._memory >= 0:
            os.close(self._memory)
        self._node, self._control, self._memory = None, None, -1

    def _answer(self) -> None:
        assert self._control is not None
        request = self._control.recv(2048)
        if not request:
            self._hang_up()
            return
        code = int.from_bytes(request[:4], "little")
        name, kind = v4l2.IOCTLS.get(code & 0xFF, (f"ioctl {code & 0xFF}", None))
        self.asked.append(name)
        if self.hangs.is_set():
            return
        argument = None if kind is None else kind.from_buffer_copy(request[4:])
        if kind is None or ctypes.sizeof(kind) != code >> 16 & 0x3FFF:
            error, reply = errno.ENOTTY, request[4:]
        else:
            error = getattr(self, f"_{name}")(argument)
            reply = bytes(argument)
        if error:
            self.refused.append((name, error))
        with contextlib.suppress(BrokenPipeError):
            self._control.send(error.to_bytes(4, "little") + reply)

    def _expose(self) -> None:
        number, stamp_s = len(self.stamps_s), self._next_s
        # A camera exposes at its own pace, whether somebody takes the picture or not.
        self._next_s = max(stamp_s + 1 / self.rate_fps, time.monotonic() - self.delay_s)
        if self.stalled:
            return
        self.stamps_s.append(stamp_s)
        if self._queued:
            index, data = self._queued.popleft(), self._picture(number)
            os.pwrite(self._memory, data, index * self._slot_bytes)
            self._filled.append((index, len(data), stamp_s, number))
            assert self._node is not None
            with contextlib.suppress(BrokenPipeError):
                self._node.send(b".")

    def _picture(self, number: int) -> bytes:
        width, height = self.picture_size_px or self.size_px
        shade = shade_of(number)
        if self.format == "YUYV":
            return np.full((height, width, 2), (shade, 128), np.uint8).tobytes()
        whole = cv2.imencode(".jpg", np.full((height, width, 3), shade, np.uint8))[1].tobytes()
        return whole[: len(whole) // 2] if self.torn else whole

    def _stop(self) -> None:
        self._streaming = False
        self._queued.clear()
        self._filled.clear()
        self.bus.release(id(self))

    @property
    def _picture_bytes(self) -> int:
        return 2 * self.size_px[0] * self.size_px[1]

    # What each ioctl does: 0, or the errno.

    def _querycap(self, caps: v4l2.Capability) -> int:
        caps.driver[:8] = b"uvcvideo"
        caps.card[:5] = b"Bench"
        caps.device_caps = v4l2.CAP_STREAMING | (v4l2.CAP_METADATA if self.is_metadata_node else v4l2.CAP_CAPTURE)
        caps.capabilities = caps.device_caps | v4l2.CAP_DEVICE_CAPS
        return 0

    def _enum_fmt(self, found: v4l2.FormatDescription) -> int:
        if found.index >= len(self.formats):
            return errno.EINVAL
        found.pixelformat = v4l2.fourcc(self.formats[found.index])
        return 0

    def _g_fmt(self, found: v4l2.Format) -> int:
        pix = found.fmt.pix
        pix.width, pix.height = self.size_px
        pix.pixelformat, pix.field = v4l2.fourcc(self.format), v4l2.FIELD_NONE
        pix.bytesperline = 2 * pix.width if self.format == "YUYV" else 0
        pix.sizeimage = self._picture_bytes
        return 0

    def _s_fmt(self, wanted: v4l2.Format) -> int:
        if self._streaming or self.busy:
            return errno.EBUSY
        pix = wanted.fmt.pix
        known = {v4l2.fourcc(name): name for name in self.formats}
        self.format = known.get(pix.pixelformat, self.formats[0])
        self.size_px = min(self.sizes_px, key=lambda size: abs(size[0] - pix.width) + abs(size[1] - pix.height))
        return self._g_fmt(wanted)

    def _g_parm(self, found: v4l2.StreamParameters) -> int:
        found.capability, found.numerator, found.denominator = v4l2.CAP_TIMEPERFRAME, 1, self.rate_fps
        return 0

    def _s_parm(self, wanted: v4l2.StreamParameters) -> int:
        fps = wanted.denominator / max(1, wanted.numerator)
        self.rate_fps = min(self.rates_fps, key=lambda rate: abs(rate - fps))
        return self._g_parm(wanted)

    def _reqbufs(self, wanted: v4l2.RequestBuffers) -> int:
        if self._streaming or self.busy:
            return errno.EBUSY
        if (wanted.type, wanted.memory) != (v4l2.CAPTURE, v4l2.MMAP):
            return errno.EINVAL
        self._stop()
        self._slot_bytes = -(-self._picture_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        # Never made smaller: the caller may still have the old buffers mapped.
        os.ftruncate(self._memory, max(wanted.count * self._slot_bytes, os.fstat(self._memory).st_size))
        return 0

    def _querybuf(self, buffer: v4l2.Buffer) -> int:
        buffer.offset, buffer.length = buffer.index * self._slot_bytes, self._picture_bytes
        return 0

    def _qbuf(self, buffer: v4l2.Buffer) -> int:
        if buffer.index in self._queued:
            return errno.EINVAL
        self._queued.append(buffer.index)
        buffer.flags = v4l2.BUFFER_MAPPED | v4l2.BUFFER_QUEUED
        return 0

    def _dqbuf(self, buffer: v4l2.Buffer) -> int:
        if not self._streaming:
            return errno.EINVAL
        if not self._filled:
            return errno.EAGAIN
        buffer.index, buffer.bytesused, stamp_s, buffer.sequence = self._filled.popleft()
        buffer.seconds, buffer.microseconds = divmod(round((stamp_s + self.stamp_offset_s) * 1e6), 1_000_000)
        buffer.flags = v4l2.BUFFER_MAPPED | v4l2.STAMPED_MONOTONIC | v4l2.STAMPED_AT_START_OF_EXPOSURE
        buffer.memory, buffer.field = v4l2.MMAP, v4l2.FIELD_NONE
        buffer.offset, buffer.length = buffer.index * self._slot_bytes, self._picture_bytes
        return 0

    def _streamon(self, kind: v4l2.Number) -> int:
        needed = self._picture_bytes * self.rate_fps / (1 if self.format == "YUYV" else self.mjpg_is_smaller_by)
        if not self.bus.take(id(self), needed):
            return errno.ENOSPC
        self._streaming, self._next_s = True, time.monotonic()
        return 0

    def _streamoff(self, kind: v4l2.Number) -> int:
        self._stop()
        return 0

    def _queryctrl(self, found: v4l2.QueryControl) -> int:
        knob = self.knobs.get(found.id)
        if knob is None:
            return errno.EINVAL
        found.minimum, found.maximum, found.step, found.default_value = knob.minimum, knob.maximum, knob.step, 0
        return 0

    def _g_ctrl(self, found: v4l2.Control) -> int:
        knob = self.knobs.get(found.id)
        if knob is None:
            return errno.EINVAL
        found.value = knob.value
        return 0

    def _s_ctrl(self, wanted: v4l2.Control) -> int:
        knob = self.knobs.get(wanted.id)
        if knob is None:
            return errno.EINVAL
        if knob.automatic is not None:
            master, manual = knob.automatic
            if self.knobs[master].value != manual:
                return errno.EACCES
        knob.value = wanted.value = knob.nearest(wanted.value)
        return 0

    def _g_input(self, number: v4l2.Number) -> int:
        number.value = 0
        return 0

    def _s_input(self, number: v4l2.Number) -> int:
        return 0 if number.value == 0 else errno.EINVAL


def shade_of(number: int) -> int:
    """The grey of a picture, by which it can be told from its neighbours."""
    return number * _SHADE_STEP % _GREATEST_SHADE
