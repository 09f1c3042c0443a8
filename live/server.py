"""The far end of the page: a process of its own, so that whoever looks costs the control loop nothing.

    python -m live.server FEED_FD RUN_PID

It says on stdout under which address it answers, serves until the run ends or its process is gone, and leaves.
"""

import asyncio
import json
import os
import socket
import sys
from pathlib import Path
from typing import Any

import uvicorn

from live import wire
from live.app import watched
from live.gate import Gate
from live.patience import patient
from live.player import look_by
from live.stop import Stop
from live.story import Story, finite
from live.viewers import Viewers

TELL_S = 0.2
LAST_WORDS_S = 0.5
"""For viewers to hear how it ended."""
MOST_NEWS = 60
"""Lines of what happened: a page is no log."""
MOST_AT_ONCE = 64
"""Packets between two looks at the viewers: a stop must not wait for a backlog."""


class Server:
    """One run's page."""

    def __init__(self, feed: socket.socket, stop: Stop) -> None:
        """``feed`` is the far end of a ``live.page.Page``."""
        self._feed = feed
        self._stop = stop
        self._story = Story()
        self._viewers = Viewers()
        self._header: dict[str, Any] = {}
        self._scene_told = -1
        self._heard_s = 0.0
        self._ended = self._cut_off = False

    async def serve(self, listening: socket.socket) -> None:
        """Serve until the run has ended and everybody has heard it."""
        loop = asyncio.get_running_loop()
        self._heard_s = loop.time()
        gate = Gate(watched(self._viewers, self._press, self._history), listening.getsockname()[1])
        server = uvicorn.Server(patient(gate))
        # A terminal's Ctrl-C does not reach this session, and SIGTERM may end it.
        loop.add_reader(self._feed, self._hear)
        serving = asyncio.create_task(server.serve([listening]))
        # Who is told the address may come at once.
        listening.listen()
        print(gate.address, flush=True)
        while not self._ended and not serving.done():
            self._tell()
            await asyncio.sleep(TELL_S)
        self._tell()
        await asyncio.sleep(LAST_WORDS_S if len(self._viewers) else 0.0)
        server.should_exit = True
        await serving

    # From the run.

    def _hear(self) -> None:
        for _ in range(MOST_AT_ONCE):
            try:
                packet, files, _, _ = socket.recv_fds(self._feed, wire.MOST_BYTES * 2, 1)
            except BlockingIOError:
                return
            except OSError:
                packet, files = b"", []
            self._heard_s = asyncio.get_running_loop().time()
            if not packet or packet[:1] == wire.END:
                self._end(cut_off=not packet)
                return
            self._take(packet[:1], packet[1:], files)

    def _take(self, kind: bytes, body: bytes, files: list[int]) -> None:
        if kind == wire.EVENT:
            self._story.take(json.loads(body))
            if self._story.stopping:
                self._stop.settle()
        elif kind == wire.PICTURE:
            self._viewers.put(f"eye {wire.eye_of(body)}", body)
            self._story.pictured(wire.time_of(body))
        elif kind == wire.STOP_END:
            self._stop.take(files[0])
        elif kind == wire.HEADER:
            # A command may do one thing after another, each on a clock of its own.
            self._header, self._story, self._scene_told = json.loads(body), Story(), -1
            self._viewers.put("history", self._history())
            if calibration := self._header.get("calibration"):
                look_by(self._story, Path(calibration))

    def _end(self, *, cut_off: bool) -> None:
        asyncio.get_running_loop().remove_reader(self._feed)
        self._ended, self._cut_off = True, cut_off and not self._story.over
        # The supervisor sees that a run is gone when the last end of its pipe is closed, and this may be the last.
        self._stop.close()

    # To those who look.

    def _press(self) -> None:
        self._stop.press(asyncio.get_running_loop().call_later)
        self._story.told_by_a_person("STOP", "pressed on this page")
        self._tell()

    def _history(self) -> str:
        told = {key: self._header.get(key, "") for key in ("title", "command")}
        return _json(kind="history", rows=self._story.rows, **told)

    def _tell(self) -> None:
        story = self._story
        del story.news[:-MOST_NEWS]
        if self._scene_told != story.scene_number:
            self._scene_told = story.scene_number
            self._viewers.put("scene", _json(kind="scene", **story.scene))
        silent_s = asyncio.get_running_loop().time() - self._heard_s
        now = {
            **story.told(),
            "kind": "now",
            "row": story.curve(),
            "news": story.news,
            "contacts": story.contacts,
            "silent_s": round(silent_s, 2),
            "ended": self._ended,
            "cut_off": self._cut_off,
            "can_stop": self._stop.possible,
            "immediate": self._stop.immediate,
        }
        self._viewers.put("now", _json(**now))
        self._viewers.wake()


def _json(**fields: Any) -> str:
    return json.dumps(finite(fields), separators=(",", ":"), allow_nan=False)


def listen() -> socket.socket:
    """A port of the loopback that is free; nobody else's computer reaches it."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.bind(("127.0.0.1", 0))
    return listening


def main() -> None:
    """Take over the feed, and serve."""
    feed, run_pid = socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2])
    feed.setblocking(False)
    # A run that has ended already leaves this process to another parent; its number may be somebody else's by now.
    run_fd = os.pidfd_open(run_pid) if os.getppid() == run_pid else None
    with listen() as listening:
        asyncio.run(Server(feed, Stop(run_fd)).serve(listening))


if __name__ == "__main__":
    main()
