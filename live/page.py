"""The near end of the page: starts its process, and hands it what happens without ever waiting for it."""

import importlib.util
import json
import os
import select
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceTimeoutError
from drivers.recorder import Recorder
from live import wire
from live.story import Floats, Optics
from milling.eyes import mean_radius

START_S = 20.0
LEAVE_S = 5.0
PICTURE_PERIOD_S = 0.2
"""Of each eye; everything in between is not even encoded."""
READING_PERIOD_S = 0.2
"""What a page shows of the ring it need not show more often."""
MOST_PX = 480
"""Of a picture's width."""
REGION_RADII = 3.4
"""Half the width of the part of a picture that is shown, in radii of the ring, as soon as that is known."""
QUALITY = 75
UNSHOWN = {"looked", "voided", "frame", "late"}
"""Events that no page shows, some of them large or many."""
NEEDED = ("fastapi", "uvicorn", "websockets")


def require_installed() -> None:
    """Refuse before anything moves.

    Raises:
        ConfigError: the extra is not installed.
    """
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(f"the page needs {', '.join(missing)}, not installed: pip install 'micromill[live]'")


class Page:
    """The process that serves the page of this process's run. Open from construction; ``close`` lets it leave."""

    def __init__(self, *, on_loss: Callable[[str], None] = lambda _: None) -> None:
        """Start it and hear its address.

        Args:
            on_loss: told once, in words, when it is gone before its time. The run goes on without it.

        Raises:
            ConfigError: what it needs is not installed.
            DeviceTimeoutError: it does not start.
        """
        require_installed()
        self._on_loss = on_loss
        self._gone = False
        self.dropped = 0
        """Packets that did not fit."""
        self._socket, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setblocking(False)
        words = [sys.executable, "-m", "live.server", str(far.fileno()), str(os.getpid())]
        try:
            # A session of its own: what Ctrl-C does to this process must not reach that one.
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                pass_fds=(far.fileno(),),
                start_new_session=True,
            )
        except BaseException:
            self._socket.close()
            raise
        finally:
            far.close()
        self.address = self._hear_address()
        """To open in a browser, once: it carries the one-time token."""

    @property
    def process_id(self) -> int:
        """Of the process that serves."""
        return self._process.pid

    @property
    def feed_fd(self) -> int:
        """Of the socket to it, for who must know what it has not read yet."""
        return self._socket.fileno()

    def header(self, **fields: Any) -> None:
        """What runs: its ``title``, its ``command``, and as ``calibration`` the file of one, to draw by."""
        self.send(wire.HEADER, json.dumps(fields).encode())

    def hand_over_stop(self, stop_end: int) -> None:
        """Let the page stop the motion through the supervisor's pipe, whatever this process does."""
        if not self._gone:
            # Unlike the rest this must arrive: it is sent once, before the drill is near the bone.
            self._socket.setblocking(True)
            self._socket.settimeout(LEAVE_S)
            try:
                socket.send_fds(self._socket, [wire.STOP_END], [stop_end])
            except OSError as error:
                self._lose(error)
            finally:
                self._socket.setblocking(False)

    def send(self, kind: bytes, body: bytes) -> None:
        """One packet, if it fits now; otherwise it is dropped and counted. Never waits, never raises."""
        if self._gone:
            return
        try:
            self._socket.send(kind + body)
        except BlockingIOError:
            self.dropped += 1
        except OSError as error:
            self._lose(error)

    def close(self) -> None:
        """Tell it that the run has ended, and let it leave; a second call does nothing."""
        if self._process.poll() is None:
            self.send(wire.END, b"")
        self._gone = True
        self._socket.close()
        try:
            self._process.wait(LEAVE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _hear_address(self) -> str:
        stdout = self._process.stdout
        assert stdout is not None
        if select.select([stdout], [], [], START_S)[0] and (line := stdout.readline()):
            return line.decode().strip()
        self._process.kill()
        self.close()
        raise DeviceTimeoutError(f"live page: its process did not start within {START_S:g} s; run without --live")

    def _lose(self, error: OSError) -> None:
        self._gone = True
        self._on_loss(f"live page: its process is gone ({error.strerror}); the run goes on without it")


class Shown:
    """A recorder that passes everything on, and shows it as well. What it costs is bounded, whoever watches."""

    def __init__(self, recorder: Recorder, page: Page, clock: Clock, optics: Optics | None) -> None:
        """Events are stamped relative to now, as the record's are; ``optics`` finds the ring, if there is one."""
        self._recorder = recorder
        self._optics = optics
        self._rings: list[tuple[Floats, float]] = []
        """Middle and radius in px, left and right."""
        self._page = page
        self._clock = clock
        self._start_s = clock.now_s()
        self._told_s: dict[str, float] = {}

    def event(self, kind: str, **fields: Any) -> None:
        """Show one event, and record it."""
        try:
            if kind not in UNSHOWN and (kind != "reading" or self._due(kind, READING_PERIOD_S)):
                self._page.send(wire.EVENT, self._packed(kind, fields))
            if kind == "trajectory" and self._optics is not None:
                both = self._optics.project(np.asarray(fields["fit_mm"]))
                self._rings = [(ring.mean(axis=0), mean_radius(ring)) for ring in both]
        finally:
            self._recorder.event(kind, **fields)

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Record one picture, and show it if the last one of its eye was some time ago."""
        self._recorder.frame(name, image)
        eye = int(name.endswith("right"))
        if not self._due(f"eye {eye}", PICTURE_PERIOD_S):
            return
        import cv2

        left, top, right, bottom = region = self._region(eye, image.shape[1], image.shape[0])
        part = image[top:bottom, left:right]
        by = -(-part.shape[1] // MOST_PX)
        small = cv2.resize(part, (part.shape[1] // by, part.shape[0] // by), interpolation=cv2.INTER_AREA)
        good, data = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        if good and data.size < wire.MOST_BYTES:
            self._page.send(wire.PICTURE, wire.picture_body(eye, self._now_s(), region, data.tobytes()))

    def _region(self, eye: int, width: int, height: int) -> wire.Region:
        """The part of a picture round the ring, of the whole one's proportions; the whole one before that is known."""
        if not self._rings:
            return (0, 0, width, height)
        middle, radius = self._rings[eye]
        wide = min(width, int(2 * REGION_RADII * radius))
        high = wide * height // width
        left = min(max(0, int(middle[0]) - wide // 2), width - wide)
        top = min(max(0, int(middle[1]) - high // 2), height - high)
        return (left, top, left + wide, top + high)

    def _now_s(self) -> float:
        return self._clock.now_s() - self._start_s

    def _due(self, name: str, period_s: float) -> bool:
        now_s = self._clock.now_s()
        if now_s - self._told_s.get(name, float("-inf")) < period_s:
            return False
        self._told_s[name] = now_s
        return True

    def _packed(self, kind: str, fields: Mapping[str, Any]) -> bytes:
        # What a later run must know of a point is long, and nobody looks at it.
        shown = {key: value for key, value in fields.items() if key != "known"}
        return json.dumps({"t": self._now_s(), "kind": kind, **shown}, default=_plain).encode()


def _plain(value: Any) -> Any:
    """What JSON does not know."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")
