"""The g2core driver on a wire that spoils bytes, and on boards that are set wrongly."""

import contextlib
from collections.abc import Callable
from functools import partial

import pytest
from tinyg_wire import Bench

from drivers.errors import ConfigError, DeviceError, DeviceFaultError, DeviceTimeoutError, OutOfTravelError
from drivers.motion.interface import MotionState, Vector
from drivers.motion.tinyg.driver import STOP_SCRIPT

START_MM: Vector = (20.0, 0.0, 15.0)
TARGET_MM: Vector = (19.0, -0.5, 14.5)
END_MM: Vector = (19.0, -0.5, 14.75)


def dialogue(bench: Bench, spoil: Callable[[], None]) -> Vector:
    """Home, go to the start, and make two moves with the wire spoilt; where the tip really is, in {R}."""
    controller = bench.homed()
    controller.start_move(START_MM, feed_mm_per_s=20.0)
    controller.wait_until_idle(5.0)
    start_mm = bench.axes.axes_mm
    spoil()
    controller.start_move(TARGET_MM, feed_mm_per_s=10.0)
    controller.start_move(END_MM, feed_mm_per_s=10.0)
    controller.wait_until_idle(3.0)
    bench.line.to_board = bench.line.to_host = lambda data: data
    bench.clock.sleep_s(0.5)
    x, y, z = (told + now - then for told, now, then in zip(START_MM, bench.axes.axes_mm, start_mm, strict=True))
    return (x, y, z)


def recorded(side: str) -> bytes:
    bench, heard = Bench(), bytearray()

    def listen(data: bytes) -> bytes:
        heard.extend(data)
        return data

    assert dialogue(bench, lambda: setattr(bench.line, side, listen)) == pytest.approx(END_MM, abs=0.0015)
    return bytes(heard)


def one_byte(index: int, change: Callable[[int], bytes]) -> Callable[[bytes], bytes]:
    """Change the byte of this index in a stream of pieces."""
    passed = [0]

    def spoil(data: bytes) -> bytes:
        at = index - passed[0]
        passed[0] += len(data)
        return data[:at] + change(data[at]) + data[at + 1 :] if 0 <= at < len(data) else data

    return spoil


def errors_of(side: str, changes: list[Callable[[int], bytes]], *, every: int) -> None:
    for index in range(0, len(recorded(side)), every):
        for change in changes:
            bench = Bench()
            # Either a typed error, and nothing else, or the right place.
            with contextlib.suppress(DeviceError):
                ended_mm = dialogue(bench, partial(setattr, bench.line, side, one_byte(index, change)))
                assert ended_mm == pytest.approx(END_MM, abs=0.0015), index
            assert bench.axes.lowest_mm > -4.6, "never lower than the lowest target, 5.5 mm below the switch"


def flipped(bit: int) -> Callable[[int], bytes]:
    return lambda byte: bytes([byte ^ 1 << bit])


def gone(_byte: int) -> bytes:
    return b""


def test_no_byte_that_is_lost_on_the_way_to_the_board_moves_the_tip_wrongly() -> None:
    errors_of("to_board", [gone], every=1)


def test_no_byte_that_is_lost_on_the_way_to_the_host_is_taken_for_right() -> None:
    errors_of("to_host", [gone], every=3)


def test_no_bit_that_is_flipped_on_the_way_to_the_board_moves_the_tip_wrongly() -> None:
    errors_of("to_board", [flipped(1), flipped(4)], every=2)


@pytest.mark.long
@pytest.mark.parametrize("side", ["to_board", "to_host"])
def test_every_byte_and_every_bit(side: str) -> None:
    errors_of(side, [gone, *(flipped(bit) for bit in range(8))], every=1)


def test_a_line_that_arrives_as_another_kills_the_motion() -> None:
    bench = Bench()
    controller = bench.homed()
    bench.line.to_host = lambda data: data.replace(b"Z14", b"Z13").replace(b"Z-5", b"Z-6")
    with pytest.raises(DeviceFaultError, match=r"was received as .*home\(\) releases"):
        controller.start_move((20.0, 0.0, 15.0), feed_mm_per_s=5.0)
    bench.line.to_host = lambda data: data
    bench.clock.sleep_s(0.5)
    assert controller.status().state is MotionState.ALARM
    assert bench.board.state == "End"


def test_a_hold_in_the_moment_before_the_axes_move_is_not_lost() -> None:
    bench = Bench()
    controller = bench.homed()
    controller.start_move((10.0, 0.0, 15.0), feed_mm_per_s=10.0)
    controller.hold()
    with pytest.raises(DeviceTimeoutError, match="still held"):
        controller.wait_until_idle(1.0)
    controller.resume()
    assert controller.wait_until_idle(5.0).position_mm == pytest.approx((10.0, 0.0, 15.0), abs=0.0015)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"sl": 0}, "sl .soft limits. is 0"),
        ({"fhz": 2}, "fhz .* is 2"),
        ({"xam": 0}, "xam .* is 0"),
        ({"zhi": 0}, "zhi .* is 0"),
        ({"ytn": -0.5}, "ytm .* is -0.5"),
        ({"ztn": -2e6}, "ztn .* is -2e"),
    ],
)
def test_a_board_that_is_set_wrongly_is_refused_by_name(settings: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Bench(**settings).open()


def test_another_board_or_build_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"xtn .* is -35, the rig file expects -30"):
        Bench().open(expected_settings={"xtn": -30})
    with pytest.raises(ConfigError, match="no setting nonsense"):
        Bench().open(expected_settings={"nonsense": 1})
    with pytest.raises(ConfigError, match=r"build 101.03 found, the rig file expects 100\."):
        Bench().open(expected_firmware="100.")


def test_a_board_that_checks_no_checksum_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_sim.tinyg_board.verified", lambda text: text.partition("*")[0])
    with pytest.raises(ConfigError, match="wrong checksum"):
        Bench().open()


def test_the_floor_of_a_host_that_was_killed_is_removed() -> None:
    bench = Bench(ztn=-5)
    controller = bench.open(expected_settings={"ztn": -28})
    assert controller.travel.low_mm[2] == -8.0
    assert controller.settings["ztn"] == -28


def test_a_floor_outlives_a_reset_of_the_board() -> None:
    bench = Bench()
    controller = bench.homed()
    controller.set_floor(10.0)
    bench.board.restart()
    with pytest.raises(DeviceFaultError, match="reset by somebody else"):
        controller.wait_until_idle(2.0)
    controller.home()
    assert controller.travel.low_mm[2] == 10.0
    with pytest.raises(OutOfTravelError):
        controller.start_move((20.0, 0.0, 9.99), feed_mm_per_s=5.0)


def test_nobody_on_the_wire_is_told_in_time() -> None:
    bench = Bench()
    bench.line.to_board = lambda _: b""
    with pytest.raises(DeviceTimeoutError, match="g2core"):
        bench.open()
    assert bench.clock.now_s() < 3.0


def test_three_missed_replies_end_the_wait() -> None:
    bench = Bench()
    controller = bench.homed()
    bench.line.to_host = lambda _: b""
    asked_s = bench.clock.now_s()
    with pytest.raises(DeviceTimeoutError, match="no reply to 3"):
        controller.wait_until_idle(5.0)
    assert bench.clock.now_s() - asked_s < 0.35


@pytest.mark.parametrize("feed_mm_per_s", [5.0, 15.0])
def test_the_stop_script_holds_drops_the_queue_and_lifts(feed_mm_per_s: float) -> None:
    bench = Bench()
    controller = bench.homed()
    controller.start_move((20.0, 0.0, 10.0), feed_mm_per_s=20.0)
    controller.wait_until_idle(5.0)
    for step in range(1, 6):
        controller.start_move((20.0 - step, 0.0, 10.0 - 0.1 * step), feed_mm_per_s=feed_mm_per_s)
    bench.clock.sleep_s(0.2)
    before, places = bench.axes.axes_mm, []
    for data, wait_s in STOP_SCRIPT:
        bench.line.write(data)
        bench.clock.sleep_s(wait_s)
        places.append(bench.axes.axes_mm)
    assert 0 < before[0] - places[0][0] < 0.12 * feed_mm_per_s
    assert places[0] == places[1]
    bench.clock.sleep_s(1.0)
    x, y, z = places[0]
    assert bench.axes.axes_mm == pytest.approx((x, y, z + 1.5), abs=0.002)
