"""The GRBL driver on a bad wire and with a full queue; the board is the emulated one."""

from collections.abc import Callable

import pytest
from grbl_wire import ORIGIN_MM, SETTINGS, BadLine, Bench, Wired, homed

from drivers.errors import (
    ConnectionLostError,
    DeviceFaultError,
    DeviceTimeoutError,
    ProtocolError,
)
from drivers.motion.grbl.driver import MAX_BLOCKS, GrblController
from drivers.motion.interface import MotionState
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine


def test_one_broken_report_is_forgiven(on_wire: Wired) -> None:
    controller, line, bench = on_wire
    started_s = bench.clock.now_s()
    line.once(b"<", lambda report: report[:9] + report[14:])
    assert controller.status().state is MotionState.IDLE
    assert 0.25 <= bench.clock.now_s() - started_s < 0.3


def test_two_broken_reports_in_a_row_are_not(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    line.change = lambda text: text.replace(b"MPos", b"MP\xffs")
    with pytest.raises(ProtocolError, match="two broken lines"):
        controller.status()
    line.change = lambda text: text
    with pytest.raises(DeviceFaultError, match=r"flush\(\) first"):
        controller.start_move((20.0, 0.0, 10.0), feed_mm_per_s=5.0)
    assert controller.flush().state is MotionState.IDLE
    controller.start_move((24.0, 9.0, 19.0), feed_mm_per_s=5.0)


def test_three_missed_replies_are_a_timeout_and_two_are_not(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    missed: list[bytes] = []

    def swallow(count: int) -> Callable[[bytes], bytes]:
        def change(text: bytes) -> bytes:
            if text.startswith(b"<") and len(missed) < count:
                missed.append(text)
                return b""
            return text

        return change

    line.change = swallow(2)
    assert controller.status().state is MotionState.IDLE
    missed.clear()
    line.change = swallow(3)
    with pytest.raises(DeviceTimeoutError, match="3 status queries"):
        controller.status()


def test_a_lost_ok_stops_the_queue_until_it_is_flushed(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    line.once(b"ok", lambda _: b"")
    with pytest.raises(DeviceTimeoutError, match="neither taken nor refused"):
        controller.start_move((20.0, 9.0, 19.0), feed_mm_per_s=5.0)
    with pytest.raises(DeviceFaultError, match="flush"):
        controller.start_move((21.0, 9.0, 19.0), feed_mm_per_s=5.0)
    controller.flush()
    controller.start_move((21.0, 9.0, 19.0), feed_mm_per_s=5.0)
    assert controller.wait_until_idle(5.0).position_mm == pytest.approx((21.0, 9.0, 19.0), abs=0.0015)


def test_an_ok_too_many_stops_the_queue_until_it_is_flushed(on_wire: Wired) -> None:
    controller, _, bench = on_wire
    bench.board.receive(b"\n")
    bench.clock.sleep_s(0.05)
    with pytest.raises(DeviceFaultError, match="no line was waiting"):
        controller.start_move((20.0, 9.0, 19.0), feed_mm_per_s=5.0)
    assert controller.flush().state is MotionState.IDLE


def test_a_refused_line_is_named_and_stops_the_queue(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    line.once(b"ok", lambda _: b"error:22\r\n")
    with pytest.raises(DeviceFaultError, match=r"G53G1.*error:22 \(no feed rate\)"):
        controller.start_move((20.0, 9.0, 19.0), feed_mm_per_s=5.0)
    with pytest.raises(DeviceFaultError, match="refused"):
        controller.start_move((20.0, 9.0, 19.0), feed_mm_per_s=5.0)
    controller.flush()


def test_a_controller_that_loses_its_power_while_it_is_flushed_is_not_unlocked(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    banner = []

    def lock_after_the_banner(text: bytes) -> bytes:
        banner.extend([text] if b"for help" in text else [])
        return text.replace(b"<Idle", b"<Alarm") if banner else text

    line.change = lock_after_the_banner
    with pytest.raises(DeviceFaultError, match="position lost"):
        controller.flush()
    assert b"$X" not in line.written
    line.change = lambda text: text
    with pytest.raises(DeviceFaultError, match="locked itself"):
        controller.start_move((20.0, 9.0, 19.0), feed_mm_per_s=5.0)
    controller.home()


def test_an_alarm_in_the_middle_of_anything_latches(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    line.once(b"<", lambda report: b"ALARM:1\r\n" + report)
    status = controller.status()
    assert status.state is MotionState.ALARM
    assert "hard limit" in (status.alarm or "")
    for refused in (controller.resume, controller.flush, lambda: controller.set_floor(0.0)):
        with pytest.raises(DeviceFaultError, match="hard limit"):
            refused()


def test_never_more_than_fourteen_blocks_are_in_flight(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    fewest_free = []

    def look(text: bytes) -> bytes:
        if b"|Bf:" in text:
            fewest_free.append(int(text.split(b"|Bf:")[1].split(b",")[0]))
        return text

    line.change = look
    x, y, z = controller.status().position_mm
    for index in range(1, 60):
        controller.start_move((x - 0.02 * index, y, z), feed_mm_per_s=1.0)
        assert controller.status().queued_s <= MAX_BLOCKS * 0.02 + 0.1
    capacity = max(fewest_free)
    assert MAX_BLOCKS - 2 <= capacity - min(fewest_free) <= MAX_BLOCKS
    controller.wait_until_idle(5.0)


def test_a_halt_between_check_and_line_does_not_let_the_line_through(on_wire: Wired) -> None:
    controller, line, bench = on_wire
    before_mm = bench.axes.axes_mm
    halted: list[bool] = []
    write = line.write

    def halt_just_before_the_line(data: bytes) -> None:
        if data.startswith(b"G53") and not halted:
            halted.append(True)
            controller.halt()
            # The reset is over before the line leaves, and the controller is idle and open again.
            bench.clock.sleep_s(0.2)
        write(data)

    line.write = halt_just_before_the_line  # type: ignore[method-assign]
    with pytest.raises(DeviceFaultError, match="halt"):
        controller.start_move((4.0, 9.0, 19.0), feed_mm_per_s=5.0)
    bench.clock.sleep_s(2.0)
    assert max(abs(now - before) for now, before in zip(bench.axes.axes_mm, before_mm, strict=True)) < 0.05


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_a_first_boot_that_dumps_its_settings_is_taken(dialect: str) -> None:
    bench = Bench(dialect, SETTINGS)
    line = BadLine(InProcessLine(bench.board, bench.clock))
    # A fresh memory: the reset breaks the dump off in the middle of a line.
    line.once(b"Grbl", lambda banner: b"error:7\r\n$0=10\r\n$10=1\r\n$22\r\n" + banner)
    with GrblController(line, bench.clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0) as controller:
        controller.home()
        assert controller.status().state is MotionState.IDLE


def test_an_alarm_of_1_1h_that_swallows_the_first_reset_is_still_released() -> None:
    """ALARM:2 waits half a second before it listens, and a reset that comes earlier is lost."""
    controller, line, bench = homed("gnea")
    bench.board.receive(b"G53G1Z-99F600\n")
    while controller.status().alarm is None:
        bench.clock.sleep_s(0.01)
    resets = line.written.count(b"\x18")
    controller.home()
    assert line.written.count(b"\x18") == resets + 2
    controller.start_move((24.0, 9.0, 19.0), feed_mm_per_s=5.0)
    assert controller.wait_until_idle(5.0).position_mm == pytest.approx((24.0, 9.0, 19.0), abs=0.0015)
    controller.close()


def test_silence_is_not_taken_for_a_controller() -> None:
    class Silence:
        name = "silent:wire"

        def __init__(self, clock: SimClock) -> None:
            self.clock = clock
            self.closed = False
            self.written = b""

        def write(self, data: bytes) -> None:
            self.written += data

        def read(self, timeout_s: float) -> bytes:
            self.clock.sleep_s(timeout_s)
            return b""

        def close(self) -> None:
            self.closed = True

    clock = SimClock()
    line = Silence(clock)
    with pytest.raises(DeviceTimeoutError, match=r"silent:wire.*banner.*mill devices"):
        GrblController(line, clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0)
    assert line.closed
    assert line.written == b"\x18\x18"


def test_a_homing_that_finds_no_switch_is_named_and_latches() -> None:
    bench = Bench("gnea", SETTINGS)
    bench.axes.unplugged = True
    controller, _ = bench.open()
    with pytest.raises(DeviceFaultError, match="ALARM:9"):
        controller.home()
    controller.close()


def test_after_close_nothing_is_written(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    controller.close()
    before = line.written
    controller.close()
    assert line.written == before
    with pytest.raises(ConnectionLostError):
        controller.status()
