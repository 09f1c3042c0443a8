"""Two cameras on one HTTP port: ``/left`` and ``/right`` as multipart/x-mixed-replace, one JPEG a part.

Each part carries ``X-Timestamp``: CLOCK_MONOTONIC in seconds when the exposure began. A client always gets the newest
picture; one that reads too slowly misses pictures and delays nobody. ``X-Serial`` in the head of a stream tells the
camera's serial number. The port is bound to the loopback interface.
"""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final

SIDES: Final = ("left", "right")
_BOUNDARY = "mill-frame"
_SEND_TIMEOUT_S = 5.0
_WAIT_S = 0.5


class MjpegCameras:
    """Open from construction; pictures go in by ``publish`` from any thread."""

    def __init__(self, *, host: str = "127.0.0.1", port: int = 0, serial_number: int = 0) -> None:
        self.serial_number = serial_number
        self._changed = threading.Condition()
        self._pictures: tuple[bytes, bytes] | None = None
        self._exposed_at_s = (0.0, 0.0)
        self._number = 0
        self._watchers = 0
        self._closing = False
        self._server = _Server((host, port), self)
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The TCP port that was given."""
        return int(self._server.server_address[1])

    def url(self, side: str) -> str:
        """Where to watch one side."""
        return f"http://{self._server.server_address[0]!s}:{self.port}/{side}"

    @property
    def watched(self) -> bool:
        """Whether anybody watches; pictures for nobody need not be drawn."""
        return self._watchers > 0

    def publish(self, left_jpeg: bytes, right_jpeg: bytes, exposed_at_s: float, *, right_late_s: float = 0.0) -> None:
        """Show this pair from now on; the right one was exposed ``right_late_s`` before the left one."""
        with self._changed:
            self._pictures = (left_jpeg, right_jpeg)
            self._exposed_at_s = (exposed_at_s, exposed_at_s - right_late_s)
            self._number += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Hang up on everybody; a second call does nothing."""
        if self._closing:
            return
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)

    def _next(self, side: int, seen: int) -> tuple[int, bytes, float] | None:
        """The newest picture after number ``seen``; None when there will be none."""
        with self._changed:
            while not self._closing:
                if self._pictures is not None and self._number != seen:
                    return self._number, self._pictures[side], self._exposed_at_s[side]
                self._changed.wait(_WAIT_S)
        return None

    def _watch(self, change: int) -> None:
        with self._changed:
            self._watchers += change


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], cameras: MjpegCameras) -> None:
        self.cameras = cameras
        super().__init__(address, _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _SEND_TIMEOUT_S

    def do_GET(self) -> None:
        """A stream, or 404."""
        side = self.path.strip("/")
        if side not in SIDES:
            self.send_error(404, f"only /{' and /'.join(SIDES)} are here")
            return
        cameras = self.server.cameras
        cameras._watch(+1)
        try:
            self._stream(cameras, SIDES.index(side))
        except (ConnectionError, TimeoutError):
            # The client hung up, or has not read for too long; it may come again.
            self.close_connection = True
        finally:
            cameras._watch(-1)

    def _stream(self, cameras: MjpegCameras, side: int) -> None:
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("X-Serial", f"{cameras.serial_number}-{SIDES[side]}")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Connection", "close")
        self.end_headers()
        seen = 0
        while (picture := cameras._next(side, seen)) is not None:
            seen, jpeg, exposed_at_s = picture
            head = (
                f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n"
                f"X-Timestamp: {exposed_at_s:.6f}\r\n\r\n"
            )
            self.wfile.write(head.encode("ascii") + jpeg + b"\r\n")

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Nothing: the terminal belongs to the status line."""
