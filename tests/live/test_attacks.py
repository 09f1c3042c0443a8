"""The page's process against those who may not look, say too much, or do not read; on a real port."""

import contextlib
import json
import os
import secrets
import select
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

sys.path.insert(0, str(Path(__file__).parent))

from served_page import Served, alive, closed, open_files, page_served

from benchmarks.live_viewers import memory_mb
from drivers.clock import SystemClock
from drivers.recorder import NullRecorder
from live import wire
from live.page import Shown
from live.patience import MOST_CONNECTIONS, REQUEST_S
from live.viewers import MOST_VIEWERS

STRANGERS = ["http://evil.example", "http://127.0.0.1:1", "https://127.0.0.1:{port}", "http://localhost:{port}", "null"]
"""``localhost`` is ours, but not where this page came from."""

UPGRADE = (
    "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
)


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """One that every attack leaves as it was."""
    with page_served() as served:
        yield served


@pytest.fixture
def fresh() -> Iterator[Served]:
    """One that does not outlive its test."""
    with page_served() as served:
        yield served


def test_a_viewer_with_the_cookie_may_look_and_stop(served: Served) -> None:
    assert alive(served)
    assert served.stops()
    assert served.ask("/", Cookie=served.cookie).status_code == 200


def test_the_token_is_good_once(served: Served) -> None:
    again = served.ask(str(httpx.URL(served.page.address).raw_path.decode()))
    assert again.status_code == 403
    assert "opened in another browser" in again.text
    assert "set-cookie" not in again.headers


@pytest.mark.parametrize("path", ["/", "/?token=", "/?token=guess", "/run.json", "/watch", "/docs", "/openapi.json"])
def test_nothing_is_shown_without_the_token(served: Served, path: str) -> None:
    assert served.ask(path).status_code == 403
    assert served.ask(path, Cookie="mill-live=guess").status_code == 403
    assert served.ask(path, Cookie=f"mill-live-{served.port}=guess").status_code == 403


@pytest.mark.parametrize("path", ["/docs", "/openapi.json", "/redoc", "/frames/x.jpg", "/../pyproject.toml", "/stop"])
def test_there_is_nothing_else_to_see(served: Served, path: str) -> None:
    assert served.ask(path, Cookie=served.cookie).status_code == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"])
def test_the_page_is_only_looked_at(served: Served, method: str) -> None:
    assert served.ask("/", method, Cookie=served.cookie).status_code == 405


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "[::1]:{port}", ""]
)
def test_a_name_that_was_made_to_point_here_is_refused(served: Served, host: str) -> None:
    named = host.format(port=served.port)
    assert served.ask("/", Host=named, Cookie=served.cookie).status_code == 421
    words = f"GET /watch HTTP/1.1\r\nHost: {named}\r\nOrigin: http://{named}\r\nCookie: {served.cookie}\r\n"
    assert answered(served, (words + UPGRADE).encode()).split()[1] == b"403"


@pytest.mark.parametrize("origin", STRANGERS)
def test_a_page_of_another_origin_is_refused(served: Served, origin: str) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        served.viewer(Origin=origin)
    assert served.ask("/", Origin=origin.format(port=served.port), Cookie=served.cookie).status_code == 403


@pytest.mark.parametrize("missing", ["Origin", "Cookie"])
def test_a_viewer_that_brings_too_little_is_refused(served: Served, missing: str) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        served.viewer(**{missing: None})


@pytest.mark.parametrize("cookie", ["x=1", "=", ";;;", "mill-live-{port}=", "mill-live-{port}=\u00e9", '"\\"; b=\x01'])
def test_a_wrong_cookie_is_refused(served: Served, cookie: str) -> None:
    assert answered(
        served, f"GET / HTTP/1.1\r\nHost: {served.host}\r\nCookie: {cookie}\r\n\r\n".encode("latin-1")
    ).split()[1] in {b"403", b"400"}


@pytest.mark.parametrize(
    "said",
    [
        "",
        "STOP",
        "stop ",
        "go",
        '{"stop": true}',
        "s" * 65,
        "s" * 1_000_000,
        b"stop",
        b"\x00" * 64,
        "\N{OCTAGONAL SIGN}",
    ],
    ids=lambda said: f"{type(said).__name__}{len(said)}{said[:4]!r}",
)
def test_a_viewer_that_says_anything_else_is_closed(served: Served, said: str | bytes) -> None:
    with served.viewer() as viewer:
        viewer.send(said)
        closed(viewer)
        assert viewer.close_code in {1006, 1008, 1009}
    assert not select.select([served.stop_hears], [], [], 0.0)[0], "it stopped something"
    assert alive(served)


def test_a_viewer_that_breaks_the_protocol_is_closed(served: Served) -> None:
    with served.viewer() as viewer:
        viewer.socket.sendall(secrets.token_bytes(4096))
        closed(viewer)
    assert alive(served)


def test_a_viewer_that_shouts_is_closed_and_has_stopped_the_machine(served: Served) -> None:
    with served.viewer() as viewer:
        with contextlib.suppress(ConnectionClosed):
            for _ in range(10_000):
                viewer.send("stop")
        closed(viewer)
    assert os.read(served.stop_hears, 1 << 16).startswith(b"!\n")
    assert alive(served)


def test_so_many_viewers_and_no_more(fresh: Served) -> None:
    with contextlib.ExitStack() as all_of_them:
        viewers = [all_of_them.enter_context(fresh.viewer()) for _ in range(MOST_VIEWERS)]
        for viewer in viewers:
            viewer.recv(5.0)
        one_too_many = all_of_them.enter_context(fresh.viewer())
        assert closed(one_too_many) == []
        assert one_too_many.close_code == 1013
    assert alive(fresh)


def test_a_thousand_connections_leave_a_viewer_its_button_and_the_run_its_wire(fresh: Served) -> None:
    told = {"t": 1.0, "kind": "stage", "stage": "mill"}
    with fresh.viewer() as viewer, contextlib.ExitStack() as all_of_them:
        viewer.recv(5.0)
        before = open_files(fresh)
        cost_s = 0.0
        for number in range(1000):
            began_s = time.thread_time()
            fresh.page.send(wire.EVENT, json.dumps({**told, "detail": f"while {number} call"}).encode())
            cost_s += time.thread_time() - began_s
            one = all_of_them.enter_context(socket.create_connection(("127.0.0.1", fresh.port)))
            if number % 2:
                with contextlib.suppress(OSError):
                    one.sendall(b"GET / HTTP/1.1\r\nHost: ")
        told_s = time.monotonic()
        viewer.send("stop")
        assert select.select([fresh.stop_hears], [], [], 5.0)[0]
        assert time.monotonic() - told_s < 0.5
        assert cost_s < 1.0, "the run does not wait, and does not work, for whoever calls"
        # Most are refused, the others dropped as they say nothing, and there is room again.
        clock = SystemClock()
        until_s = clock.now_s() + 4 * REQUEST_S
        while open_files(fresh) > before + MOST_CONNECTIONS:
            assert clock.now_s() < until_s
        while clock.now_s() < until_s:
            with contextlib.suppress(httpx.TransportError):
                if fresh.ask("/", Cookie=fresh.cookie).status_code == 200:
                    break
        else:
            raise AssertionError("no room again")
        dropped = fresh.page.dropped
        fresh.page.send(wire.EVENT, json.dumps({**told, "detail": "afterwards"}).encode())
        assert fresh.page.dropped == dropped
        while json.loads(news if isinstance(news := viewer.recv(5.0), str) else "{}").get("detail") != "afterwards":
            assert clock.now_s() < until_s + 4 * REQUEST_S


@pytest.mark.parametrize(
    "words", [b"\x16\x03\x01" * 50, b"GET " + b"/" * 100_000, b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 9999]
)
def test_a_request_that_is_none_is_answered_and_closed(served: Served, words: bytes) -> None:
    assert answered(served, words)[:12] in {b"HTTP/1.1 400", b"HTTP/1.1 431", b""}
    assert alive(served)


def test_a_body_is_not_read_for_ever(served: Served) -> None:
    head = f"POST / HTTP/1.1\r\nHost: {served.host}\r\nCookie: {served.cookie}\r\nContent-Length: 999999999\r\n\r\n"
    assert answered(served, head.encode() + b"x" * 100_000).split()[1] == b"405"
    assert alive(served)


def test_a_viewer_that_never_reads_is_dropped_and_costs_nothing(fresh: Served) -> None:
    shown = Shown(NullRecorder(), fresh.page, SystemClock(), None)  # type: ignore[arg-type]
    noise = np.random.default_rng(0).integers(0, 255, (540, 960, 3), dtype=np.uint8)
    cookie = f"GET /watch HTTP/1.1\r\nHost: {fresh.host}\r\nOrigin: http://{fresh.host}\r\nCookie: {fresh.cookie}\r\n"
    with socket.create_connection(("127.0.0.1", fresh.port)) as deaf, fresh.viewer() as viewer:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.sendall((cookie + UPGRADE).encode())
        began_s = time.monotonic()
        before = open_files(fresh)
        pictures = 0
        while open_files(fresh) >= before:
            assert time.monotonic() - began_s < 30.0, "it is still there"
            shown._told_s.clear()
            shown.frame("left", noise)
            news = viewer.recv(5.0)
            pictures += isinstance(news, bytes)
        assert pictures > 5, "the other viewer saw on"
        assert memory_mb(fresh.page.process_id) < 400
    assert alive(fresh)


def answered(served: Served, words: bytes) -> bytes:
    """What comes back for raw bytes."""
    with socket.create_connection(("127.0.0.1", served.port), timeout=20.0) as raw:
        with contextlib.suppress(OSError):
            raw.sendall(words)
        with contextlib.suppress(OSError):
            return raw.recv(4096)
    return b""
