"""Every single-byte deletion and bit flip of recorded sessions, and spoilt inputs at random (``fuzz.py``)."""

import random
from typing import Any

import can
import pytest
from fuzz import TARGETS, Target, check, spoil
from grbl_wire import Wired
from sessions import ORIGIN_MM, TARGETS_MM, HandClock, PlayedLine, changed, drive_grbl, load, single_changes

from drivers.errors import ConfigError, DeviceError
from drivers.motion.grbl.driver import GrblController
from drivers.spindle.canbus import SlcanBus

SAME_PLACE_MM = 0.003
"""What the report's last digit and half a motor step leave open."""
GRBL, SLCAN = load("grbl.txt"), load("slcan.txt")
SAID = sum(len(exchange.said) for exchange in GRBL)


def grbl_session(exchanges: list[Any]) -> dict[str, Any]:
    clock = HandClock()
    line = PlayedLine(exchanges, clock, GRBL)
    controller = GrblController(line, clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0)
    return {**drive_grbl(controller), "written": line.written}


def same(found: dict[str, Any], due: dict[str, Any]) -> bool:
    ends = zip(sum(found.pop("ends_mm"), ()), sum(TARGETS_MM, ()), strict=True)
    return found == due and all(abs(end - target) <= SAME_PLACE_MM for end, target in ends)


@pytest.mark.parametrize("part", range(8))
def test_a_grbl_session_with_one_byte_changed_is_right_or_refused(part: int) -> None:
    due = grbl_session(GRBL)
    assert due.pop("ends_mm") == list(TARGETS_MM)
    right = 0
    for place in range(part, SAID, 8):
        for name, change in single_changes():
            try:
                found = grbl_session(changed(GRBL, place, change))
            except (DeviceError, ConfigError):
                continue
            assert same(found, due), f"byte {place} {name}: {found}"
            right += 1
    assert right > SAID / 8  # most of what is said decides nothing


@pytest.mark.parametrize("place", range(len(b"G53G1X-3.000Y-2.000Z-2.000F900.00\n")))
def test_a_move_that_is_changed_on_its_way_to_the_board_is_never_called_right(on_wire: Wired, place: int) -> None:
    controller, line, bench = on_wire
    target_mm = TARGETS_MM[0]
    write = line.write
    for _, change in single_changes():
        controller.home()
        home_mm, home_axes_mm = controller.status().position_mm, bench.axes.axes_mm
        spoilt = [True]

        def spoil_move(data: bytes, change: Any = change, spoilt: list[bool] = spoilt) -> None:
            if data.startswith(b"G53G1") and spoilt:
                spoilt.clear()
                data = data[:place] + change(data[place : place + 1]) + data[place + 1 :]
            write(data)

        line.write = spoil_move  # type: ignore[method-assign]
        try:
            controller.start_move(target_mm, feed_mm_per_s=15.0)
            end_mm = controller.wait_until_idle(60.0).position_mm
        except DeviceError:
            continue
        finally:
            line.write = write  # type: ignore[method-assign]
        for axis in range(3):
            went_mm = bench.axes.axes_mm[axis] - home_axes_mm[axis]
            assert abs(end_mm[axis] - target_mm[axis]) <= SAME_PLACE_MM
            assert abs(went_mm - (target_mm[axis] - home_mm[axis])) <= SAME_PLACE_MM


class Said:
    """A serial line on which everything has been said already."""

    name, descriptor = "played:slcan", None

    def __init__(self) -> None:
        self.due = b""

    def write(self, data: bytes) -> None:
        pass

    def read(self, timeout_s: float) -> bytes:
        data, self.due = self.due, b""
        return data

    def close(self) -> None:
        pass


def received(said: bytes) -> list[tuple[int, bytes] | str]:
    line = Said()
    bus = SlcanBus(line, 1_000_000)
    line.due = said
    found: list[tuple[int, bytes] | str] = []
    while line.due or bus._lines:
        try:
            message = bus.recv(0.0)
        except can.CanOperationError as error:
            found.append(str(error))
            continue
        if message is not None:
            found.append((message.arbitration_id, bytes(message.data)))
    bus.shutdown()
    return found


def test_an_slcan_packet_with_one_byte_changed_is_told_or_is_another_packet_of_its_own_form() -> None:
    """LAWICEL's lines have no checksum: a digit that became another is found by nobody here; all else is."""
    before, behind = (0x7FF, b"\x01"), (0x7FE, b"\x02")
    packets = sorted({body for exchange in SLCAN for body in exchange.said.split(b"\r") if body[:1] == b"t"})
    assert len(packets) > 20
    for packet in packets:
        for place in range(len(packet) + 1):
            for name, change in single_changes():
                line = packet + b"\r"
                spoilt = line[:place] + change(line[place : place + 1]) + line[place + 1 :]
                found = received(b"t7FF101\r" + spoilt + b"t7FE102\r")
                where = f"{packet!r} byte {place} {name}: {found}"
                assert found[0] == before, where
                ends = place == len(packet)  # without its end, a packet takes the next one with it
                assert ends or found[-1] == behind, where
                frames = [frame for frame in found[1:] if isinstance(frame, tuple) and frame != behind]
                told = [words for words in found if isinstance(words, str)]
                digit = spoilt[place : place + 1] in b"0123456789abcdefABCDEF" and name != "deleted"
                assert told or digit or frames == received(line) or not frames, where


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_spoilt_inputs_end_in_a_result_or_in_a_promised_error(target: Target) -> None:
    check(target, 20_000)


@pytest.mark.long
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_a_million_spoilt_inputs(target: Target) -> None:
    check(target, 1_000_000, seed=1)


def test_one_seed_gives_the_same_inputs_twice() -> None:
    corpus = TARGETS[0].recorded()

    def first() -> list[bytes]:
        rng = random.Random(3)
        return [spoil(rng.choice(corpus), corpus, rng) for _ in range(50)]

    assert first() == first()


def leaky(_place: Any) -> Any:
    kept: list[bytes] = []
    return lambda data: kept.append(data + b".")


def endless(_place: Any) -> Any:
    return lambda data: [len(data) for _ in range(100_000)]


@pytest.mark.parametrize(
    ("make", "complaint"),
    [(leaky, "bytes more after"), (endless, "calls for"), (lambda _: lambda data: data[99_999], "IndexError")],
)
def test_the_fuzzer_sees_what_it_is_to_see(make: Any, complaint: str) -> None:
    with pytest.raises(AssertionError, match=complaint):
        check(Target("wrong", TARGETS[0].recorded, make), 20_000)
