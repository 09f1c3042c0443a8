"""The CAN tables typed from the manuals, run against the driver and against the emulated drive and adapter."""

import runpy
from collections import deque
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.errors import DeviceFaultError
from drivers.spindle import canopen_node, cia402_profile, emergency
from drivers.spindle.canbus import SlcanBus
from drivers.spindle.canopen_node import CanOpenNode, Entry
from drivers.spindle.cia402_profile import TOWARDS_ENABLED, DriveState
from drivers.spindle.cia402_setup import COMMAND_LAYOUT, REPORT_LAYOUT
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.clock import SimClock
from firmware_sim.slcan_adapter import SlcanAdapter

TABLES: dict[str, list[Any]] = runpy.run_path(str(Path(__file__).parents[1] / "data" / "can_manual_tables.py"))
TICK_S = 0.02
BOOT_S = 0.2
SLOW_S = 0.4


class FreeShaft:
    """A shaft without a load."""

    def turn(self, time_s: float, speed_rpm: float) -> None:
        pass

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        return 0.0


class Drive:
    """The emulated drive, in steps as the tables write them."""

    def __init__(self, steps: str | None = "") -> None:
        self.node = Cia402Drive(FreeShaft())
        self.time_s = 0.0
        if steps is None:
            return
        self.wait(BOOT_S)
        self.node.transmit()
        # A fast ramp, a target, and a watched host whose silence is a fault.
        for key, value, size in (((0x6083, 0), 10_000_000, 4), ((0x60FF, 0), 30_000, 4), ((0x6007, 0), 1, 2)):
            self.node.write_object(key, value.to_bytes(size, "little"))
        self.node.write_object((0x6060, 0), b"\x03")
        self.go(steps)

    @property
    def statusword(self) -> int:
        return int.from_bytes(self.node.read_object((0x6041, 0)), "little")

    def wait(self, duration_s: float) -> None:
        self.time_s += duration_s
        self.node.advance_to(self.time_s)

    def go(self, steps: str) -> None:
        for step in steps.split():
            if step == "...":
                self.wait(BOOT_S if self.time_s == 0 else TICK_S)
            elif step == "slow":
                self.wait(SLOW_S)
            elif step == "silence":
                self.node.write_object((0x1016, 1), (127 << 16 | 4).to_bytes(4, "little"))
                self.node.receive(0x77F, b"\x05")
                self.wait(0.008)
            else:
                self.node.write_object((0x6040, 0), int(step, 16).to_bytes(2, "little"))

    def hear(self, frame: str) -> list[tuple[int, bytes]]:
        can_id, _, data = frame.partition(" ")
        self.node.receive(int(can_id, 16), bytes.fromhex(data))
        return self.node.transmit()

    def answer(self, request: str) -> str:
        ((can_id, data),) = self.hear(f"601 {request}")
        assert can_id == 0x581
        return data.hex(" ")


class AnsweringBus(can.BusABC):
    """Expects one request, as often as it is made, and answers it."""

    def __init__(self, request: str = "", answer: str = "") -> None:
        self.channel_info = "table"
        self._request, self._answer = bytes.fromhex(request), bytes.fromhex(answer)
        self.arrived: deque[can.Message] = deque()
        self.sent: list[tuple[int, str]] = []
        super().__init__(channel="table")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.sent.append((msg.arbitration_id, bytes(msg.data).hex(" ")))
        if self._request:
            assert (msg.arbitration_id, bytes(msg.data)) == (0x601, self._request)
            self.arrive(0x581, self._answer)

    def arrive(self, can_id: int, data: bytes) -> None:
        self.arrived.append(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.arrived.popleft() if self.arrived else None


def host(bus: AnsweringBus) -> CanOpenNode:
    return CanOpenNode(bus, SimClock(), 1)


def test_states_driver() -> None:
    """Every statusword there is."""
    for word in range(0x1_0000):
        names = [name for mask, value, name, _ in TABLES["STATES"] if word & mask == value]
        state = DriveState.of(word)
        assert ([] if state is None else [str(state)]) == names, f"{word:04X}"


@pytest.mark.parametrize(("mask", "value", "name", "steps"), TABLES["STATES"])
def test_states_drive(mask: int, value: int, name: str, steps: str | None) -> None:
    assert Drive(steps).statusword & mask == value


@pytest.mark.parametrize(("number", "before", "steps", "bits"), TABLES["TRANSITIONS"])
def test_transitions_drive(number: str, before: str | None, steps: str, bits: int) -> None:
    drive = Drive(before)
    assert drive.statusword & 0x6F != bits or number.startswith("no way")
    drive.go(steps)
    assert drive.statusword & 0x6F == bits


@pytest.mark.parametrize(("name", "mask", "value"), TABLES["COMMANDS"])
def test_commands_driver(name: str, mask: int, value: int) -> None:
    assert getattr(cia402_profile, name) & mask == value


def test_the_way_to_operation_driver() -> None:
    wanted = {state: getattr(cia402_profile, command) for state, command in TABLES["TOWARDS"]}
    assert {str(state): command for state, command in TOWARDS_ENABLED.items()} == wanted


@pytest.mark.parametrize(("index", "subindex", "layout", "value", "request_hex", "answer"), TABLES["UPLOADS"])
def test_uploads_driver(
    index: int, subindex: int, layout: str, value: int | None, request_hex: str, answer: str
) -> None:
    with AnsweringBus(request_hex, answer) as bus:
        assert host(bus).read_if_present(Entry(index, subindex, layout, "row")) == value


@pytest.mark.parametrize(
    ("index", "subindex", "layout", "value", "request_hex", "answer"), TABLES["DOWNLOADS"] + TABLES["PDO_MAPPING"]
)
def test_downloads_driver(index: int, subindex: int, layout: str, value: int, request_hex: str, answer: str) -> None:
    with AnsweringBus(request_hex, answer) as bus:
        host(bus).write(Entry(index, subindex, layout, "row"), value)


@pytest.mark.parametrize(("request_hex", "answer"), [row[4:] for row in TABLES["UPLOADS"] + TABLES["DOWNLOADS"]])
def test_transfers_drive(request_hex: str, answer: str) -> None:
    booted = Cia402Drive(FreeShaft())
    booted.advance_to(BOOT_S)
    booted.transmit()
    booted.receive(0x601, bytes.fromhex(request_hex))
    assert booted.transmit() == [(0x581, bytes.fromhex(answer))]


def mapped_drive() -> Drive:
    drive = Drive()
    for *_, request_hex, answer in TABLES["PDO_MAPPING"]:
        assert drive.answer(request_hex) == answer
    drive.hear("000 01 01")
    return drive


@pytest.mark.parametrize(("data", "controlword", "speed_rpm"), TABLES["COMMAND_FRAMES"])
def test_command_frames_driver(data: str, controlword: int, speed_rpm: int) -> None:
    assert COMMAND_LAYOUT.pack(controlword, speed_rpm).hex(" ") == data


@pytest.mark.parametrize(("data", "controlword", "speed_rpm"), TABLES["COMMAND_FRAMES"])
def test_command_frames_drive(data: str, controlword: int, speed_rpm: int) -> None:
    drive = mapped_drive()
    drive.hear(f"201 {data}")
    assert int.from_bytes(drive.node.read_object((0x6040, 0)), "little") == controlword
    assert int.from_bytes(drive.node.read_object((0x60FF, 0)), "little") == speed_rpm


@pytest.mark.parametrize(("data", "statusword", "speed_rpm", "torque_per_mille"), TABLES["REPORT_FRAMES"])
def test_report_frames_driver(data: str, statusword: int, speed_rpm: int, torque_per_mille: int) -> None:
    assert REPORT_LAYOUT.unpack(bytes.fromhex(data)) == (statusword, speed_rpm, torque_per_mille)


@pytest.mark.parametrize(("data", "statusword", "speed_rpm", "torque_per_mille"), TABLES["REPORT_FRAMES"])
def test_report_frames_drive(data: str, statusword: int, speed_rpm: int, torque_per_mille: int) -> None:
    drive = mapped_drive()
    for index, value in ((0x6041, statusword), (0x606C, speed_rpm), (0x6077, torque_per_mille)):
        drive.node.dictionary[index, 0] = value
    assert drive.hear("080 ") == [(0x181, bytes.fromhex(data))]


@pytest.mark.parametrize(("code", "answer", "written"), [(row[0], *row[2:]) for row in TABLES["ABORTS"] if row[3]])
def test_aborts_driver(code: int, answer: str, written: tuple[int, int, str, int]) -> None:
    index, subindex, layout, value = written
    with AnsweringBus(sdo_download(*written), answer) as bus, pytest.raises(DeviceFaultError, match=f"{code:08X}"):
        host(bus).write(Entry(index, subindex, layout, "row"), value)


def sdo_download(index: int, subindex: int, layout: str, value: int) -> str:
    """The request of the row that writes this."""
    (request,) = (row[1][0] for row in TABLES["ABORTS"] if row[3] == (index, subindex, layout, value))
    return str(request)


@pytest.mark.parametrize(("requests", "answer"), [row[1:3] for row in TABLES["ABORTS"]])
def test_aborts_drive(requests: list[str], answer: str) -> None:
    drive = Drive()
    assert [drive.answer(request) for request in requests][-1] == answer


@pytest.mark.parametrize(("code", "frame", "words", "steps"), TABLES["EMERGENCIES"])
def test_emergencies_driver(code: int, frame: str, words: str, steps: list[str] | None) -> None:
    with AnsweringBus() as bus:
        node = host(bus)
        bus.arrive(0x081, bytes.fromhex(frame))
        node.pump()
        assert node.emergencies == [code]
    assert words in emergency.words(code)
    assert not emergency.is_reset(code)


@pytest.mark.parametrize(("frame", "steps"), [(row[1], row[3]) for row in TABLES["EMERGENCIES"] if row[3]])
def test_emergencies_drive(frame: str, steps: list[str]) -> None:
    drive = Drive()
    heard = []
    for step in steps:
        if step == "...":
            drive.wait(0.1)
            heard += drive.node.transmit()
        else:
            heard += drive.hear(step)
    assert next(data.hex(" ") for can_id, data in heard if can_id == 0x081) == frame


@pytest.mark.parametrize(("name", "data"), [row[:2] for row in TABLES["NMT"] if row[0]])
def test_nmt_commands_driver(name: str, data: str) -> None:
    with AnsweringBus() as bus:
        host(bus).command(getattr(canopen_node, name))
        assert bus.sent == [(0x000, data)]


@pytest.mark.parametrize("state", sorted({row[2] for row in TABLES["NMT"]}))
def test_heartbeats_driver(state: int) -> None:
    with AnsweringBus() as bus:
        node = host(bus)
        bus.arrive(0x701, bytes((state,)))
        node.pump()
        assert node.nmt_state == state
        assert node.boot_ups == (state == 0)


@pytest.mark.parametrize(("name", "data", "state"), TABLES["NMT"])
def test_nmt_drive(name: str | None, data: str, state: int) -> None:
    drive = Drive()
    drive.answer("2b 17 10 00 0a 00 00 00")  # a beat each 10 ms
    assert drive.hear(f"000 {data}") == []
    drive.wait(0.1)
    assert {frame for frame in drive.node.transmit() if frame[0] == 0x701} == {(0x701, bytes((state,)))}


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


@pytest.mark.parametrize(("bit_rate", "command"), TABLES["BIT_RATES"])
def test_bit_rates_driver(bit_rate: int, command: bytes) -> None:
    wire = OneReadLine()
    with SlcanBus(wire, bit_rate):
        assert wire.written[-2:] == [command, b"O\r"]
    assert wire.written[-1] == b"C\r"


@pytest.mark.parametrize(("command", "reply"), TABLES["SLCAN_COMMANDS"])
def test_slcan_commands_adapter(command: bytes, reply: bytes) -> None:
    adapter = SlcanAdapter([])
    adapter.receive(command)
    assert adapter.transmit() == reply


@pytest.mark.parametrize(("answer", "meaning"), TABLES["SLCAN_ANSWERS"])
def test_slcan_answers_driver(answer: bytes, meaning: Any) -> None:
    wire = OneReadLine()
    with SlcanBus(wire, 1_000_000) as bus:
        wire.incoming = answer
        if isinstance(meaning, str):
            with pytest.raises(can.CanOperationError, match=meaning):
                bus.recv(0.0)
            return
        heard = bus.recv(0.0)
    told = None if heard is None else (heard.arbitration_id, heard.is_extended_id, heard.data.hex().upper())
    assert told == meaning


@pytest.mark.parametrize(("can_id", "data", "line"), TABLES["SLCAN_FRAMES"])
def test_slcan_frames_driver(can_id: int, data: str, line: bytes) -> None:
    wire = OneReadLine()
    with SlcanBus(wire, 1_000_000) as bus:
        bus.send(can.Message(arbitration_id=can_id, data=bytes.fromhex(data), is_extended_id=False))
        assert wire.written[-1] == line
        wire.incoming = line
        heard = bus.recv(0.0)
    assert heard is not None
    assert (heard.arbitration_id, bytes(heard.data)) == (can_id, bytes.fromhex(data))


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


@pytest.mark.parametrize(("can_id", "data", "line"), TABLES["SLCAN_FRAMES"])
def test_slcan_frames_adapter(can_id: int, data: str, line: bytes) -> None:
    frame = (can_id, bytes.fromhex(data))
    node = Node(frame)
    adapter = SlcanAdapter([node])
    adapter.receive(b"S8\rO\r")
    adapter.advance_to(0.1)
    assert adapter.transmit() == b"\r\r" + line
    adapter.receive(line)
    adapter.advance_to(0.2)
    assert node.heard == [frame]
