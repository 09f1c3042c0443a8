"""Stereo cameras on a scene that counts, for the conformance tests."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from drivers.camera.interface import Image, StereoCamera
from drivers.camera.opencv import OpenCvSource
from drivers.camera.stereo import StereoPair
from drivers.clock import Clock, SystemClock
from firmware_sim.clock import SimClock
from firmware_sim.lines import in_process_sources
from firmware_sim.microscope import Shot
from firmware_sim.mjpeg_camera import MjpegCameras

SIZE_PX = (192, 96)
FPS = 50.0
MAX_SKEW_S = 0.01
_BITS = 16
_BLOCK_PX = 12


@dataclass
class Scene:
    """Noise, red, with the number of the exposure and the side in blocks that survive a JPEG."""

    exposed_at_s: list[float] = field(default_factory=list)

    def render(self, time_s: float) -> tuple[Image, Image]:
        number = len(self.exposed_at_s)
        self.exposed_at_s.append(time_s)
        return self._draw(number, 0), self._draw(number, 1)

    def _draw(self, number: int, side: int) -> Image:
        image = np.random.default_rng([number, side]).integers(0, 60, (SIZE_PX[1], SIZE_PX[0], 3), dtype=np.uint8)
        image[..., 0] += 180
        for bit in range(_BITS):
            place = slice(bit * _BLOCK_PX, (bit + 1) * _BLOCK_PX)
            image[:24, place] = 255 * (number >> bit & 1)
        image[24:48] = 255 * side
        return image


def read_scene(image: Image) -> tuple[int, int]:
    """Number and side of a picture."""
    middle = image[12, _BLOCK_PX // 2 :: _BLOCK_PX].mean(axis=1)
    return sum(1 << bit for bit in range(_BITS) if middle[bit] > 127), int(image[36, 96].mean() > 127)


@dataclass
class CameraBench:
    """A camera fresh from its constructor."""

    camera: StereoCamera
    clock: Clock
    scene: Scene | None
    """What was really exposed and when; None where nobody knows."""
    stop: Callable[[], None]
    """No further picture comes."""


@contextlib.contextmanager
def in_process_bench() -> Iterator[CameraBench]:
    """Both eyes on the virtual clock."""
    clock, scene = SimClock(), Scene()
    left, right = in_process_sources(lambda time_s: Shot(*scene.render(time_s)), clock, fps=FPS, latency_s=0.02)
    with StereoPair(left, right, clock, size_px=SIZE_PX, max_skew_s=MAX_SKEW_S) as camera:
        yield CameraBench(camera, clock, scene, stop=lambda: None)


@contextlib.contextmanager
def mjpeg_bench() -> Iterator[CameraBench]:
    """Both eyes over HTTP, in real time."""
    clock, scene, over = SystemClock(), Scene(), threading.Event()
    cameras = MjpegCameras()

    def expose() -> None:
        while not over.wait(1 / FPS):
            now_s = time.monotonic()
            left, right = (cv2.imencode(".jpg", image[..., ::-1])[1].tobytes() for image in scene.render(now_s))
            cameras.publish(left, right, now_s)

    thread = threading.Thread(target=expose)
    thread.start()
    with contextlib.ExitStack() as stack:
        stack.callback(cameras.close)
        stack.callback(thread.join, 5.0)
        stack.callback(over.set)
        left, right = (OpenCvSource(cameras.url(side), clock, size_px=SIZE_PX, fps=FPS) for side in ("left", "right"))
        camera = stack.enter_context(StereoPair(left, right, clock, size_px=SIZE_PX, max_skew_s=MAX_SKEW_S))
        yield CameraBench(camera, clock, scene, stop=over.set)


@contextlib.contextmanager
def rig_file_bench(rig_file: Path) -> Iterator[CameraBench]:
    """The camera of a rig file."""
    from cli.config import load_rig
    from cli.rig import WiredRig

    clock = SystemClock()
    with WiredRig(load_rig(rig_file), clock).open_camera() as camera:
        yield CameraBench(camera, clock, None, stop=lambda: None)
