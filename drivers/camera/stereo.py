"""Two eyes made one stereo camera: pairs of the same moment, never stale, never frozen."""

import math
from collections import deque
from contextlib import ExitStack
from typing import Protocol

import numpy as np

from drivers.camera.interface import Image, StereoCamera, StereoFrame
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceFaultError, DeviceTimeoutError

_KEPT = 3
"""Pictures kept of each eye, so that the one which comes late finds its partner."""
_FUTURE_S = 0.005


class FrameSource(Protocol):
    """One eye. Pictures come with the clock's time when their exposure began."""

    @property
    def identity(self) -> str:
        """Stable name and serial number, as far as known."""

    def newest(self) -> tuple[Image, float] | None:
        """The freshest picture at hand, without waiting; None while there is none."""

    def wait_newer(self, exposed_after_s: float, timeout_s: float) -> tuple[Image, float]:
        """A picture whose exposure began after ``exposed_after_s``.

        Raises:
            DeviceTimeoutError: none within ``timeout_s``.
            ConnectionLostError: the camera is gone.
        """

    def close(self) -> None:
        """Give the camera back; a second call does nothing."""


class _Eye:
    """What one source sent last, each picture checked once."""

    def __init__(self, side: str, source: FrameSource, clock: Clock, size_px: tuple[int, int]) -> None:
        self.side = side
        self.source = source
        self.recent: deque[tuple[Image, float]] = deque(maxlen=_KEPT)
        self._clock = clock
        self._size_px = size_px

    @property
    def last_s(self) -> float:
        return self.recent[-1][1] if self.recent else -math.inf

    def look(self) -> None:
        frame = self.source.newest()
        if frame is not None:
            self._take(*frame)

    def wait_newer(self, exposed_after_s: float, timeout_s: float) -> None:
        image, exposed_at_s = self.source.wait_newer(exposed_after_s, timeout_s)
        if exposed_at_s <= exposed_after_s:
            raise DeviceFaultError(
                f"{self._name}: handed out a picture of {exposed_at_s:.3f} s when one after {exposed_after_s:.3f} s "
                "was asked for; its time stamps cannot be trusted, replug the camera"
            )
        self._take(image, exposed_at_s)

    def _take(self, image: Image, exposed_at_s: float) -> None:
        if exposed_at_s <= self.last_s:
            return
        width, height = self._size_px
        if image.shape != (height, width, 3) or image.dtype != np.uint8:
            raise DeviceFaultError(
                f"{self._name}: sent a picture of shape {image.shape} {image.dtype}, "
                f"expected {(height, width, 3)} uint8; check [camera] size_px"
            )
        if not exposed_at_s <= self._clock.now_s() + _FUTURE_S:
            raise DeviceFaultError(
                f"{self._name}: stamps its picture {exposed_at_s:.3f} s, but the clock says "
                f"{self._clock.now_s():.3f} s; the camera must stamp with this machine's CLOCK_MONOTONIC"
            )
        if self.recent and _same(image, self.recent[-1][0]):
            raise DeviceFaultError(
                f"{self._name}: sent the same bytes twice under new time stamps, which a living sensor never does; "
                "the picture is frozen, black or saturated: check light and lens cap, then replug the camera"
            )
        self.recent.append((image, exposed_at_s))

    @property
    def _name(self) -> str:
        return f"{self.side} camera {self.source.identity}"


def _same(one: Image, other: Image) -> bool:
    """Equal to the last byte; two pictures of a living sensor differ in their first row already."""
    return np.array_equal(one[0], other[0]) and np.array_equal(one, other)


class StereoPair(StereoCamera):
    """A left and a right source, paired by the time of exposure. Both are the pair's own, and closed with it."""

    def __init__(
        self, left: FrameSource, right: FrameSource, clock: Clock, *, size_px: tuple[int, int], max_skew_s: float
    ) -> None:
        """Take over both sources; a pair's exposures began at most ``max_skew_s`` apart.

        Raises:
            ConfigError: both eyes are one device; it was closed.
        """
        if left.identity == right.identity:
            left.close()
            right.close()
            raise ConfigError(f"left and right camera are the same device, {left.identity}; name two")
        self._clock = clock
        self._size_px = size_px
        self._max_skew_s = max_skew_s
        self._left = _Eye("left", left, clock, size_px)
        self._right = _Eye("right", right, clock, size_px)
        self._latest: StereoFrame | None = None
        self._count = 0

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of each picture."""
        return self._size_px

    @property
    def identity(self) -> str:
        """Both cameras."""
        return f"left {self._left.source.identity}; right {self._right.source.identity}"

    def capture(self, timeout_s: float = 2.0) -> StereoFrame:
        """A pair whose exposure began after the call."""
        called_at_s = self._clock.now_s()
        deadline_s = called_at_s + timeout_s
        while True:
            frame = self._pair(called_at_s)
            if frame is not None:
                return frame
            # The eye that is behind decides: its next picture may be the partner of the other's newest.
            eye = min((self._left, self._right), key=lambda each: each.last_s)
            remaining_s = deadline_s - self._clock.now_s()
            if remaining_s <= 0:
                raise self._late(called_at_s, timeout_s)
            try:
                eye.wait_newer(max(called_at_s, eye.last_s), remaining_s)
            except DeviceTimeoutError as error:
                raise self._late(called_at_s, timeout_s) from error

    def latest(self) -> StereoFrame | None:
        """The freshest pair at hand, without waiting; None while there is none."""
        self._left.look()
        self._right.look()
        newest = self._pair(-math.inf)
        return newest or self._latest

    def close(self) -> None:
        """Give both cameras back, the second one also when the first one fails."""
        with ExitStack() as both:
            both.callback(self._right.source.close)
            both.callback(self._left.source.close)

    def _pair(self, exposed_after_s: float) -> StereoFrame | None:
        """The freshest pair within the skew that is newer than both ``exposed_after_s`` and the last one given."""
        if self._latest is not None:
            exposed_after_s = max(exposed_after_s, self._latest.exposed_at_s)
        pairs = [
            (min(left_s, right_s), left, right, right_s - left_s)
            for left, left_s in self._left.recent
            for right, right_s in self._right.recent
            if abs(left_s - right_s) <= self._max_skew_s and min(left_s, right_s) > exposed_after_s
        ]
        if not pairs:
            return None
        exposed_at_s, left, right, skew_s = max(pairs, key=lambda pair: pair[0])
        self._left.look()
        self._right.look()
        lag_s = abs(self._left.last_s - self._right.last_s)
        self._latest = StereoFrame(left, right, exposed_at_s, self._count, skew_s, lag_s)
        self._count += 1
        return self._latest

    def _late(self, called_at_s: float, timeout_s: float) -> DeviceFaultError | DeviceTimeoutError:
        late = [eye for eye in (self._left, self._right) if eye.last_s <= called_at_s]
        if late:
            sides = " and ".join(f"{eye.side} camera {eye.source.identity}{self._age(eye)}" for eye in late)
            return DeviceTimeoutError(f"no picture exposed after the call within {timeout_s:g} s from {sides}")
        skew_s = abs(self._left.last_s - self._right.last_s)
        return DeviceFaultError(
            f"left and right picture are {skew_s * 1000:.1f} ms apart, allowed {self._max_skew_s * 1000:.1f} ms "
            "([camera] max_skew_s); trigger both cameras together, or move more slowly and allow more"
        )

    def _age(self, eye: _Eye) -> str:
        if not eye.recent:
            return " (none ever came)"
        return f" (the newest is {self._clock.now_s() - eye.last_s:.3f} s old)"
