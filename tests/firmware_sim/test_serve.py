"""The bench on real ptys and ports. Waiting is for data, with a deadline; nothing sleeps."""

import json
import os
import subprocess
import sys
import threading
import time
import urllib.request

import cv2
import numpy as np
import pytest
import serial

from firmware_sim.bench import Bench
from firmware_sim.ptys import PENDING_MAX, SerialPty
from firmware_sim.serve import LONGEST_LAG_S, BenchService, write_atomically


class TinyMicroscope:
    """Grey pictures, quickly."""

    def render(self, time_s: float, *, each=map):
        picture = np.full((54, 96, 3), 100, np.uint8)
        return picture, picture + 50

    def project(self, points_mm):
        pixels = np.zeros((len(points_mm), 2))
        return pixels, pixels


def tiny_bench() -> Bench:
    bench = Bench(seed=0)
    bench.microscope = TinyMicroscope()
    return bench


@pytest.fixture
def served(tmp_path):
    """A service that runs in another thread; yields it and the file of its truth."""
    service = BenchService(tiny_bench(), fps=50.0)
    stop = threading.Event()
    truth = tmp_path / "truth.json"
    thread = threading.Thread(target=service.run, args=(stop.is_set,), kwargs={"truth_file": truth})
    thread.start()
    yield service, truth
    stop.set()
    thread.join(10.0)
    assert not thread.is_alive()


def read_until(port: serial.Serial, what: bytes) -> bytes:
    heard = port.read_until(what)
    assert heard.endswith(what), heard
    return heard


def test_the_motion_board_survives_hosts_that_come_and_go(served):
    service, _ = served
    for _ in range(3):
        with serial.Serial(service.motion_port, 115200, timeout=5.0) as port:
            port.write(b"\x18")
            read_until(port, b"'$' for help]\r\n")
            port.write(b"?")
            assert b"MPos:" in read_until(port, b">\r\n")


def test_the_can_adapter_reaches_the_drive(served):
    service, _ = served
    with serial.Serial(service.spindle_port, 115200, timeout=5.0) as port:
        port.write(b"V\r")
        assert read_until(port, b"\r") == b"V1013\r"
        port.write(b"S8\rO\r")
        read_until(port, b"\r\r")
        heard = b""
        while b"t5818" not in heard:
            # A request before the drive has booted is lost.
            port.write(b"t60184000100000000000\r")
            read_until(port, b"z\r")
            port.timeout = 0.2
            heard = port.read_until(b"\r")
        assert heard == b"t58184300100092010200\r"


def test_both_streams_show_the_same_exposures_in_time(served):
    service, _ = served
    seen = []
    for url in service.camera_urls:
        with urllib.request.urlopen(url, timeout=5) as stream:
            assert stream.headers["X-Serial"] == f"{service.bench.serial_number}-{url.rpartition('/')[2]}"
            times = []
            while len(times) < 10:
                line = stream.readline()
                if line.startswith(b"Content-Length"):
                    size = int(line.split()[1])
                elif line.startswith(b"X-Timestamp"):
                    times.append(float(line.split()[1]))
                    stream.readline()
                    picture = cv2.imdecode(np.frombuffer(stream.read(size), np.uint8), cv2.IMREAD_COLOR)
            assert times == sorted(set(times))
            assert 0.0 < time.monotonic() - times[-1] < 2.0
            seen.append(int(picture.mean()))
    assert seen == pytest.approx([100, 150], abs=2)


def test_the_truth_is_there_at_the_end(tmp_path):
    service = BenchService(tiny_bench())
    truth = tmp_path / "truth.json"
    service.run(lambda: service.bench.now_s > 0.05, truth_file=truth)
    told = json.loads(truth.read_text())
    assert told["membrane_touched"] is False
    assert told["tip_mm"] == [20.0, 0.0, 15.0]
    assert told["time_s"] == service.bench.now_s
    assert list(tmp_path.iterdir()) == [truth]


def test_every_wire_ends_with_the_service():
    service = BenchService(tiny_bench())
    ports = service.motion_port, service.spindle_port
    service.close()
    service.close()
    assert not any(os.path.exists(port) for port in ports)  # noqa: PTH110


class JumpingClock:
    """A millisecond a look, and once a long time."""

    def __init__(self) -> None:
        self.time_s = 100.0
        self.looks = 0

    def now_s(self) -> float:
        self.looks += 1
        self.time_s += 5.0 if self.looks == 200 else 0.0002
        return self.time_s

    def sleep_s(self, duration_s: float) -> None:
        self.time_s += max(0.0, duration_s)


def test_of_a_long_gap_most_is_left_out():
    """A drive must not take the emulator's own sleep for a host that is silent."""
    service = BenchService(tiny_bench(), clock=JumpingClock())
    loops, steps = [], []
    advance = service.bench.advance_to

    def watched_advance(time_s: float) -> None:
        steps.append(time_s - service.bench.now_s)
        advance(time_s)

    service.bench.advance_to = watched_advance

    def stopped() -> bool:
        loops.append(None)
        return len(loops) > 300

    service.run(stopped)
    assert service.skipped_s == pytest.approx(5.0 - LONGEST_LAG_S, abs=0.01)
    assert max(steps) < 0.0101


def test_a_status_tells_what_a_person_wants_to_see():
    service = BenchService(tiny_bench())
    told = []
    service.run(lambda: len(told) > 1, on_status=told.append)
    assert told[-1].tip_mm == (20.0, 0.0, 15.0)
    assert told[-1].motion == "Alarm"
    assert told[-1].spindle_rpm == 0.0


def test_a_host_that_does_not_read_delays_nobody_and_reads_the_oldest_later():
    port = SerialPty()
    with serial.Serial(port.path, 115200, timeout=1.0) as host:
        for _ in range(5000):
            port.write(bytes(range(100)))
        heard = b""
        while part := host.read(max(1, host.in_waiting)):
            heard += part
            port.write(b"")
            if len(heard) >= PENDING_MAX and not host.in_waiting:
                host.timeout = 0.05
    port.close()
    assert PENDING_MAX <= len(heard) < 5000 * 100
    assert heard == (bytes(range(100)) * 5000)[: len(heard)]


def test_bytes_pass_raw():
    port = SerialPty()
    with serial.Serial(port.path, 115200, timeout=1.0) as host:
        everything = bytes(range(256))
        host.write(everything)
        assert port.read() == everything
        port.write(everything)
        assert host.read(256) == everything
    port.close()


def test_a_file_is_replaced_as_a_whole(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    write_atomically(path, "new")
    assert path.read_text() == "new"
    with pytest.raises(FileNotFoundError):
        write_atomically(tmp_path / "nowhere" / "file", "new")
    assert list(tmp_path.iterdir()) == [path]


COMPILED = """
from firmware_sim import machine
from firmware_sim.serve import _compile
from firmware_sim.specimen import draw_specimen

_compile(draw_specimen(0))
called = {name: found for name, found in vars(machine).items() if hasattr(found, "signatures")}
print(len(called) > 3, [name for name, found in called.items() if not found.signatures])
"""


def test_nothing_is_left_to_be_compiled_on_an_open_wire() -> None:
    """In a process of its own, where nothing was compiled before: half a second of it is longer than a drive waits."""
    said = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "True []"
