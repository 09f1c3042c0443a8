"""A page that the test feeds, on a real port, and a viewer that may look."""

import contextlib
import json
import os
import select
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from live.page import Page


@dataclass
class Served:
    """A page that is fed by this process, and a viewer that has traded the token for its cookie."""

    page: Page
    stop_hears: int
    host: str = ""
    cookie: str = ""

    def __post_init__(self) -> None:
        self.host = httpx.URL(self.page.address).netloc.decode()
        answer = httpx.get(self.page.address, trust_env=False, timeout=20.0)
        assert answer.status_code == 200
        self.cookie = answer.headers["set-cookie"].partition(";")[0]

    @property
    def port(self) -> int:
        return int(self.host.partition(":")[2])

    def viewer(self, **changes: str | None) -> ClientConnection:
        """A WebSocket as our page opens one, but for ``changes``."""
        headers = {"Origin": f"http://{self.host}", "Cookie": self.cookie, **changes}
        kept = {name: value.format(port=self.port) for name, value in headers.items() if value is not None}
        origin = kept.pop("Origin", None)
        return connect(f"ws://{self.host}/watch", origin=origin, additional_headers=kept, proxy=None, max_size=None)  # type: ignore[arg-type]

    def ask(self, path: str, method: str = "GET", **headers: str) -> httpx.Response:
        return httpx.request(method, f"http://{self.host}{path}", headers=headers, trust_env=False, timeout=20.0)

    def stops(self) -> bool:
        """Whether a viewer's stop still arrives, soon."""
        with self.viewer() as socket_:
            told_s = time.monotonic()
            socket_.send("stop")
            assert select.select([self.stop_hears], [], [], 5.0)[0]
            assert os.read(self.stop_hears, 16)[:2] == b"!\n"
            return time.monotonic() - told_s < 0.5


@contextlib.contextmanager
def page_served() -> Iterator[Served]:
    # The page's process asks the one that feeds it to stop; here that is the test itself.
    before = signal.signal(signal.SIGINT, lambda *_: None)
    hears, end = os.pipe()
    try:
        with Page() as page:
            page.hand_over_stop(end)
            yield Served(page, hears)
    finally:
        signal.signal(signal.SIGINT, before)
        os.close(hears)
        os.close(end)


def alive(served: Served) -> bool:
    """Whether a proper viewer is told how things stand."""
    with served.viewer() as viewer:
        return any(json.loads(viewer.recv(5.0))["kind"] == "now" for _ in range(5))


def closed(viewer: ClientConnection) -> list[str | bytes]:
    """What a viewer is told until it is closed."""
    told = []
    with contextlib.suppress(ConnectionClosed):
        while True:
            told.append(viewer.recv(5.0))
    return told


def open_files(served: Served) -> int:
    return len(list(Path(f"/proc/{served.page.process_id}/fd").iterdir()))
