import socket
import threading
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from firmware_sim.mjpeg_camera import MjpegCameras


@pytest.fixture
def cameras():
    server = MjpegCameras()
    yield server
    server.close()


def read_part(stream) -> tuple[dict[str, str], bytes]:
    line = stream.readline()
    while line.strip() == b"":
        line = stream.readline()
    assert line == b"--mill-frame\r\n"
    headers = {}
    while (line := stream.readline().strip()) != b"":
        key, value = line.decode().split(": ", 1)
        headers[key] = value
    return headers, stream.read(int(headers["Content-Length"]))


def test_a_part_carries_the_picture_and_when_its_exposure_began(cameras):
    cameras.publish(b"left picture", b"right picture", 12.345678)
    for side, content in (("left", b"left picture"), ("right", b"right picture")):
        with urllib.request.urlopen(cameras.url(side), timeout=5) as stream:
            assert stream.headers["Content-Type"] == "multipart/x-mixed-replace; boundary=mill-frame"
            headers, body = read_part(stream)
        assert headers == {
            "Content-Type": "image/jpeg",
            "Content-Length": str(len(content)),
            "X-Timestamp": "12.345678",
        }
        assert body == content


def test_a_client_gets_the_newest_picture_and_each_once(cameras):
    cameras.publish(b"1", b"1", 1.0)
    with urllib.request.urlopen(cameras.url("left"), timeout=5) as stream:
        assert read_part(stream)[1] == b"1"
        cameras.publish(b"2", b"2", 2.0)
        assert read_part(stream)[1] == b"2"


def test_other_paths_are_not_found(cameras):
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(cameras.url("middle"), timeout=5)
    with caught.value as reply:
        assert reply.code == 404


def test_a_client_that_does_not_read_delays_nobody(cameras):
    picture = bytes(300_000)
    with socket.create_connection(("127.0.0.1", cameras.port), timeout=5) as sleeper:
        sleeper.sendall(b"GET /left HTTP/1.0\r\n\r\n")
        cameras.publish(picture, picture, 0.0)
        with urllib.request.urlopen(cameras.url("left"), timeout=5) as stream:
            for number in range(20):
                cameras.publish(picture, picture, float(number))
                while float(read_part(stream)[0]["X-Timestamp"]) != number:
                    pass


def test_opencv_reads_the_stream(cameras):
    picture = np.zeros((54, 96, 3), np.uint8)
    picture[:, :, 2] = 200
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    stop = threading.Event()

    def stream() -> None:
        while not stop.wait(0.005):
            cameras.publish(jpeg, jpeg, 1.0)

    thread = threading.Thread(target=stream)
    thread.start()
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 10_000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, 10_000]
    capture = cv2.VideoCapture(cameras.url("right"), cv2.CAP_FFMPEG, limits)
    try:
        found, image = capture.read()
    finally:
        capture.release()
        stop.set()
        thread.join(5.0)
    assert found
    assert image.shape == picture.shape
    assert abs(int(image[20, 20, 2]) - 200) < 5


def test_closing_twice_is_fine_and_ends_the_streams(cameras):
    cameras.publish(b"1", b"1", 1.0)
    with urllib.request.urlopen(cameras.url("left"), timeout=5) as stream:
        read_part(stream)
        cameras.close()
        cameras.close()
        assert stream.read().strip() == b""
