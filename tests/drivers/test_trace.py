"""Traces: every byte and frame in its order, nothing held up by the disk, what a kill leaves is readable."""

import errno
import os
import threading
from pathlib import Path

import can
import numpy as np
import pytest
from grbl_wire import ORIGIN_MM, SETTINGS, Bench
from hypothesis import given
from hypothesis import strategies as st
from pytest_mock import MockerFixture

from drivers.camera.stereo import StereoPair
from drivers.errors import ConfigError, ConnectionLostError, NotHomedError
from drivers.motion.grbl.driver import GrblController
from drivers.recorder import NullRecorder, TracedRecorder
from drivers.spindle.cia402 import Cia402Spindle
from drivers.trace import TracedBus, TracedLine, TracedSource
from drivers.trace_file import ERROR, EXTENDED, REMOTE, Entry, Trace, frame_of, frame_text, read_trace, write_trace
from drivers.traced_devices import TracedMotion, TracedSpindle
from firmware_sim.bench import Bench as WholeBench
from firmware_sim.bench import open_in_process
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine


def kinds(entries: list[Entry]) -> list[tuple[str, object]]:
    return [(entry.kind, entry.data) for entry in entries]


def traced_controller(file: Path) -> tuple[TracedMotion, Trace, Bench]:
    bench = Bench("gnea", SETTINGS)
    trace = Trace(file, bench.clock, {})
    line = TracedLine(InProcessLine(bench.board, bench.clock), trace, "motion")
    return (
        TracedMotion(GrblController(line, bench.clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0), trace),
        trace,
        bench,
    )


def test_every_byte_of_a_session_is_there_in_its_order(tmp_path: Path) -> None:
    motion, trace, bench = traced_controller(tmp_path / "t.jsonl")
    motion.home()
    motion.start_move((1.0, 2.0, 3.0), feed_mm_per_s=10.0)
    motion.wait_until_idle(10.0)
    motion.close()
    trace.close()
    log = read_trace(tmp_path / "t.jsonl")
    assert log.damage is None
    assert [entry.data["verb"] for entry in log.entries if entry.kind == "call"] == [
        "home",
        "start_move",
        "wait_until_idle",
        "close",
    ]
    said = "".join(entry.data for entry in log.entries if entry.kind == "in")
    assert said.count("ok\r\n") == said.replace("\r\n", "\n").split("\n").count("ok")
    told = "".join(entry.data for entry in log.entries if entry.kind == "out")
    assert told.startswith("\x18")
    assert "$H\n" in told
    assert "G53G1X" in told
    times = [entry.t_s for entry in log.entries]
    assert times == sorted(times)
    assert times[-1] == pytest.approx(bench.clock.now_s(), abs=0.1)


def test_an_urgent_call_is_written_down_behind_its_bytes_and_read_before_them(tmp_path: Path) -> None:
    motion, trace, _ = traced_controller(tmp_path / "t.jsonl")
    motion.halt()
    trace.close()
    lines = (tmp_path / "t.jsonl").read_text().splitlines()
    assert '"verb":"halt"' in lines[-1]
    assert kinds(read_trace(tmp_path / "t.jsonl").entries)[-2:] == [
        ("call", {"verb": "halt", "args": {}}),
        ("out", "!\x18"),
    ]


def test_what_a_call_raises_is_written_down(tmp_path: Path) -> None:
    motion, trace, _ = traced_controller(tmp_path / "t.jsonl")
    with pytest.raises(NotHomedError):
        motion.start_move((1.0, 2.0, 3.0), feed_mm_per_s=10.0)
    trace.close()
    assert "home() first" in str(read_trace(tmp_path / "t.jsonl").entries[-1].data)
    assert read_trace(tmp_path / "t.jsonl").entries[-1].kind == "error"


def test_a_lost_wire_is_written_down(tmp_path: Path) -> None:
    clock = SimClock()
    line = InProcessLine(Bench("gnea", SETTINGS).board, clock)
    with Trace(tmp_path / "t.jsonl", clock, {}) as trace:
        traced = TracedLine(line, trace, "motion")
        line.close()
        with pytest.raises(ConnectionLostError):
            traced.write(b"?")
    (entry,) = read_trace(tmp_path / "t.jsonl").entries
    assert entry.kind == "error"


def test_a_full_disk_ends_the_trace_and_nothing_else(tmp_path: Path, mocker: MockerFixture) -> None:
    lost: list[str] = []
    clock = SimClock()
    board = Bench("gnea", SETTINGS).board
    trace = Trace(tmp_path / "t.jsonl", clock, {}, on_loss=lost.append)
    line = TracedLine(InProcessLine(board, clock), trace, "motion")
    line.write(b"?")
    mocker.patch("os.write", side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    line.write(b"?")
    line.write(b"?")
    trace.close()
    assert len(lost) == 1
    assert "the session goes on" in lost[0]
    assert len(read_trace(tmp_path / "t.jsonl").entries) == 1


@pytest.mark.parametrize("cut", [1, 5, 30])
def test_what_a_kill_leaves_is_readable(cut: int, tmp_path: Path) -> None:
    with Trace(tmp_path / "t.jsonl", SimClock(), {}) as trace:
        for number in range(5):
            trace.event("lap", lap=number, text="long enough to tear")
    whole = (tmp_path / "t.jsonl").read_bytes()
    (tmp_path / "t.jsonl").write_bytes(whole[:-cut])
    log = read_trace(tmp_path / "t.jsonl")
    assert len(log.entries) == (5 if cut == 1 else 4)
    assert (log.damage is None) == (cut == 1)


def test_threads_leave_whole_lines_and_different_numbers(tmp_path: Path) -> None:
    with Trace(tmp_path / "t.jsonl", SimClock(), {}) as trace:

        def write() -> None:
            for number in range(200):
                trace.event("lap", lap=number)

        threads = [threading.Thread(target=write) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    entries = read_trace(tmp_path / "t.jsonl").entries
    assert [entry.number for entry in entries] == list(range(1, 801))


def test_frames_of_a_spindle_and_pictures_of_a_camera_are_there(tmp_path: Path) -> None:
    clock = SimClock()
    bench = WholeBench()
    black = np.zeros((4, 4, 3), np.uint8)
    shots = iter(range(1, 255))

    def render(_time_s: float) -> tuple[np.ndarray, np.ndarray]:
        level = next(shots)
        return black + np.uint8(level), black + np.uint8(level)

    _, bus, left, right = open_in_process(bench, clock, render=render)
    with Trace(tmp_path / "t.jsonl", clock, {}) as trace:
        traced = TracedBus(bus, trace, "spindle")
        with TracedSpindle(Cia402Spindle(traced, clock, node_id=1, max_speed_rpm=60_000), trace) as spindle:
            spindle.start(30_000.0)
            spindle.wait_until_at_speed(3.0)
        eyes = TracedSource(left, trace, "left"), TracedSource(right, trace, "right")
        with StereoPair(*eyes, clock, size_px=(4, 4), max_skew_s=0.02) as camera:
            frame = camera.capture()
            camera.latest()
    log = read_trace(tmp_path / "t.jsonl")
    sent = [entry.data for entry in log.entries if (entry.wire, entry.kind) == ("spindle", "out")]
    assert "201#0F0030750000" in sent
    assert any(entry.data.startswith("181#") for entry in log.entries if (entry.wire, entry.kind) == ("spindle", "in"))
    seen = [entry for entry in log.entries if entry.wire == "left"]
    assert seen[0].data == {"exposed_s": pytest.approx(frame.exposed_at_s)}
    assert len({entry.data["exposed_s"] for entry in seen}) == len(seen)


def test_decisions_go_into_record_and_trace(tmp_path: Path) -> None:
    with Trace(tmp_path / "t.jsonl", SimClock(), {}) as trace:
        TracedRecorder(NullRecorder(), trace).event("lap", depth_mm=np.array([0.1, float("nan")]))
    assert kinds(read_trace(tmp_path / "t.jsonl").entries) == [("event", {"kind": "lap", "depth_mm": [0.1, None]})]


@given(
    flags=st.sampled_from([0, EXTENDED, ERROR, EXTENDED | REMOTE, REMOTE]),
    can_id=st.integers(0, 0x7FF),
    data=st.binary(max_size=8),
)
def test_a_frame_as_text_is_the_frame(flags: int, can_id: int, data: bytes) -> None:
    data = b"" if flags & REMOTE else data
    assert frame_of(frame_text(can_id, data, flags=flags)) == (can_id, flags, data)


def test_frames_are_written_as_candump_writes_them() -> None:
    assert frame_text(0x201, b"\x0f\x00") == "201#0F00"
    assert frame_text(0x1F334455, b"\x11", flags=EXTENDED) == "1F334455#11"
    assert frame_text(0x123, b"", flags=REMOTE) == "123#R"
    with pytest.raises(ConfigError, match="no CAN frame"):
        frame_of("201")


def test_a_bus_is_shut_down_once_and_its_errors_are_written_down(tmp_path: Path) -> None:
    clock = SimClock()
    bus = TracedBus(open_in_process(WholeBench(), clock)[1], Trace(tmp_path / "t.jsonl", clock, {}), "spindle")
    with pytest.raises(can.CanOperationError):
        bus.send(can.Message(arbitration_id=1, is_remote_frame=True))
    bus.shutdown()
    bus.shutdown()
    assert [entry.kind for entry in read_trace(tmp_path / "t.jsonl").entries] == ["error"]


def test_a_file_is_used_once_and_anything_else_is_no_trace(tmp_path: Path) -> None:
    Trace(tmp_path / "t.jsonl", SimClock(), {}).close()
    with pytest.raises(ConfigError, match="exists already"):
        Trace(tmp_path / "t.jsonl", SimClock(), {})
    with pytest.raises(ConfigError, match="exists already"):
        write_trace(tmp_path / "t.jsonl", {}, [])
    with pytest.raises(ConfigError, match="cannot be read"):
        read_trace(tmp_path / "none.jsonl")
    (tmp_path / "other").write_text("")
    with pytest.raises(ConfigError, match="is no trace"):
        read_trace(tmp_path / "other")
