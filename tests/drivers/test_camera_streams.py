"""OpenCvSource over HTTP, against a small real server that plays a script of parts."""

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest

from drivers.camera.multipart import MultipartStream
from drivers.camera.opencv import OpenCvSource
from drivers.clock import SystemClock
from drivers.errors import ConnectionLostError, DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError

CLOCK = SystemClock()
HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=b0und\r\n\r\n"
Play = Callable[[socket.socket], None]


def jpeg(red: int = 200) -> bytes:
    image = np.zeros((54, 96, 3), np.uint8)
    image[:, :, 2] = red  # OpenCV's order is BGR
    return cv2.imencode(".jpg", image)[1].tobytes()


def part(body: bytes, *headers: str) -> bytes:
    lines = ["--b0und", "Content-Type: image/jpeg", f"Content-Length: {len(body)}", *headers]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body + b"\r\n"


@contextlib.contextmanager
def server(*plays: Play) -> Iterator[str]:
    """Answers one connection after the other, each by the next play; the last one is kept open to the end."""
    listener = socket.create_server(("127.0.0.1", 0))
    over = threading.Event()

    def serve() -> None:
        held = []
        for play in plays:
            try:
                connection, _ = listener.accept()
            except OSError:
                break
            held.append(connection)
            connection.recv(4096)
            with contextlib.suppress(OSError):
                play(connection)
        over.wait(20)
        for connection in held:
            connection.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/left"
    finally:
        over.set()
        with contextlib.suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join(10)
        assert not thread.is_alive()


def sends(*chunks: bytes, hang_up: bool = False) -> Play:
    def play(connection: socket.socket) -> None:
        for chunk in chunks:
            connection.sendall(chunk)
        if hang_up:
            connection.shutdown(socket.SHUT_RDWR)

    return play


def source(url: str) -> OpenCvSource:
    return OpenCvSource(url, CLOCK, size_px=(96, 54), fps=30.0)


def test_parts_come_with_their_stamps_and_in_pieces() -> None:
    pieces = [bytes((byte,)) for byte in part(jpeg(), "X-Timestamp: 12.345678")[:90]]
    rest = part(jpeg(), "X-Timestamp: 12.345678")[90:]
    with server(sends(HEAD, *pieces, rest, part(jpeg(10)))) as url:
        stream = MultipartStream(url, 5.0)
        assert stream.read() == (jpeg(), 12.345678)
        assert stream.read() == (jpeg(10), None)
        stream.close()
        stream.close()


@pytest.mark.parametrize(
    ("head", "error", "words"),
    [
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", ConnectionLostError, "answers 404"),
        (b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n", ConnectionLostError, "text/html, not a picture stream"),
        (b"garbage\r\n\r\n", ConnectionLostError, "cannot be opened"),
    ],
)
def test_an_address_without_a_stream_is_refused(head: bytes, error: type[DeviceError], words: str) -> None:
    with server(sends(head, hang_up=True)) as url, pytest.raises(error, match=words) as refused:
        MultipartStream(url, 5.0)
    assert url in str(refused.value)


@pytest.mark.parametrize(
    ("body", "error", "words"),
    [
        (b"--b0und\r\nContent-Type: image/jpeg\r\n\r\nxx", ProtocolError, "without Content-Length"),
        (b"--b0und\r\nContent-Length: 99999999999\r\n\r\n", ProtocolError, "allowed up to"),
        (b"--b0und\r\nContent-Length: -1\r\n\r\n", ProtocolError, "Content-Length '-1'"),
        (b"--b0und\r\nno header\r\n\r\n", ProtocolError, "proper header"),
        (b"--b0und\r\n" + b"A: b\r\n" * 40, ProtocolError, "proper header"),
        (part(jpeg(), "X-Timestamp: soon"), ProtocolError, "X-Timestamp 'soon'"),
        (part(jpeg())[:-200], ConnectionLostError, "hung up within a picture"),
        (b"--b0und--\r\n", ConnectionLostError, "ended the stream"),
        (b"", ConnectionLostError, "hung up"),
    ],
)
def test_a_broken_stream_is_named(body: bytes, error: type[DeviceError], words: str) -> None:
    with server(sends(HEAD, body, hang_up=True)) as url:
        stream = MultipartStream(url, 5.0)
        with pytest.raises(error, match=words) as refused:
            stream.read()
        assert url in str(refused.value)
        stream.close()


def test_a_stalled_stream_times_out() -> None:
    with server(sends(HEAD, part(jpeg()))) as url:
        stream = MultipartStream(url, 0.05)
        stream.read()
        with pytest.raises(DeviceTimeoutError, match="stalled"):
            stream.read()
        stream.close()


def test_nobody_listening_is_told_with_url_reason_and_next_step() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        url = f"http://127.0.0.1:{free.getsockname()[1]}/left"
    with pytest.raises(
        ConnectionLostError, match=r"cannot be opened \(.*refused\); start the camera's server"
    ) as refused:
        source(url)
    assert url in str(refused.value)


def test_pictures_are_rgb_and_carry_the_servers_time_of_exposure() -> None:
    with server(sends(HEAD, part(jpeg(200), f"X-Timestamp: {time.monotonic():.6f}"))) as url:
        eye = source(url)
        image, exposed_at_s = eye.wait_newer(0.0, 5.0)
        assert image.shape == (54, 96, 3)
        assert image[27, 48, 0] > 190
        assert image[27, 48, 2] < 10
        assert CLOCK.now_s() - 5 < exposed_at_s <= CLOCK.now_s()
        assert eye.newest() is not None
        assert eye.newest()[0] is image  # type: ignore[index]  (decoded once)
        with pytest.raises(DeviceTimeoutError, match=r"no new picture within 0\.01 s"):
            eye.wait_newer(exposed_at_s, 0.01)
        eye.close()
        eye.close()
        with pytest.raises(ConnectionLostError, match="was closed"):
            eye.newest()


def test_without_a_stamp_exposure_is_taken_to_begin_two_periods_before_arrival() -> None:
    with server(sends(HEAD, part(jpeg()))) as url:
        eye = source(url)
        _, exposed_at_s = eye.wait_newer(0.0, 5.0)
        assert exposed_at_s <= CLOCK.now_s() - 2 / 30
        eye.close()


def test_only_the_newest_picture_is_kept() -> None:
    now_s = CLOCK.now_s()
    parts = [part(jpeg(red), f"X-Timestamp: {now_s + red / 1e4:.6f}") for red in range(0, 250, 10)]
    with server(sends(HEAD, *parts)) as url:
        eye = source(url)
        image, _ = eye.wait_newer(now_s + 239 / 1e4, 5.0)
        assert image[27, 48, 0] > 230
        eye.close()


def test_a_torn_picture_is_dropped_and_one_that_is_no_jpeg_is_a_fault() -> None:
    torn = jpeg(50)[:-20]
    nonsense = b"\xff\xd8" + b"\x00" * 50 + b"\xff\xd9"
    with server(sends(HEAD, part(torn, "X-Timestamp: 7"), part(nonsense, "X-Timestamp: 8"))) as url:
        eye = source(url)
        with pytest.raises(DeviceFaultError, match="no JPEG"):
            eye.wait_newer(6.0, 5.0)
        eye.close()


def test_a_hung_up_server_is_lost_for_good() -> None:
    with server(sends(HEAD, part(jpeg(), "X-Timestamp: 7"), hang_up=True)) as url:
        eye = source(url)
        with pytest.raises(ConnectionLostError, match="hung up"):
            eye.wait_newer(8.0, 5.0)
        with pytest.raises(ConnectionLostError, match="hung up"):
            eye.newest()
        eye.close()


def test_a_stalled_camera_is_opened_again_and_it_is_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("drivers.camera.opencv._READ_S", 0.05)
    with (
        caplog.at_level(logging.WARNING),
        server(sends(HEAD, part(jpeg(), "X-Timestamp: 7")), sends(HEAD, part(jpeg(), "X-Timestamp: 9"))) as url,
    ):
        eye = source(url)
        _, exposed_at_s = eye.wait_newer(8.0, 5.0)
        assert exposed_at_s == 9.0
        assert eye.reopenings >= 1
        assert "opening it again" in caplog.text
        eye.close()


def test_another_camera_at_the_same_address_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.camera.opencv._READ_S", 0.05)
    heads = [HEAD[:-2] + b"X-Serial: " + serial + b"\r\n\r\n" for serial in (b"A-1", b"B-2")]
    with server(*(sends(head, part(jpeg(), "X-Timestamp: 7")) for head in heads)) as url:
        eye = source(url)
        assert eye.identity == "A-1"
        with pytest.raises(ConnectionLostError, match="was A-1 before it stalled and is B-2 now"):
            eye.wait_newer(8.0, 5.0)
        eye.close()


def test_closing_does_not_wait_for_a_silent_camera() -> None:
    with server(sends(HEAD)) as url:
        eye = source(url)
        began_s = CLOCK.now_s()
        eye.close()
        assert CLOCK.now_s() - began_s < 1.5  # the read time-out alone would be 2 s
