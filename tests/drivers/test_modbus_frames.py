"""The inverter's driver against bytes written by hand from the manuals, and frames that lost a byte or a bit."""

from collections import deque
from collections.abc import Callable, Mapping

import pytest

from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.spindle.interface import SILENT_AFTER
from drivers.spindle.modbus import ModbusSpindle

STOP = bytes.fromhex("01 06 20 00 00 01 43 ca")
RUN = bytes.fromhex("01 06 20 00 00 12 02 07")
READ_REPORT = bytes.fromhex("01 03 21 00 00 05 8f f5")
STANDS = bytes.fromhex("01 03 0a 00 00 05 00 00 00 00 00 00 00 e4 89")
"""No fault; frequency and commands from the wire; 0 Hz, 0 A."""
TURNS = bytes.fromhex("01 03 0a 00 00 05 03 06 83 06 83 00 28 63 4f")
"""Running forward at 166.7 Hz with 0.40 A."""

DRIVE = {
    STOP: STOP,
    READ_REPORT: STANDS,
    bytes.fromhex("01 03 00 00 00 01 84 0a"): bytes.fromhex("01 03 02 04 d2 3a d9"),  # identity code 1234
    bytes.fromhex("01 03 00 06 00 01 64 0b"): bytes.fromhex("01 03 02 00 ce 39 d0"),  # firmware 2.06
    bytes.fromhex("01 03 00 16 00 01 65 ce"): bytes.fromhex("01 03 02 00 00 b8 44"),  # ramp to stop
    bytes.fromhex("01 03 01 00 00 01 85 f6"): bytes.fromhex("01 03 02 27 10 a2 78"),  # 1000.0 Hz
    bytes.fromhex("01 03 21 1f 00 01 bf f0"): bytes.fromhex("01 03 02 02 00 b9 24"),  # two decimals
    bytes.fromhex("01 03 09 02 00 01 26 56"): bytes.fromhex("01 03 02 00 01 79 84"),  # fault and ramp to stop
    bytes.fromhex("01 03 09 03 00 01 77 96"): bytes.fromhex("01 03 02 00 00 b8 44"),  # no time-out
}


class HandClock:
    """Time that only a test and its line let pass."""

    def __init__(self) -> None:
        self.time_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def sleep_s(self, duration_s: float) -> None:
        self.time_s += max(0.0, duration_s)


class ScriptedLine:
    """A wire that gives each question the answer of a table, after ``change``; what is not in the table is silence."""

    name = "/dev/mill-spindle"
    descriptor = None

    def __init__(self, clock: HandClock, answers: Mapping[bytes, bytes]) -> None:
        self.clock = clock
        self.answers = dict(answers)
        self.change: Callable[[bytes], bytes] = lambda answer: answer
        self.on_read: Callable[[], None] = lambda: None
        self.written: list[bytes] = []
        self.closed = 0
        self._arriving: deque[int] = deque()

    def write(self, data: bytes) -> None:
        self.written.append(data)
        self._arriving.extend(self.change(self.answers.get(data, b"")))

    def read(self, timeout_s: float) -> bytes:
        if timeout_s > 0:
            self.on_read()
            if not self._arriving:
                self.clock.sleep_s(timeout_s)
                return b""
        return bytes(self._arriving.popleft() for _ in range(min(4, len(self._arriving))))

    def close(self) -> None:
        self.closed += 1


def opened(answers: Mapping[bytes, bytes] = {}) -> tuple[ModbusSpindle, ScriptedLine]:
    clock = HandClock()
    line = ScriptedLine(clock, {**DRIVE, **answers})
    return on(line, clock), line


def on(line: ScriptedLine, clock: Clock) -> ModbusSpindle:
    return ModbusSpindle(
        line, clock, max_speed_rpm=60_000, rated_current_a=2.0, baud=115_200, frequency_unit_hz=0.1, heartbeat_s=0.3
    )


def started() -> tuple[ModbusSpindle, ScriptedLine]:
    spindle, line = opened()
    line.answers |= {
        bytes.fromhex("01 06 09 03 00 03 3a 57"): bytes.fromhex("01 06 09 03 00 03 3a 57"),
        bytes.fromhex("01 06 20 01 06 83 91 cb"): bytes.fromhex("01 06 20 01 06 83 91 cb"),
        RUN: RUN,
    }
    watches = bytes.fromhex("01 03 09 03 00 01 77 96")
    line.on_read = lambda: line.answers.update(
        {watches: bytes.fromhex("01 03 02 00 03 f8 45")} if line.written[-1][1:4] == b"\x06\x09\x03" else {}
    )
    spindle.start(10_000)
    line.answers[READ_REPORT] = TURNS
    return spindle, line


def test_opening_stops_the_drill_first_and_tells_who_it_is() -> None:
    spindle, line = opened()
    assert line.written[0] == STOP
    assert spindle.identity == "Delta VFD, identity code 1234, firmware 2.06, station 1"
    assert RUN not in line.written


def test_running_at_167_hz_is_10_002_rpm_at_a_fifth_of_the_rated_current() -> None:
    spindle, line = started()
    assert line.written.index(RUN) > line.written.index(bytes.fromhex("01 06 20 01 06 83 91 cb"))
    status = spindle.wait_until_at_speed(1.0)
    assert status.speed_rpm == pytest.approx(10_002.0)
    assert status.torque_fraction == pytest.approx(0.2)
    assert status.fault is None


def test_a_drive_without_211f_gives_current_with_one_decimal() -> None:
    spindle, line = opened({bytes.fromhex("01 03 21 1f 00 01 bf f0"): bytes.fromhex("01 83 02 c0 f1")})
    line.answers[READ_REPORT] = TURNS
    assert spindle.status().torque_fraction == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("question", "answer", "told"),
    [
        ("01 03 00 16 00 01 65 ce", "01 03 02 00 01 79 84", "00-22"),
        ("01 03 21 00 00 05 8f f5", "01 03 0a 00 00 04 00 00 00 00 00 00 00 25 45", "00-20"),
        ("01 03 21 00 00 05 8f f5", "01 03 0a 00 00 01 00 00 00 00 00 00 00 e5 7a", "00-21"),
    ],
)
def test_a_drive_that_is_set_wrongly_is_refused_naming_the_parameter(question: str, answer: str, told: str) -> None:
    clock = HandClock()
    line = ScriptedLine(clock, {**DRIVE, bytes.fromhex(question): bytes.fromhex(answer)})
    with pytest.raises(ConfigError, match=told):
        on(line, clock)
    assert line.closed == 1


@pytest.mark.parametrize(("code", "words"), [(21, "drive overloaded"), (58, "heartbeat"), (99, "manual")])
def test_a_fault_code_is_told_in_words_and_keeps_the_drill_off(code: int, words: str) -> None:
    spindle, line = opened()
    faulty = bytearray(STANDS[:-2])
    faulty[4] = code
    line.answers[READ_REPORT] = bytes(faulty) + crc(faulty)
    assert words in (spindle.status().fault or "")
    with pytest.raises(DeviceFaultError, match=f"drive fault {code}"):
        spindle.start(10_000)
    assert RUN not in line.written


def test_an_exception_is_told_in_words() -> None:
    spindle, line = started()
    line.answers[bytes.fromhex("01 06 20 01 09 c4 d4 09")] = bytes.fromhex("01 86 02 c3 a1")  # the manual's own
    with pytest.raises(DeviceFaultError, match=r"exception 2 \(no such register\)"):
        spindle.start(15_000)


def test_three_missing_answers_are_silence_and_latch_until_reset() -> None:
    spindle, line = started()
    del line.answers[READ_REPORT]
    before_s, asked = line.clock.time_s, len(line.written)
    with pytest.raises(DeviceTimeoutError, match="silent"):
        spindle.status()
    assert line.clock.time_s - before_s <= SILENT_AFTER * spindle.heartbeat_s + 0.005
    assert line.written[asked:] == [READ_REPORT] * 3
    line.answers[READ_REPORT] = STANDS
    with pytest.raises(DeviceFaultError, match="silent"):
        spindle.start(10_000)


def test_a_wrong_crc_three_times_is_told_as_such() -> None:
    spindle, line = started()
    line.change = lambda answer: answer[:-1] + bytes((answer[-1] ^ 0x10,)) if answer else b""
    with pytest.raises(ProtocolError, match="wrong CRC"):
        spindle.status()


def test_one_broken_answer_is_asked_for_again() -> None:
    spindle, line = started()
    once = [b"\x01\x03\x0a\x00"]
    line.change = lambda answer: once.pop() if once else answer
    assert spindle.status().speed_rpm == pytest.approx(10_002.0)


def test_a_late_answer_to_another_question_is_no_answer_to_this_one() -> None:
    spindle, line = started()
    line.change = lambda answer: RUN + answer if line.written[-1] == READ_REPORT and len(line.written) % 2 else answer
    assert spindle.status().speed_rpm == pytest.approx(10_002.0)


def test_a_stop_during_an_answer_is_repeated_until_it_is_confirmed() -> None:
    spindle, line = started()
    stops: list[float] = []

    def interrupt() -> None:
        if not stops:
            stops.append(line.clock.time_s)
            line.answers[STOP] = b""  # lost on the shared pair of wires
            spindle.stop()
            line.answers[STOP] = STOP

    line.on_read = interrupt
    asked = len(line.written)
    spindle.status()
    assert line.written[asked:] == [READ_REPORT, STOP, STOP, READ_REPORT, STOP]  # it still ran: told once more


@pytest.mark.parametrize("place", range(len(TURNS)))
def test_an_answer_that_lost_one_byte_is_an_error_or_asked_for_again(place: int) -> None:
    for always in (False, True):
        spindle, line = started()
        times = [0]

        def lose(answer: bytes, times: list[int] = times, always: bool = always) -> bytes:
            times[0] += 1
            return answer[:place] + answer[place + 1 :] if always or times[0] == 1 else answer

        line.change = lose
        expect(spindle)


@pytest.mark.parametrize("bit", range(8 * len(TURNS)))
def test_an_answer_with_a_flipped_bit_is_an_error_or_asked_for_again(bit: int) -> None:
    spindle, line = started()
    line.change = lambda answer: flipped(answer, bit)
    with pytest.raises(DeviceError):
        spindle.status()


def expect(spindle: ModbusSpindle) -> None:
    try:
        status = spindle.status()
    except DeviceError:
        return
    assert status.speed_rpm == pytest.approx(10_002.0)
    assert status.torque_fraction == pytest.approx(0.2)


def flipped(answer: bytes, bit: int) -> bytes:
    data = bytearray(answer)
    if bit // 8 < len(data):
        data[bit // 8] ^= 1 << bit % 8
    return bytes(data)


def crc(data: bytes | bytearray) -> bytes:
    """CRC-16/MODBUS, from the serial line specification."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "little")
