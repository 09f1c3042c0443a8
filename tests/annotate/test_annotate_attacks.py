"""The page's process against those who may not write, say too much, or name other files; on a real port."""

import contextlib
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

sys.path.insert(0, str(Path(__file__).parent))

from annotate.app import MOST_MESSAGE_BYTES
from studies.annotation_walk import page_of


@dataclass
class Served:
    host: str
    path: str
    cookie: str
    album: Path

    def ask(self, path: str, method: str = "GET", **headers: str) -> httpx.Response:
        headers = {"Cookie": self.cookie, **headers}
        return httpx.request(method, f"http://{self.host}{path}", headers=headers, trust_env=False, timeout=20.0)

    @contextlib.contextmanager
    def sit(self, **changes: str | None) -> Iterator[ClientConnection]:
        headers = {"Origin": f"http://{self.host}", "Cookie": self.cookie, **changes}
        kept = {name: value for name, value in headers.items() if value is not None}
        origin = kept.pop("Origin", None)
        with connect(f"ws://{self.host}/desk", origin=origin, additional_headers=kept, proxy=None) as wire:  # type: ignore[arg-type]
            yield wire


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    album = tmp_path_factory.mktemp("attacked") / "album"
    (album / "images/m 1").mkdir(parents=True)
    for name in ("1.png", "m 1/2#.png"):
        cv2.imwrite(str(album / "images" / name), np.full((100, 120, 3), 90, np.uint8))
    (album / "secret.png").write_bytes((album / "images/1.png").read_bytes())
    with page_of(album, "anna", "--task", "tip") as (_, address):
        host, _, path = address.removeprefix("http://").partition("/")
        found = Served(host, f"/{path}", "", album)
        found.cookie = found.ask(found.path).headers["set-cookie"].partition(";")[0]
        yield found


def test_who_brings_no_good_link_sees_nothing_and_is_told_what_to_do(served: Served) -> None:
    for path in ("/", served.path, "/pictures/1.png", "/desk"):
        assert served.ask(path, Cookie="").status_code == 403
    assert "start it again for a new link" in served.ask("/", Cookie="").text


def test_pages_of_others_are_refused(served: Served) -> None:
    assert served.ask("/", Host="evil.example").status_code == 421
    assert served.ask("/pictures/1.png", Origin="http://evil.example").status_code == 403
    assert served.ask("/", "POST").status_code == 405
    for change in ({"Origin": "http://evil.example"}, {"Origin": None}, {"Cookie": None}):
        with pytest.raises(InvalidStatus, match="403"), served.sit(**change):
            pass


@pytest.mark.parametrize(
    "path", ["/pictures/../secret.png", "/pictures/..%2fsecret.png", "/pictures/%2e%2e/secret.png", "/pictures//1.png"]
)
def test_no_path_leads_out_of_the_pictures(served: Served, path: str) -> None:
    host, port = served.host.split(":")
    with socket.create_connection((host, int(port)), timeout=20.0) as raw:
        raw.sendall(f"GET {path} HTTP/1.1\r\nHost: {served.host}\r\nCookie: {served.cookie}\r\n\r\n".encode())
        assert raw.recv(4096).split()[1] == b"404"


def test_pictures_in_folders_and_with_odd_names_are_shown(served: Served) -> None:
    for path in ("/pictures/1.png", "/pictures/m%201/2%23.png"):
        answer = served.ask(path)
        assert (answer.status_code, answer.headers["content-type"]) == (200, "image/jpeg")


@pytest.mark.parametrize("said", [b"bytes", "x" * (MOST_MESSAGE_BYTES + 1)], ids=["bytes", "too much"])
def test_a_window_that_says_what_no_page_says_is_closed(served: Served, said: str | bytes) -> None:
    with served.sit() as wire:
        wire.recv(20.0)
        wire.send(said)
        with pytest.raises(ConnectionClosed):
            wire.recv(20.0)


def test_the_last_window_that_was_opened_is_the_one_that_writes(served: Served) -> None:
    put = '{"do":"put","picture":"1.png","label":{"points":{"tip":"unseen"}}}'
    with served.sit() as first, served.sit() as second:
        first.recv(20.0)
        second.recv(20.0)
        with contextlib.suppress(ConnectionClosed):
            first.send(put)
        with pytest.raises(ConnectionClosed):
            first.recv(20.0)
        assert first.close_code == 4001
        assert not (served.album / "annotations/anna.json").exists()
        second.send(put)
        assert '"saved"' in str(second.recv(20.0))
    assert "unseen" in (served.album / "annotations/anna.json").read_text()
