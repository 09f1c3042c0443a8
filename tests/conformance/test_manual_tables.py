"""One table typed from the manuals, run against the driver and against the emulated device."""

import dataclasses
import runpy
from collections import deque
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.motion.grbl.protocol import Parser
from drivers.spindle.canbus import SlcanBus
from drivers.spindle.canopen_node import CanOpenNode, Entry
from drivers.spindle.cia402_profile import DriveState
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.clock import SimClock
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.slcan_adapter import SlcanAdapter

TABLES: dict[str, list[Any]] = runpy.run_path(str(Path(__file__).parents[1] / "data" / "manual_tables.py"))
GRBL_SETTINGS = {f"${first + axis}": value for first, value in ((100, 1000), (110, 1200)) for axis in range(3)}


class Still:
    """Axes without switches and a shaft without a load."""

    def move_to(self, time_s: float, axes_mm: tuple[float, float, float]) -> None:
        pass

    def limit_switches(self) -> tuple[bool, bool, bool]:
        return False, False, False

    def probe_closed(self) -> bool:
        return False

    def turn(self, time_s: float, speed_rpm: float) -> None:
        pass

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        return 0.0


def drive() -> Cia402Drive:
    booted = Cia402Drive(Still())
    booted.advance_to(0.2)
    booted.transmit()
    return booted


@pytest.mark.parametrize(("dialects", "request_bytes", "reply", "values"), TABLES["GRBL"])
def test_grbl_driver(dialects: Any, request_bytes: bytes, reply: bytes, values: list[Any]) -> None:
    understood = [(type(message).__name__, *dataclasses.astuple(message)) for message in Parser().feed(reply)]
    assert understood == values


@pytest.mark.parametrize(
    ("dialect", "request_bytes", "reply"),
    [(dialect, row[1], row[2]) for row in TABLES["GRBL"] for dialect in row[0]],
)
def test_grbl_board(dialect: Any, request_bytes: bytes, reply: bytes) -> None:
    board = GrblBoard(Still(), dialect=dialect, settings=GRBL_SETTINGS | ({"$10": 3} if dialect == "gnea" else {}))
    board.advance_to(0.1)
    board.transmit()
    board.receive(request_bytes)
    board.advance_to(0.2)
    assert board.transmit() == reply


@pytest.mark.parametrize(("controlwords", "bits", "name"), TABLES["STATES"])
def test_state_driver(controlwords: str, bits: int, name: str) -> None:
    assert str(DriveState.of(bits)) == name


@pytest.mark.parametrize(("controlwords", "bits", "name"), TABLES["STATES"])
def test_state_drive(controlwords: str, bits: int, name: str) -> None:
    node = drive()
    for word in controlwords.split():
        node.write_object((0x6040, 0), int(word, 16).to_bytes(2, "little"))
    assert int.from_bytes(node.read_object((0x6041, 0)), "little") & 0x6F == bits


class AnsweringBus(can.BusABC):
    """Expects one request, as often as it is made, and answers it."""

    def __init__(self, request: str, answer: str) -> None:
        self.channel_info = "table"
        self._request, self._answer = bytes.fromhex(request), bytes.fromhex(answer)
        self._arrived: deque[can.Message] = deque()
        super().__init__(channel="table")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        assert (msg.arbitration_id, bytes(msg.data)) == (0x601, self._request)
        self._arrived.append(can.Message(arbitration_id=0x581, data=self._answer, is_extended_id=False))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self._arrived.popleft() if self._arrived else None


@pytest.mark.parametrize(("index", "subindex", "layout", "value", "request_hex", "answer"), TABLES["UPLOADS"])
def test_upload_driver(
    index: int, subindex: int, layout: str, value: int | None, request_hex: str, answer: str
) -> None:
    bus = AnsweringBus(request_hex, answer)
    node = CanOpenNode(bus, SimClock(), 1)
    assert node.read_if_present(Entry(index, subindex, layout, "row")) == value
    bus.shutdown()


@pytest.mark.parametrize(("index", "subindex", "layout", "value", "request_hex", "answer"), TABLES["DOWNLOADS"])
def test_download_driver(index: int, subindex: int, layout: str, value: int, request_hex: str, answer: str) -> None:
    bus = AnsweringBus(request_hex, answer)
    CanOpenNode(bus, SimClock(), 1).write(Entry(index, subindex, layout, "row"), value)
    bus.shutdown()


@pytest.mark.parametrize(("request_hex", "answer"), [row[4:] for row in TABLES["UPLOADS"] + TABLES["DOWNLOADS"]])
def test_sdo_drive(request_hex: str, answer: str) -> None:
    node = drive()
    node.receive(0x601, bytes.fromhex(request_hex))
    assert node.transmit() == [(0x581, bytes.fromhex(answer))]


class OneReadLine:
    """A serial line that silently takes what is written, and can be given one thing to read."""

    name = "table"

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.incoming = b""

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def read(self, timeout_s: float) -> bytes:
        data, self.incoming = self.incoming, b""
        return data

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("can_id", "data", "line"), TABLES["SLCAN"])
def test_slcan_driver(can_id: int, data: str, line: bytes) -> None:
    wire = OneReadLine()
    bus = SlcanBus(wire, 1_000_000)
    bus.send(can.Message(arbitration_id=can_id, data=bytes.fromhex(data), is_extended_id=False))
    assert wire.written[-1] == line
    wire.incoming = line
    heard = bus.recv(0.0)
    assert heard is not None
    assert (heard.arbitration_id, bytes(heard.data)) == (can_id, bytes.fromhex(data))
    bus.shutdown()


class Node:
    """Says one frame, and keeps what it hears."""

    def __init__(self, says: tuple[int, bytes]) -> None:
        self.says = [says]
        self.heard: list[tuple[int, bytes]] = []

    def receive(self, can_id: int, data: bytes) -> None:
        self.heard.append((can_id, data))

    def transmit(self) -> list[tuple[int, bytes]]:
        frames, self.says = self.says, []
        return frames

    def advance_to(self, time_s: float) -> None:
        pass


@pytest.mark.parametrize(("can_id", "data", "line"), TABLES["SLCAN"])
def test_slcan_adapter(can_id: int, data: str, line: bytes) -> None:
    frame = (can_id, bytes.fromhex(data))
    node = Node(frame)
    adapter = SlcanAdapter([node])
    adapter.receive(b"S8\rO\r")
    adapter.advance_to(0.1)
    assert adapter.transmit() == b"\r\r" + line
    adapter.receive(line)
    adapter.advance_to(0.2)
    assert node.heard == [frame]
