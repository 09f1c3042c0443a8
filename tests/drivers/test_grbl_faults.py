"""The GRBL driver on a bad wire, a wrongly set controller and a full queue; the board is the emulated one."""

from collections.abc import Callable, Iterator

import pytest

from drivers.errors import (
    ConfigError,
    ConnectionLostError,
    DeviceFaultError,
    DeviceTimeoutError,
    OutOfTravelError,
    ProtocolError,
)
from drivers.motion.grbl.driver import MAX_BLOCKS, GrblController
from drivers.motion.interface import MotionState, Vector
from firmware_sim.clock import SimClock
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.lines import InProcessLine

ORIGIN_MM: Vector = (-25.0, -10.0, -20.0)
SETTINGS = {
    "$10": 3,
    "$20": 1,
    "$22": 1,
    "$24": 600,
    "$25": 2400,
    "$26": 5,
    "$27": 0.5,
    "$130": 35,
    "$131": 40,
    "$132": 28,
} | {f"${first + axis}": value for first, value in ((100, 1000), (110, 2400), (120, 2000)) for axis in range(3)}


class Axes:
    def __init__(self) -> None:
        self.axes_mm: Vector = (0.0, 0.0, 0.0)
        self.x_switch_is_low = False
        self.unplugged = False

    def move_to(self, time_s: float, axes_mm: Vector) -> None:
        self.axes_mm = axes_mm

    def limit_switches(self) -> tuple[bool, bool, bool]:
        x, y, z = self.axes_mm
        x_pressed = x <= -1.0 if self.x_switch_is_low else x >= 1.0
        return (x_pressed and not self.unplugged, y >= 1.0, z >= 1.0)

    def probe_closed(self) -> bool:
        return False


class BadLine:
    """A wire in which a test may change, line by line, what the controller says, and see what it is told."""

    name = "bad:wire"

    def __init__(self, line: InProcessLine) -> None:
        self._line = line
        self._rest = b""
        self.change: Callable[[bytes], bytes] = lambda line: line
        self.written = b""

    def write(self, data: bytes) -> None:
        self.written += data
        self._line.write(data)

    def read(self, timeout_s: float) -> bytes:
        *lines, self._rest = (self._rest + self._line.read(timeout_s)).split(b"\n")
        return b"".join(self.change(line + b"\n") for line in lines)

    def close(self) -> None:
        self._line.close()

    def once(self, start: bytes, change: Callable[[bytes], bytes]) -> None:
        """Change the next line that starts so."""
        left = [1]

        def one(line: bytes) -> bytes:
            if left and line.startswith(start):
                left.pop()
                return change(line)
            return line

        self.change = one


class Bench:
    def __init__(self, dialect: str, settings: dict[str, float]) -> None:
        self.clock = SimClock()
        self.axes = Axes()
        known = {key: value for key, value in settings.items() if dialect == "gnea" or key != "$10"}
        self.board = GrblBoard(self.axes, dialect=dialect, settings=known)  # type: ignore[arg-type]
        self.clock.attach(self.board.advance_to)

    def open(self, expected: dict[str, float] | None = None) -> tuple[GrblController, BadLine]:
        line = BadLine(InProcessLine(self.board, self.clock))
        controller = GrblController(
            line, self.clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0, expected_settings=expected or {}
        )
        return controller, line


def homed(dialect: str = "gnea") -> tuple[GrblController, BadLine, Bench]:
    bench = Bench(dialect, SETTINGS)
    controller, line = bench.open()
    controller.home()
    return controller, line, bench


@pytest.fixture(params=["gnea", "grblhal"])
def on_wire(request: pytest.FixtureRequest) -> Iterator[tuple[GrblController, BadLine, Bench]]:
    controller, line, bench = homed(request.param)
    yield controller, line, bench
    line.change = lambda line: line
    controller.close()


Wired = tuple[GrblController, BadLine, Bench]


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
    missed = []

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
    halted = []
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


def test_what_the_rig_file_expects_is_compared_and_named() -> None:
    bench = Bench("gnea", SETTINGS)
    with pytest.raises(ConfigError, match=r"\$130 is 35, the rig file expects 36"):
        bench.open({"$132": 28, "$130": 36})
    with pytest.raises(ConfigError, match=r"no setting \$999"):
        bench.open({"$999": 1})
    with pytest.raises(ConfigError, match="'acceleration'"):
        bench.open({"acceleration": 1})


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("$20", 0, r"\$20 is 0.*soft limits.*\$20=1"),
        ("$22", 0, r"\$22 is 0.*homing.*\$22=1"),
        ("$13", 1, r"\$13 is 1.*millimetres.*\$13=0"),
        ("$131", 0, r"\$131 \(Y\) is missing or zero"),
    ],
)
@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_a_controller_that_would_not_refuse_is_refused(dialect: str, key: str, value: float, complaint: str) -> None:
    settings = SETTINGS | {key: value}
    if key == "$22":
        settings["$20"] = 0
    with pytest.raises(ConfigError, match=complaint):
        Bench(dialect, settings).open()


def test_only_gnea_gets_its_report_mask_written_and_only_when_needed() -> None:
    bench = Bench("gnea", SETTINGS | {"$10": 1})
    controller, line = bench.open()
    assert b"$10=3\n" in line.written
    controller.close()
    controller, line = bench.open()
    assert b"$10=" not in line.written
    controller.close()
    controller, line = Bench("grblhal", SETTINGS).open()
    assert b"$10=" not in line.written
    controller.close()


@pytest.mark.parametrize("mask", [0, 2])
def test_a_controller_that_reports_work_positions_is_put_right_or_refused(mask: int) -> None:
    controller, line = Bench("gnea", SETTINGS | {"$10": mask}).open()
    assert b"$10=3\n" in line.written
    controller.home()
    controller.close()
    bench = Bench("grblhal", SETTINGS)
    bench.board.receive(b"$10=%d\n" % mask)
    bench.clock.sleep_s(0.1)
    with pytest.raises(ConfigError, match=rf"\$10 is {mask}.*\$10=3"):
        bench.open()


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


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_a_coarse_machine_with_a_long_travel(dialect: str) -> None:
    """250 steps/mm and 200 mm: every place within half a step, the floor and both ends of the travel reached."""
    coarse = {f"${first + axis}": value for first, value in ((100, 250), (130, 200)) for axis in range(3)}
    bench = Bench(dialect, SETTINGS | coarse)
    with bench.open(coarse)[0] as controller:
        controller.home()
        controller.set_floor(-33.3333)
        low, high = controller.travel.low_mm, controller.travel.high_mm
        assert low == pytest.approx((-175.0, -190.0, -33.333), abs=0.001)
        for target in ((high[0] - 0.5017, high[1] - 0.5, low[2]), (high[0] - 30.0013, high[1] - 7.7777, -5.5555)):
            controller.start_move(target, feed_mm_per_s=20.0)
            reached = controller.wait_until_idle(60.0).position_mm
            assert reached == pytest.approx(target, abs=0.0026)
        for index in range(30):  # steps shorter than one of the motor's
            controller.start_move((target[0] + 0.001 * index, *target[1:]), feed_mm_per_s=1.0)
        assert controller.wait_until_idle(5.0).queued_s == 0.0


def test_the_floor_of_a_host_that_was_killed_does_not_stay(on_wire: Wired) -> None:
    controller, _, bench = on_wire
    controller.set_floor(0.0)
    again, line = bench.open({"$132": 28, "$130": 35})
    assert b"$132=28\n" in line.written
    again.home()
    assert again.travel.low_mm[2] == pytest.approx(-8.0)
    again.set_floor(0.0)
    with pytest.raises(ConfigError, match=r"\$130 is 35, the rig file expects 36"):
        bench.open({"$132": 28, "$130": 36})
    # The refusal wrote nothing.
    with pytest.raises(ConfigError, match=r"\$132 is 20, the rig file expects 19"):
        bench.open({"$132": 19, "$130": 35})


@pytest.mark.parametrize(("mask", "home_mm"), [(0, -0.5), (1, -34.5)])
def test_homing_directions(mask: int, home_mm: float) -> None:
    """The coordinates are negative wherever the switch is ($23), as long as the firmware sets no origin there."""
    bench = Bench("gnea", SETTINGS | {"$23": mask})
    bench.axes.x_switch_is_low = bool(mask)
    controller, _ = bench.open()
    controller.home()
    assert controller.status().position_mm[0] + ORIGIN_MM[0] == pytest.approx(home_mm, abs=0.002)
    assert controller.travel.low_mm == pytest.approx((-10.0, -30.0, -8.0))
    assert controller.travel.high_mm == pytest.approx((25.0, 10.0, 20.0))
    controller.close()


def test_a_floor_is_refused_where_z_homes_at_the_bottom() -> None:
    controller, _ = Bench("gnea", SETTINGS | {"$23": 4}).open()
    with pytest.raises(ConfigError, match=r"\$23"):
        controller.set_floor(0.0)
    controller.close()


def test_a_floor_above_the_tip_is_refused(on_wire: Wired) -> None:
    controller, _, _ = on_wire
    controller.start_move((24.0, 9.0, 12.0), feed_mm_per_s=20.0)
    controller.wait_until_idle(5.0)
    with pytest.raises(OutOfTravelError, match="above the tip"):
        controller.set_floor(13.0)


def test_a_setting_that_does_not_read_back_is_told(on_wire: Wired) -> None:
    controller, line, _ = on_wire
    line.change = lambda text: b"$132=28.000\r\n" if text.startswith(b"$132=") else text
    with pytest.raises(DeviceFaultError, match=r"\$132 was written as 20 and reads back as 28"):
        controller.set_floor(0.0)


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
