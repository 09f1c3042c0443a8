"""Recorded inputs, spoilt at random, into every parser that reads what mill did not write.

    python tests/drivers/fuzz.py --inputs 1000000     (or: make fuzz)

gives each parser of ``TARGETS`` so many. Each input ends in a result or in one of the errors that the parser promises;
it takes a number of calls that its length bounds; and a parser that has seen the second half of the inputs holds no
more memory than before. A new parser is one line in the table: its name, its recorded inputs, what makes a function
that takes one, and the errors allowed.
"""

import argparse
import gc
import io
import logging
import os
import random
import sys
import tempfile
import tracemalloc
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
from fuzz_recorded import bcap_replies, g2core_answers, modbus_replies
from pymodbus.framer.rtu import FramerRTU
from sessions import HandClock, load

from drivers.camera.multipart import PartReader
from drivers.clock import SystemClock
from drivers.errors import (
    ConfigError,
    ConnectionLostError,
    DeviceFaultError,
    DeviceTimeoutError,
    ProtocolError,
)
from drivers.motion.bcap.packet import decode
from drivers.motion.grbl.protocol import Parser, parse_line
from drivers.motion.tinyg import protocol as g2core
from drivers.spindle import delta_registers
from drivers.spindle.canbus import SlcanBus
from drivers.spindle.canopen_node import CanOpenNode, Entry
from drivers.spindle.modbus_wire import ModbusWire
from drivers.trace_file import read_trace
from milling.record import RunRecorder, read_run

Feed = Callable[[bytes], Any]
GROWTH_BYTES = 64 * 1024
"""More than the interpreter's own caches vary by; a parser that keeps one object of each input is far beyond."""
CALLS_PER_INPUT, CALLS_PER_BYTE = 4000, 40


@dataclass(frozen=True)
class Target:
    """One parser. ``make`` gives the function that takes an input; the parser behind it lives as long as that does.

    It is given an empty folder.
    """

    name: str
    recorded: Callable[[], Sequence[bytes]]
    make: Callable[[Path], Feed]
    allowed: tuple[type[Exception], ...] = (ProtocolError,)


def spoil(data: bytes, corpus: Sequence[bytes], rng: random.Random) -> bytes:
    """One to four changes: a splice with another input, or a part deleted, inserted, flipped, doubled or cut off."""
    spoilt = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(spoilt) + 1)
        end = min(len(spoilt), at + rng.choice((1, 1, 1, 2, 8)))
        match rng.randrange(6):
            case 0:
                other = rng.choice(corpus)
                spoilt[at:] = other[rng.randrange(len(other) + 1) :]
            case 1:
                del spoilt[at:end]
            case 2:
                spoilt[at:at] = rng.randbytes(rng.choice((1, 1, 2, 8)))
            case 3 if at < len(spoilt):
                spoilt[at] ^= 1 << rng.randrange(8)
            case 4:
                spoilt[at:at] = spoilt[at:end] * rng.choice((1, 2, 50))
            case 5:
                del spoilt[at:]
    return bytes(spoilt)


def check(target: Target, inputs: int, seed: int = 0) -> int:
    """Raise AssertionError for what must not be; how many inputs ended in an allowed error."""
    memory = "/dev/shm"
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as place:
        return _check(target, target.make(Path(place)), inputs, seed)


def _check(target: Target, feed: Feed, inputs: int, seed: int) -> int:
    corpus, rng, errors = target.recorded(), random.Random(seed), 0
    calls = [0]

    def count(frame: object, event: str, argument: object) -> None:
        calls[0] += event in ("call", "c_call")

    for number in range(inputs):
        if number == inputs // 2:
            gc.collect()
            tracemalloc.start()
        data = spoil(rng.choice(corpus), corpus, rng)
        calls[0] = 0
        sys.setprofile(count)
        try:
            feed(data)
        except target.allowed:
            errors += 1
        except Exception as error:
            raise AssertionError(f"{target.name}, seed {seed}, input {number} {data!r}: {error!r}") from error
        finally:
            sys.setprofile(None)
        bound = CALLS_PER_INPUT + CALLS_PER_BYTE * len(data)
        assert calls[0] <= bound, f"{target.name}, seed {seed}, input {number}: {calls[0]} calls for {data!r}"
    gc.collect()
    grown = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert grown <= GROWTH_BYTES, f"{target.name}: {grown} bytes more after {inputs // 2} inputs"
    return errors


def _grbl_lines() -> Sequence[bytes]:
    return b"".join(exchange.said for exchange in load("grbl.txt")).splitlines()


def _grbl_answers() -> Sequence[bytes]:
    return [exchange.said for exchange in load("grbl.txt") if exchange.said]


def _slcan_answers() -> Sequence[bytes]:
    return [exchange.said for exchange in load("slcan.txt") if exchange.said]


class _FedLine:
    """A serial line whose other end is the fuzzer."""

    name, descriptor = "fuzzed:wire", None

    def __init__(self, clock: HandClock | None = None) -> None:
        self.due = b""
        self._clock = clock

    def write(self, data: bytes) -> None:
        pass

    def read(self, timeout_s: float) -> bytes:
        data, self.due = self.due, b""
        if not data and self._clock is not None:
            self._clock.sleep_s(timeout_s)
        return data

    def close(self) -> None:
        pass


def _slcan(_place: Path) -> Feed:
    line = _FedLine()
    bus = SlcanBus(line, 1_000_000)
    bus._is_shutdown = True  # there is nothing to close

    def feed(data: bytes) -> None:
        line.due, error = data, None
        while line.due or bus._lines:
            try:
                message = bus.recv(0.0)
                assert message is None or len(message.data) <= 8
            except can.CanOperationError as refused:
                error = refused
        if error is not None:
            raise error

    return feed


def _can_frames() -> Sequence[bytes]:
    """Identifier (two bytes), length and data of each frame that the recorded drive sent, eight frames an input."""
    frames = []
    for body in b"".join(_slcan_answers()).split(b"\r"):
        if body.startswith(b"t"):
            data = bytes.fromhex(body[5:].decode())
            frames.append(int(body[1:4], 16).to_bytes(2, "big") + bytes((len(data),)) + data)
    return [b"".join(frames[at : at + 8]) for at in range(0, len(frames), 4)]


class _FedBus(can.BusABC):
    def __init__(self, clock: HandClock) -> None:
        self.channel_info, self._clock = "fuzzed:bus", clock
        self.due: deque[can.Message] = deque()
        super().__init__(channel="fuzzed")
        self._is_shutdown = True

    def feed(self, data: bytes) -> None:
        self.due.clear()
        while len(data) >= 3:
            length = min(data[2] & 0xF, 8)
            can_id, body = int.from_bytes(data[:2], "big") & 0x7FF, data[3 : 3 + length]
            self.due.append(can.Message(arbitration_id=can_id, data=body, is_extended_id=False))
            data = data[3 + length :]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        pass

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.due:
            return self.due.popleft()
        # One long wait instead of fifty short ones.
        self._clock.sleep_s(10.0 if timeout else 0.0)
        return None


def _canopen(_place: Path) -> Feed:
    logging.getLogger("canopen").setLevel(logging.CRITICAL)
    clock = HandClock()
    bus = _FedBus(clock)
    nodes = [CanOpenNode(bus, clock, 1)]
    device_type = Entry(0x1000, 0, "I", "device type")

    def feed(data: bytes) -> None:
        node = nodes[-1]
        if node.lost:
            nodes[:] = [node := CanOpenNode(bus, clock, 1)]
            node.expect_report_bytes(8)
        bus.feed(data)
        if len(data) % 4:
            node.pump()
        else:
            number = node.read_if_present(device_type)
            assert number is None or 0 <= number < 1 << 32
        node.emergencies.clear()

    return feed


def _parts() -> Sequence[bytes]:
    inputs = []
    for stamp in ("X-Timestamp: 12345.678901", "X-Serial: 7"):
        part = b"--b0und\r\nContent-Type: image/jpeg\r\nContent-Length: 12\r\n" + stamp.encode()
        inputs.append((part + b"\r\n\r\n\xff\xd8 a photo\xff\xd9\r\n") * 3)
    return inputs


def _multipart(data: bytes) -> None:
    reader = PartReader(io.BytesIO(data), b"--b0und", "http://fuzzed/left")
    while True:  # until the end of the stream, which is an error
        picture, stamp_s = reader.read()
        assert stamp_s is None or 0 <= stamp_s < 1e12
        assert isinstance(picture, bytes)


_FILES = ("header.json", "events.jsonl", "result.json")


def _records() -> Sequence[bytes]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        recorder = RunRecorder(folder, {"job": {"n_points": 12}, "seed": 7, "versions": {"mill": "1"}}, SystemClock())
        for step in range(6):
            recorder.event("state", name="milling", depth_mm=0.02 * step, point=[1.0, None, True])
        recorder.close({"outcome": "done", "points": [0.1, 0.2]})
        return [bytes((number,)) + (folder / name).read_bytes() for number, name in enumerate(_FILES)]


def _record(place: Path) -> Feed:
    whole = [data[1:] for data in _records()]
    for name, data in zip(_FILES, whole, strict=True):
        (place / name).write_bytes(data)
    spoilt = [0]

    def feed(data: bytes) -> None:
        (place / _FILES[spoilt[0]]).write_bytes(whole[spoilt[0]])
        spoilt[0] = data[0] % len(_FILES) if data else 0
        (place / _FILES[spoilt[0]]).write_bytes(data[1:])
        run = read_run(place)
        assert isinstance(run.header, dict)
        assert all(isinstance(event, dict) and "kind" in event for event in run.events)

    return feed


def _modbus(_place: Path) -> Feed:
    clock = HandClock()
    line = _FedLine(clock)
    wire = ModbusWire(line, clock, station=1, baud=115_200)

    def feed(data: bytes) -> None:
        if len(data) % 2:
            # A checksum that fits lets what lies behind it have a look at the rest.
            data = data[:-2] + FramerRTU.compute_CRC(data[:-2]).to_bytes(2, "big")
        # What comes before a question is thrown away: the answer is there once it was asked.
        line.write = lambda _frame: setattr(line, "due", data)  # type: ignore[method-assign]
        registers = wire.read(delta_registers.REPORT, delta_registers.REPORT_LENGTH, 0.1)
        assert all(0 <= register < 1 << 16 for register in registers)

    return feed


def _trace_files() -> Sequence[bytes]:
    folder = Path(__file__).parents[1] / "traces"
    return [b"".join(path.read_bytes().splitlines(keepends=True)[:12]) for path in sorted(folder.glob("*.jsonl"))]


def _trace(place: Path) -> Feed:
    path = place / "trace.jsonl"

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        assert isinstance(read_trace(path).header, dict)

    return feed


_OF_A_NODE = (ProtocolError, DeviceFaultError, DeviceTimeoutError, ConnectionLostError)

TARGETS = (
    Target("GRBL lines", _grbl_lines, lambda _: lambda data: parse_line(data.decode("ascii", "backslashreplace"))),
    Target("GRBL stream", _grbl_answers, lambda _: Parser().feed, ()),
    Target("SLCAN", _slcan_answers, _slcan, (can.CanOperationError,)),
    Target("b-CAP packets", bcap_replies, lambda _: decode),
    Target("g2core stream", g2core_answers, lambda _: g2core.Parser().feed, ()),
    Target(
        "g2core lines",
        g2core_answers,
        lambda _: lambda data: g2core.parse_line(data.decode("ascii", "backslashreplace")),
    ),
    Target("Modbus", modbus_replies, _modbus, (ProtocolError, DeviceFaultError, DeviceTimeoutError)),
    Target("trace", _trace_files, _trace, (ConfigError,)),
    Target("CANopen", _can_frames, _canopen, _OF_A_NODE),
    Target("multipart", _parts, lambda _: _multipart, (ProtocolError, ConnectionLostError)),
    Target("record", _records, _record, (ConfigError,)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description="Spoilt inputs into every parser.")
    parser.add_argument("--inputs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="one parser of the table, by name")
    options = parser.parse_args()
    for target in TARGETS:
        if options.only in (None, target.name):
            errors = check(target, options.inputs, options.seed)
            print(f"{target.name}: {options.inputs} inputs, {errors} refused", flush=True)


if __name__ == "__main__":
    main()
