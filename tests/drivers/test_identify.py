"""Who is there, asked of the emulated firmware and of ports that say something else or nothing."""

import contextlib
import os
import pty
import termios
import threading
import tty
from collections.abc import Callable, Iterator

import can
import pytest
from grbl_wire import SETTINGS, Axes

from drivers.clock import SystemClock
from drivers.identify import identify_bus, identify_line, identify_port, identify_robot
from drivers.lock import owner_of, udp_device
from firmware_sim.bcap_controller import RcController
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.clock import SimClock
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.lines import InProcessLine
from firmware_sim.slcan_adapter import SlcanAdapter
from firmware_sim.tinyg_board import TinyGBoard
from firmware_sim.udp_port import UdpPort


class Shaft:
    def turn(self, time_s: float, speed_rpm: float) -> None:
        pass

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        return 0.0


class Heard:
    """A board, and every byte that reached it."""

    def __init__(self, board: GrblBoard | SlcanAdapter) -> None:
        self.board = board
        self.bytes = b""

    def receive(self, data: bytes) -> None:
        self.bytes += data
        self.board.receive(data)

    def transmit(self) -> bytes:
        return self.board.transmit()


class Answering:
    """Something on a serial port that answers each line by a function of it, after ``silent_s``."""

    def __init__(self, clock: SimClock, answer: Callable[[bytes], bytes], banner_at_s: float = 0.0) -> None:
        self._clock, self._answer, self._out, self._line = clock, answer, b"", b""
        self._banner_at_s = banner_at_s

    def receive(self, data: bytes) -> None:
        if self._clock.now_s() >= self._banner_at_s:
            self._line += data
            while (end := next((i for i, byte in enumerate(self._line) if byte in b"\r\n"), None)) is not None:
                line, self._line = self._line[:end], self._line[end + 1 :]
                self._out += self._answer(line)

    def transmit(self) -> bytes:
        if self._banner_at_s and self._clock.now_s() >= self._banner_at_s:
            self._banner_at_s = 0.0
            self._out += b"\r\nGrbl 1.1h ['$' for help]\r\n"
        out, self._out = self._out, b""
        return out


def board_for(clock: SimClock, dialect: str) -> GrblBoard:
    settings = {key: value for key, value in SETTINGS.items() if dialect == "gnea" or key != "$10"}
    board = GrblBoard(Axes(), dialect=dialect, settings=settings)  # type: ignore[arg-type]
    clock.attach(board.advance_to)
    return board


@pytest.mark.parametrize(
    ("verbosity", "words", "firmware"),
    [(5, "g2core 101.03", "101.03"), (1, "g2core or TinyG, set to tell its build only when it is opened", "")],
)
def test_a_g2core_board_is_known_as_it_is_set_and_nothing_is_written(verbosity: int, words: str, firmware: str) -> None:
    clock = SimClock()
    board = TinyGBoard(Axes())
    clock.attach(board.advance_to)
    line = InProcessLine(board, clock)
    clock.sleep_s(3.0)
    line.read(0.1)
    line.write(b'{"jv":%d}\n' % verbosity)
    clock.sleep_s(0.1)
    line.read(0.1)
    found = identify_line(line, clock)
    assert (found.role, found.make, found.words, found.firmware) == ("motion", "tinyg", words, firmware)
    line.write(b'{"jv":5}\n')
    clock.sleep_s(0.1)
    line.read(0.1)
    assert board.state in ("Ready", "Alarm"), board.state


def test_a_robot_is_asked_for_its_version_and_left_without_its_arm() -> None:
    board, port = RcController(Axes()), UdpPort()
    over = threading.Event()

    def serve() -> None:
        time_s = 0.0
        while not over.wait(0.0005):
            time_s += 0.001
            board.advance_to(time_s)
            while data := port.read():
                board.receive(data)
            while said := board.transmit():
                port.write(said)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        found = identify_robot(port.path, SystemClock())
    finally:
        over.set()
        thread.join(5.0)
        port.close()
    assert (found.role, found.make, found.words) == ("motion", "bcap", "DENSO b-CAP 2.12.0")
    assert not board.motor_on
    assert owner_of(udp_device(port.host, port.port)) is None


@pytest.mark.parametrize(
    ("dialect", "words", "firmware"), [("gnea", "Grbl 1.1h", "1.1h"), ("grblhal", "grblHAL 1.1f", "1.1f")]
)
def test_grbl_says_its_version_and_is_told_nothing_but_two_questions(dialect: str, words: str, firmware: str) -> None:
    clock = SimClock()
    heard = Heard(board_for(clock, dialect))
    clock.sleep_s(3.0)
    heard.board.transmit()
    found = identify_line(InProcessLine(heard, clock), clock)
    assert (found.role, found.firmware) == ("motion", firmware)
    assert found.words.startswith(words)
    assert heard.bytes == b"?$I\n"


def test_a_running_grbl_is_not_asked_more_than_its_state() -> None:
    clock = SimClock()
    heard = Heard(board_for(clock, "gnea"))
    clock.sleep_s(3.0)
    heard.board.receive(b"$X\nG91G1X-5F60\n")
    clock.sleep_s(0.5)
    heard.board.transmit()
    found = identify_line(InProcessLine(heard, clock), clock)
    assert (found.role, found.words) == ("motion", "GRBL, busy (Run)")
    assert heard.bytes == b"?"


def test_an_adapter_says_version_and_serial_number_whatever_was_left_half_said() -> None:
    clock = SimClock()
    heard = Heard(SlcanAdapter([Cia402Drive(Shaft())]))
    clock.attach(heard.board.advance_to)
    heard.board.receive(b"t1")
    found = identify_line(InProcessLine(heard, clock), clock)
    assert (found.role, found.words) == ("spindle", "SLCAN adapter V1013, serial number ML01")
    assert heard.bytes == b"?\rV\rN\r"


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda line: b"b158aa7 github.com/someone/canable-fw.git\r" if line == b"V" else b"", "canable-fw"),
        (lambda line: b"", "nobody answered at 115200 baud"),
        (lambda line: line + b"\r", "nobody answered at 115200 baud"),
        (lambda line: b"V2.30 SR830\r", "nobody answered at 115200 baud"),
    ],
)
def test_free_text_echoes_and_silence(answer: Callable[[bytes], bytes], words: str) -> None:
    clock = SimClock()
    found = identify_line(InProcessLine(Answering(clock, answer), clock), clock)
    assert words in found.words
    assert found.role == ("spindle" if "can" in words else None)


def test_a_board_that_starts_anew_when_its_port_is_opened_is_waited_for() -> None:
    clock = SimClock()
    info = b"[VER:1.1h.20190830:bench 2]\r\n[OPT:V,15,128]\r\nok\r\n"
    board = Answering(clock, lambda line: info if line == b"$I" else b"", banner_at_s=clock.now_s() + 1.9)
    found = identify_line(InProcessLine(board, clock), clock)
    assert (found.role, found.words) == ("motion", "Grbl 1.1h.20190830 bench 2")


def test_nodes_on_a_bus_are_known_by_their_heartbeats_and_nothing_is_sent() -> None:
    class Bus:
        sent = 0
        frames = ((0x701, b"\x05"), (0x181, b"\x00"), (0x705, b"\x7f"), (0x701, b"\x05"), (0x77F, b"\0\0"))

        def __init__(self, clock: SimClock) -> None:
            self._clock = clock
            self._left = [can.Message(arbitration_id=i, data=data, is_extended_id=False) for i, data in self.frames]

        def recv(self, timeout: float) -> can.Message | None:
            if self._left:
                return self._left.pop(0)
            self._clock.sleep_s(timeout)
            return None

    clock = SimClock()
    found = identify_bus(Bus(clock), clock, listen_s=1.0)  # type: ignore[arg-type]
    assert (found.role, found.node_ids, found.words) == ("spindle", (1, 5), "CANopen node 1, 5")
    Bus.frames = ()
    assert identify_bus(Bus(clock), clock, listen_s=1.0).words == "no heartbeat within 1 s"  # type: ignore[arg-type]


@contextlib.contextmanager
def answering_pty() -> Iterator[tuple[str, int]]:
    """A pty whose other end answers a status query and ``$I`` at once, and the slave's descriptor."""
    master, slave = pty.openpty()
    tty.setraw(master)

    def serve() -> None:
        with contextlib.suppress(OSError):
            while data := os.read(master, 100):
                os.write(
                    master, b"<Idle|MPos:0.000,0.000,0.000>\r\n" if data == b"?" else b"[VER:1.1h.2019:]\r\nok\r\n"
                )

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield os.ttyname(slave), slave
    os.close(slave)
    thread.join(5.0)
    os.close(master)


def test_a_port_is_given_back_as_it_was_found() -> None:
    with answering_pty() as (path, slave):
        settings = termios.tcgetattr(slave)
        settings[4] = settings[5] = termios.B9600
        termios.tcsetattr(slave, termios.TCSANOW, settings)
        before = termios.tcgetattr(slave)
        found = identify_port(path, SimClock())
        assert found.role == "motion"
        assert termios.tcgetattr(slave) == before


def test_an_absent_port_is_said_in_words() -> None:
    assert "run `mill devices`" in identify_port("/dev/ttyGONE", SimClock()).words
