"""The real camera driver in a process of its own, run with ``v4l2_preload.c`` in front of OpenCV.

One JSON request a line on stdin, one JSON answer a line on stdout: ``[name, arguments]`` and ``["ok", result]``, or
``["error's class", "its words"]``. A picture is told by its middle, its size and when its exposure began.
"""

import json
import sys
from typing import Any

import cv2

from drivers.camera.interface import Image
from drivers.camera.opencv import OpenCvSource
from drivers.camera.stereo import StereoPair
from drivers.clock import SystemClock
from drivers.errors import MillError

CLOCK = SystemClock()


def told(image: Image, exposed_at_s: float) -> dict[str, Any]:
    height, width, _ = image.shape
    shade = int(image[height // 2, width // 2].mean().round())
    return {"shade": shade, "size_px": [width, height], "exposed_at_s": exposed_at_s, "now_s": CLOCK.now_s()}


class Child:
    def __init__(self) -> None:
        self.eyes: list[OpenCvSource] = []
        self.captures: list[cv2.VideoCapture] = []

    def open(self, path: str, settings: dict[str, Any]) -> str:
        settings["size_px"] = tuple(settings["size_px"])
        self.eyes.append(OpenCvSource(path, CLOCK, **settings))
        return self.eyes[-1].identity

    def wait_newer(self, timeout_s: float) -> dict[str, Any]:
        return told(*self.eyes[-1].wait_newer(CLOCK.now_s(), timeout_s))

    def newest(self) -> dict[str, Any] | None:
        frame = self.eyes[-1].newest()
        return None if frame is None else told(*frame)

    def grabs(self, path: str, pixel_format: str) -> bool:
        """Whether OpenCV alone gets a picture; the camera is kept open."""
        self.captures.append(cv2.VideoCapture(path, cv2.CAP_V4L2))
        self.captures[-1].set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*pixel_format))
        return self.captures[-1].grab()

    def reopenings(self) -> int:
        return self.eyes[-1].reopenings

    def capture_pair(self, size_px: list[int], max_skew_s: float) -> dict[str, Any]:
        left, right = self.eyes
        width, height = size_px
        pair = StereoPair(left, right, CLOCK, size_px=(width, height), max_skew_s=max_skew_s)
        frame = pair.capture()
        return {"skew_s": frame.skew_s, **told(frame.left, frame.exposed_at_s)}

    def close(self) -> None:
        while self.eyes:
            self.eyes.pop().close()
        while self.captures:
            self.captures.pop().release()


def main() -> None:
    child = Child()
    for line in sys.stdin:
        name, arguments = json.loads(line)
        try:
            answer = ["ok", getattr(child, name)(*arguments)]
        except MillError as error:
            answer = [type(error).__name__, str(error)]
        print(json.dumps(answer), flush=True)
    child.close()


if __name__ == "__main__":
    main()
