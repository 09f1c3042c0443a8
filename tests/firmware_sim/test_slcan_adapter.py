"""The LAWICEL manual as bytes, and python-can's own slcan interface as a second opinion."""

import os
import pty
import select
import threading
import time
import tty

import can
import pytest
from fake_load import FakeLoad

from firmware_sim.can_wire import CanWire
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.slcan_adapter import SlcanAdapter

OPEN = b"S8\rO\r"

TABLE = [
    (b"V\r", b"V1013\r"),
    (b"N\r", b"NML01\r"),
    (b"\r\r\r", b"\r\r\r"),
    # a closed channel
    (b"O\r", b"\a"),  # no bit rate yet
    (b"C\r", b"\a"),
    (b"F\r", b"\a"),
    (b"t1002AABB\r", b"\a"),
    (b"S0\r", b"\r"),
    (b"S8\r", b"\r"),
    (b"S9\r", b"\a"),
    (b"S\r", b"\a"),
    (b"s031C\r", b"\r"),
    (b"s03\r", b"\a"),
    (b"Z1\r", b"\r"),
    (b"Z2\r", b"\a"),
    (b"M00000000\r", b"\r"),
    (b"mFFFFFFFF\r", b"\r"),
    (b"m12\r", b"\a"),
    # an open one
    (OPEN, b"\r\r"),
    (OPEN + b"O\r", b"\r\r\a"),
    (OPEN + b"S6\r", b"\r\r\a"),
    (OPEN + b"Z1\r", b"\r\r\a"),
    (OPEN + b"M00000000\r", b"\r\r\a"),
    (OPEN + b"F\r", b"\r\rF00\r"),
    (OPEN + b"C\rC\r", b"\r\r\r\a"),
    (OPEN + b"t10021133\r", b"\r\rz\r"),
    (OPEN + b"t7FF0\r", b"\r\rz\r"),
    (OPEN + b"t10081122334455667788\r", b"\r\rz\r"),
    (OPEN + b"T0000010021133\r", b"\r\rZ\r"),
    (OPEN + b"T1FFFFFFF0\r", b"\r\rZ\r"),
    (OPEN + b"r1002\r", b"\r\rz\r"),
    (OPEN + b"R000001002\r", b"\r\rZ\r"),
    # refused frames
    (OPEN + b"t1003AABB\r", b"\r\r\a"),
    (OPEN + b"t1001AABB\r", b"\r\r\a"),
    (OPEN + b"t8000\r", b"\r\r\a"),
    (OPEN + b"t1009112233445566778899\r", b"\r\r\a"),
    (OPEN + b"t1001GG\r", b"\r\r\a"),
    (OPEN + b"T200000000\r", b"\r\r\a"),
    (OPEN + b"r1002AABB\r", b"\r\r\a"),
    (OPEN + b"t10\r", b"\r\r\a"),
    (b"S8\rL\rt10021133\r", b"\r\r\a"),  # listening only
    # what is no command
    (b"Q\r", b"\a"),
    (b"V1\r", b"\a"),
    (b"t" * 40 + b"\rV\r", b"\aV1013\r"),
]


@pytest.mark.parametrize(("command", "reply"), TABLE)
@pytest.mark.parametrize("piece", [1, 1000])
def test_replies(command, reply, piece):
    adapter = SlcanAdapter([])
    for start in range(0, len(command), piece):
        adapter.receive(command[start : start + piece])
    assert adapter.transmit() == reply


class EchoNode:
    """Answers every frame with the next identifier."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, bytes]] = []

    def receive(self, can_id: int, data: bytes) -> None:
        self.frames.append((can_id + 1, data))

    def transmit(self) -> list[tuple[int, bytes]]:
        frames, self.frames = self.frames, []
        return frames

    def advance_to(self, time_s: float) -> None:
        pass


def test_frames_pass_both_ways_and_take_their_time():
    adapter = SlcanAdapter([EchoNode()])
    adapter.receive(OPEN + b"t1232aBcD\r")
    assert adapter.transmit() == b"\r\rz\r"
    adapter.advance_to(0.0001)
    assert adapter.transmit() == b""
    adapter.advance_to(0.001)
    assert adapter.transmit() == b"t1242ABCD\r"


def test_time_stamps_are_milliseconds_modulo_a_minute():
    adapter = SlcanAdapter([EchoNode()])
    adapter.receive(b"S8\rZ1\rO\r")
    adapter.advance_to(60.5)
    adapter.receive(b"t1230\r")
    adapter.transmit()
    adapter.advance_to(60.6)
    assert adapter.transmit() == b"t124001F4\r"


def test_a_closed_channel_hears_nothing_later():
    node = EchoNode()
    adapter = SlcanAdapter([node])
    node.receive(0x100, b"")
    adapter.advance_to(0.1)
    adapter.receive(OPEN)
    adapter.advance_to(0.2)
    assert adapter.transmit() == b"\r\r"


def test_another_bit_rate_than_the_bus_hears_nothing_and_fills_the_queue():
    node = EchoNode()
    adapter = SlcanAdapter(CanWire([node], bit_rate=500_000))
    adapter.receive(OPEN + b"t1000\r" * 33 + b"F\r")
    assert adapter.transmit() == b"\r\r" + b"z\r" * 32 + b"\aFA6\r"
    node.frames.append((0x700, b"\x00"))
    adapter.advance_to(0.1)
    assert adapter.transmit() == b""
    adapter.receive(b"C\rS6\rO\rt1000\r")
    adapter.advance_to(0.2)
    assert adapter.transmit() == b"\r\r\rz\rt1010\r"


def test_the_lowest_identifier_wins_the_bus():
    node = EchoNode()
    wire = CanWire([node])
    adapter = SlcanAdapter(wire)
    adapter.receive(OPEN)
    for can_id in (0x300, 0x100, 0x200, 0x100):
        node.frames.append((can_id, bytes((can_id >> 8,))))
    adapter.advance_to(0.01)
    assert adapter.transmit() == b"\r\rt100101\rt100101\rt200102\rt300103\r"


def test_a_bus_carries_no_more_than_its_bit_rate():
    node = EchoNode()
    adapter = SlcanAdapter(CanWire([node], bit_rate=125_000))
    adapter.receive(b"S4\rO\r")
    adapter.transmit()
    node.frames += [(0x100, bytes(8))] * 500
    adapter.advance_to(0.1)
    frames = adapter.transmit().count(b"\r")
    assert 0.1 * 125_000 / 135 <= frames <= 0.1 * 125_000 / 111


@pytest.fixture
def adapter_on_a_pty():
    """The adapter with a drive behind a real pty, in a thread of its own; yields the path."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    adapter = SlcanAdapter([Cia402Drive(FakeLoad())])
    stop = threading.Event()

    def serve() -> None:
        start_s = time.monotonic()
        while not stop.is_set():
            if select.select([master], [], [], 0.001)[0]:
                adapter.receive(os.read(master, 4096))
            adapter.advance_to(time.monotonic() - start_s)
            if data := adapter.transmit():
                os.write(master, data)

    thread = threading.Thread(target=serve)
    thread.start()
    yield os.ttyname(slave)
    stop.set()
    thread.join(5.0)
    os.close(master)
    os.close(slave)


def test_python_can_talks_to_the_adapter(adapter_on_a_pty):
    with can.Bus(interface="slcan", channel=adapter_on_a_pty, bitrate=1_000_000, sleep_after_open=0) as bus:
        assert bus.get_version(timeout=2.0) == (10, 13)
        assert bus.get_serial_number(timeout=2.0) == "ML01"
        bus.set_filters([{"can_id": 0x581, "can_mask": 0x7FF}])
        # The drive takes a moment to boot; a request before that is lost.
        reply = None
        for _ in range(50):
            bus.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("4000100000000000"), is_extended_id=False))
            reply = bus.recv(timeout=0.1)
            if reply is not None:
                break
        assert reply is not None
        assert reply.arbitration_id == 0x581
        assert reply.data.hex() == "4300100092010200"
