"""The LAWICEL side of the bus: bytes typed from the CANUSB and CAN232 manuals, both ways."""

import os
import re
from collections import deque
from pathlib import Path

import can
import pytest

from drivers.clock import SystemClock
from drivers.errors import ConfigError, ConnectionLostError, DeviceBusyError
from drivers.lock import DeviceLock
from drivers.spindle.canbus import SlcanBus, open_bus
from drivers.trace import TracedBus
from drivers.trace_file import Trace
from milling.supervisor import LONGEST_ALARM

CR, BEL = b"\r", b"\a"


class ScriptedLine:
    """A serial line that answers each command by a table, and hands out at most ``piece`` bytes at a time."""

    name = "/dev/mill-spindle"
    descriptor: int | None = None

    def __init__(self, answers: dict[bytes, bytes] | None = None, piece: int = 1000) -> None:
        self.answers = {b"\r\r\rC\r": b"\r\r\r\r", b"S8\r": CR, b"O\r": CR, **(answers or {})}
        self.piece = piece
        self.written: list[bytes] = []
        self.incoming = deque[int]()
        self.closed = 0

    def write(self, data: bytes) -> None:
        self.written.append(data)
        self.incoming.extend(self.answers.get(data, b""))

    def read(self, timeout_s: float) -> bytes:
        return bytes(self.incoming.popleft() for _ in range(min(self.piece, len(self.incoming))))

    def close(self) -> None:
        self.closed += 1


def message(can_id: int, data: bytes, *, extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=extended)


def received(line: ScriptedLine, bus: SlcanBus, data: bytes) -> list[tuple[int, bytes] | str]:
    line.incoming.extend(data)
    result: list[tuple[int, bytes] | str] = []
    while True:
        try:
            got = bus.recv(0.0)
        except can.CanOperationError as error:
            result.append(str(error))
            continue
        if got is not None:
            result.append((got.arbitration_id, bytes(got.data)))
        elif not line.incoming:
            return result


@pytest.mark.parametrize(
    ("bitrate", "command"),
    [(10_000, b"S0\r"), (125_000, b"S4\r"), (500_000, b"S6\r"), (800_000, b"S7\r"), (1_000_000, b"S8\r")],
)
@pytest.mark.parametrize("before", [b"\r\r\r\r", b"\a\a\a\a", b"t1", b"t18100\r\rt1810\r\a", b""])
def test_opening_ends_what_an_earlier_host_left(bitrate: int, command: bytes, before: bytes) -> None:
    line = ScriptedLine({b"\r\r\rC\r": before, command: CR})
    bus = SlcanBus(line, bitrate)
    assert line.written == [b"\r\r\rC\r", command, b"O\r"]
    bus.shutdown()
    bus.shutdown()
    assert line.written[-1] == b"C\r"
    assert line.closed == 1


@pytest.mark.parametrize("refused", [b"S8\r", b"O\r"])
def test_a_refusal_at_opening_is_not_taken_for_silence(refused: bytes) -> None:
    line = ScriptedLine({refused: BEL})
    with pytest.raises(ConnectionLostError, match=f"refuses {refused.decode().strip()} .*check .spindle. bitrate"):
        SlcanBus(line, 1_000_000)


def test_firmware_that_acknowledges_nothing_is_taken() -> None:
    line = ScriptedLine({b"\r\r\rC\r": b"", b"S8\r": b"", b"O\r": b""})
    SlcanBus(line, 1_000_000).shutdown()


@pytest.mark.parametrize(
    ("frame", "line"),
    [
        (message(0x100, bytes.fromhex("1133")), b"t10021133\r"),
        (message(0x7FF, b""), b"t7FF0\r"),
        (message(0x080, b""), b"t0800\r"),
        (message(0x201, bytes.fromhex("0F0030750000")), b"t20160F0030750000\r"),
        (message(0x100, bytes.fromhex("1133"), extended=True), b"T0000010021133\r"),
    ],
)
def test_frames_out(frame: can.Message, line: bytes) -> None:
    wire = ScriptedLine()
    bus = SlcanBus(wire, 1_000_000)
    bus.send(frame)
    assert wire.written[-1] == line
    bus.shutdown()


@pytest.mark.parametrize("piece", [1, 7, 1000])
@pytest.mark.parametrize(
    ("line", "frame"),
    [
        (b"t10021133\r", (0x100, bytes.fromhex("1133"))),
        (b"t1000\r", (0x100, b"")),
        (b"t100211334D67\r", (0x100, bytes.fromhex("1133"))),  # with a time stamp
        (b"t10004D67\r", (0x100, b"")),
        (b"t1818270630750000640a\r", (0x181, bytes.fromhex("270630750000640A"))),
        (b"T0000010021133\r", (0x100, bytes.fromhex("1133"))),
    ],
)
def test_frames_in(line: bytes, frame: tuple[int, bytes], piece: int) -> None:
    wire = ScriptedLine(piece=piece)
    bus = SlcanBus(wire, 1_000_000)
    # acknowledgements of frames sent (with auto poll and without), and remote frames, are passed over
    assert received(wire, bus, b"z\r" + line + b"\rZ\r" + b"r1000\r" + line) == [frame, frame]
    bus.shutdown()


@pytest.mark.parametrize(
    "line",
    [
        b"t1002113\r",
        b"t10091133\r",
        b"t100211334\r",
        b"t8000\r",
        b"tXYZ0\r",
        b"hello\r",
        b"\xff\xfe\r",
        b"t10021133" * 9,
    ],
)
def test_a_line_that_no_manual_allows_is_told_and_the_next_one_read(line: bytes) -> None:
    wire = ScriptedLine()
    bus = SlcanBus(wire, 1_000_000)
    error, frame = received(wire, bus, line + b"\rt1811AA\r")
    assert isinstance(error, str)
    assert "is no CAN frame" in error
    assert frame == (0x181, b"\xaa")
    bus.shutdown()


def test_a_refused_frame_is_told_with_the_adapters_reasons() -> None:
    wire = ScriptedLine({b"t2010\r": BEL, b"F\r": b"FA2\r"})
    bus = SlcanBus(wire, 1_000_000)
    bus.send(message(0x201, b""))
    assert received(wire, bus, b"t1811AA\r") == [
        "slcan on /dev/mill-spindle: the adapter refused a frame (BEL)",
        (0x181, b"\xaa"),
        "slcan on /dev/mill-spindle: transmit queue full, error passive, bus error",
    ]
    assert wire.written[-1] == b"F\r"
    assert received(wire, bus, b"F00\rF40\r") == []  # nothing wrong, and a lost arbitration
    bus.shutdown()


def test_only_what_canopen_needs_is_sent() -> None:
    bus = SlcanBus(ScriptedLine(), 1_000_000)
    with pytest.raises(can.CanOperationError, match="only classic data frames"):
        bus.send(can.Message(arbitration_id=0x701, is_remote_frame=True, is_extended_id=False))
    bus.shutdown()


def test_an_absent_adapter_names_path_reason_and_next_step(tmp_path: Path) -> None:
    path = str(tmp_path / "mill-spindle")
    with pytest.raises(ConnectionLostError, match=f"{path}: .*No such file or directory.*;"):
        open_bus("slcan", path, 1_000_000)


def test_an_absent_network_interface_names_itself_reason_and_next_step() -> None:
    with pytest.raises(
        ConnectionLostError, match=r"millcan9: cannot be opened \(.+\); .*`ip link set millcan9 up type can"
    ):
        open_bus("socketcan", "millcan9", 1_000_000)
    DeviceLock("/sys/class/net/millcan9").release()  # nothing was left locked


def test_a_network_interface_has_one_owner() -> None:
    owner = DeviceLock("/sys/class/net/millcan9")
    with pytest.raises(DeviceBusyError, match=f"pid {os.getpid()}"):
        open_bus("socketcan", "millcan9", 1_000_000)
    owner.release()


def test_unknown_interfaces_and_bit_rates_are_refused() -> None:
    with pytest.raises(ConfigError, match="'pcan' is unknown; allowed: slcan, socketcan"):
        open_bus("pcan", "x", 1_000_000)
    with pytest.raises(ConfigError, match="750000 is not one of 10000, 20000"):
        open_bus("slcan", "/dev/null", 750_000)


# --- what a supervisor listens for


class ReachableLine(ScriptedLine):
    """A line that another process may read along."""

    descriptor = 7

    def read_through(self, file: int) -> None:
        self.through = file


@pytest.mark.parametrize(
    ("said", "alarm"),
    [
        # EMCY: identifier 080h + node, code with its low byte first, error register, maker's field (CiA 301).
        (b"t08381023010000000000\r", "0x2310 continuous over-current at the output"),
        (b"z\rt083830810100000000001234\r", "0x8130 the host's heartbeat stayed away"),
        (b"\at083844ff010000000000\r", "0xFF44 additional function or maker's own error"),
        (b"t08380000000000000000\r", None),
        (b"t08380100000000000000\r", None),
        (b"t08481023010000000000\r", None),
        (b"t08371023010000000000\r", None),
        (b"T0000008381023010000000000\r", None),
        (b"t18381023010000000000\r", None),
        (b"t08381023010000000000", None),
    ],
)
def test_an_emergency_of_the_node_is_an_alarm(said: bytes, alarm: str | None) -> None:
    path = SlcanBus(ReachableLine(), 1_000_000).alarm_path(3)
    assert path is not None
    found = re.search(path.pattern, said)
    assert (None if found is None else path.words(found[0])) == (
        alarm and f"slcan on /dev/mill-spindle: the drive's emergency, {alarm}"
    )


def test_a_longest_alarm_fits_what_the_supervisor_remembers() -> None:
    assert len(b"\rt08381023010000000000FFFF\r") < LONGEST_ALARM


def test_the_bus_is_read_through_its_line_also_when_it_is_traced(tmp_path: Path) -> None:
    line = ReachableLine()
    with Trace(tmp_path / "trace.jsonl", SystemClock(), {}) as trace:
        path = TracedBus(SlcanBus(line, 1_000_000), trace, "spindle").alarm_path(3)
        assert path is not None
        path.read_through(5)
        assert (path.fd, line.through) == (7, 5)


def test_a_line_that_nobody_else_can_read_has_no_alarm_path() -> None:
    assert SlcanBus(ScriptedLine(), 1_000_000).alarm_path(3) is None
