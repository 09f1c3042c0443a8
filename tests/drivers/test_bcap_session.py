"""Requests and replies over datagrams that get lost, doubled, late and torn."""

import struct
from collections.abc import Callable

import pytest

from drivers.errors import ConnectionLostError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.motion.bcap.results import result_words
from drivers.motion.bcap.session import BcapSession
from firmware_sim.clock import SimClock


def reply(serial: int, result: int = 0, number: int | None = None) -> bytes:
    body = b"" if number is None else struct.pack("<IHIi", 10, 3, 1, number)
    return struct.pack("<BIHHIH", 1, 16 + len(body), serial, 0, result, int(number is not None)) + body + b"\x04"


class Scripted:
    """A line whose other end answers each datagram by a script."""

    name = "script"

    def __init__(self, clock: SimClock, *answers: Callable[[int], list[bytes]]) -> None:
        self._clock = clock
        self._answers = list(answers)
        self._arrived: list[bytes] = []
        self.sent: list[tuple[int, int, int]] = []
        """Serial, reserve, function."""

    def write(self, data: bytes) -> None:
        serial, reserve, function = struct.unpack_from("<HHI", data, 5)
        self.sent.append((serial, reserve, function))
        if self._answers:
            self._arrived += self._answers.pop(0)(serial)

    def read(self, timeout_s: float) -> bytes:
        if not self._arrived:
            self._clock.sleep_s(timeout_s)
            return b""
        return self._arrived.pop(0)

    def close(self) -> None:
        pass


def session(*answers: Callable[[int], list[bytes]]) -> tuple[BcapSession, Scripted, SimClock]:
    clock = SimClock()
    line = Scripted(clock, *answers)
    return BcapSession(line, clock, reply_s=0.1), line, clock


def nothing(_serial: int) -> list[bytes]:
    return []


def test_a_reply_brings_its_value() -> None:
    talk, line, _ = session(lambda serial: [reply(serial, number=7)])
    assert talk.request(101, 3) == 7
    assert line.sent == [(1, 0, 101)]


def test_a_lost_request_is_sent_again_with_a_new_serial_and_the_first_one_in_reserve() -> None:
    talk, line, clock = session(nothing, nothing, lambda serial: [reply(serial, number=7)])
    assert talk.request(101, 3) == 7
    assert line.sent == [(1, 0, 101), (2, 1, 101), (3, 1, 101)]
    assert 0.2 <= clock.now_s() < 0.25


def test_a_late_reply_to_the_first_try_counts_and_the_second_one_is_nobodys() -> None:
    talk, line, _ = session(
        nothing, lambda serial: [reply(serial - 1, number=7), reply(serial, number=7)], lambda serial: [reply(serial)]
    )
    assert talk.request(101, 3) == 7
    assert talk.request(2) is None
    assert line.sent == [(1, 0, 101), (2, 1, 101), (3, 0, 2)]


def test_a_doubled_reply_is_no_reply_to_the_next_request() -> None:
    talk, _, _ = session(lambda serial: [reply(serial, number=7)] * 3, lambda serial: [reply(serial, number=8)])
    assert talk.request(101, 3) == 7
    assert talk.request(101, 3) == 8


def test_still_executing_is_waited_for() -> None:
    talk, line, clock = session(
        lambda serial: [reply(serial, 0x900)], lambda serial: [reply(serial, 0x900)], lambda serial: [reply(serial)]
    )
    assert talk.request(64, 1, "Motor", (1, 0)) is None
    assert [reserve for _, reserve, _ in line.sent] == [0, 1, 1]
    assert clock.now_s() >= 0.2


def test_what_executes_for_ever_ends_at_its_limit() -> None:
    talk, _, clock = session(*[lambda serial: [reply(serial, 0x900)]] * 100)
    talk_limit_s = 0.5
    with pytest.raises(DeviceTimeoutError, match=r"'Motor' not done within 0\.5 s"):
        talk.request(64, 1, "Motor", (1, 0), limit_s=talk_limit_s)
    assert clock.now_s() < talk_limit_s + 0.1


def test_silence_ends_after_three_tries() -> None:
    talk, line, _ = session()
    with pytest.raises(DeviceTimeoutError, match="no reply to 3 tries"):
        talk.request(1, "")
    assert len(line.sent) == 3


def test_somebody_who_speaks_no_bcap_is_named() -> None:
    talk, _, _ = session(*[lambda _: [b"HTTP/1.1 400 Bad Request\r\n\r\n"]] * 3)
    with pytest.raises(ProtocolError, match="not a b-CAP packet"):
        talk.request(1, "")


@pytest.mark.parametrize(
    "spoil", [lambda data: data[:-1], lambda data: data[3:], lambda data: data * 2, lambda _: b"?"]
)
def test_one_broken_reply_is_as_good_as_lost(spoil: Callable[[bytes], bytes]) -> None:
    talk, line, _ = session(lambda serial: [spoil(reply(serial, number=7))], lambda serial: [reply(serial, number=7)])
    assert talk.request(101, 3) == 7
    assert len(line.sent) == 2


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (0x80004005, "failed"),
        (0x80004001, "not implemented"),
        (0x80070057, "argument"),
        (0x80070005, "access denied"),
        (0x80000900, "timed out"),
        (0x81501003, "motor off"),
        (0x83500121, "not in slave mode"),
        (0x84204043, "acceleration of a set-point too high, axis 3"),
        (0x84204056, "speed of a set-point too high, axis 6"),
        (0x89ABCDEF, "see the error code list"),
    ],
)
def test_a_refusal_is_told_in_words(result: int, words: str) -> None:
    talk, _, _ = session(lambda serial: [reply(serial, result)])
    with pytest.raises(DeviceFaultError, match=words) as raised:
        talk.request(64, 1, "slvMove", None)
    assert f"{result:#010x}" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert result_words(result) in str(raised.value)


def test_serial_numbers_go_round_without_zero() -> None:
    talk, line, _ = session(*[lambda serial: [reply(serial)]] * 0x10001)
    for _ in range(0x10001):
        talk.request(2)
    serials = [serial for serial, _, _ in line.sent]
    assert (serials[0], serials[0xFFFE], serials[0xFFFF]) == (1, 0xFFFF, 1)
    assert 0 not in serials


def test_a_halt_is_sent_three_times_and_waits_for_nothing() -> None:
    talk, line, clock = session()
    talk.halt(0x201)
    assert line.sent == [(1, 0, 70), (2, 1, 70), (3, 1, 70)]
    assert clock.now_s() == 0.0
    with pytest.raises(DeviceFaultError, match="halted"):
        talk.check()
    talk.release(talk.halts)
    talk.check()


@pytest.mark.parametrize("failing", [1, 2])
def test_a_copy_of_a_halt_that_cannot_be_sent_keeps_no_other_back(failing: int) -> None:
    talk, line = without(failing)
    talk.halt(0x201)
    assert [function for _, _, function in line.sent] == [70] * (3 - failing)
    with pytest.raises(DeviceFaultError, match="halted"):
        talk.check()


def test_a_halt_of_which_no_copy_can_be_sent_says_so_and_latches() -> None:
    talk, _ = without(3)
    with pytest.raises(ConnectionLostError, match="nobody is there"):
        talk.halt(0x201)
    with pytest.raises(DeviceFaultError, match="halted"):
        talk.check()


def without(datagrams: int) -> tuple[BcapSession, Scripted]:
    """The first so many find nobody."""
    talk, line, _ = session()
    write, left = line.write, iter(range(datagrams))

    def failing(data: bytes) -> None:
        if next(left, None) is not None:
            raise ConnectionLostError("script: nobody is there")
        write(data)

    line.write = failing  # type: ignore[method-assign]
    return talk, line


def test_a_closed_session_stays_closed() -> None:
    talk, _, _ = session()
    talk.close()
    with pytest.raises(ConnectionLostError, match="closed"):
        talk.request(1, "")
