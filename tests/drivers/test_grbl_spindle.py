"""A drill on the motion's own controller: one session, a stop that is a toggle, and nobody who watches the host."""

import math
from typing import Literal

import pytest

from cli.config import GrblMotion, GrblSpindleTable
from drivers.errors import ConfigError, DeviceFaultError
from drivers.motion.grbl.driver import GrblController
from drivers.motion.grbl.stop_script import DRILL_OFF, STOP_SCRIPT
from drivers.motion.interface import MotionState
from drivers.spindle.grbl import GrblSpindle
from firmware_sim.bench import MAX_FEED_MM_S, ORIGIN_MM, Bench, open_in_process
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine
from firmware_sim.specimen import Specimen

Dialect = Literal["gnea", "grblhal"]
SPEED_RPM = 20_000.0


def opened(dialect: Dialect = "gnea") -> tuple[GrblController, GrblSpindle, Bench, SimClock, InProcessLine]:
    clock, bench = SimClock(), Bench(Specimen(seed=1), dialect=dialect, spindle="grbl")
    line, bus, _, _ = open_in_process(bench, clock)
    bus.shutdown()
    controller = GrblController(line, clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=MAX_FEED_MM_S)
    spindle = GrblSpindle(controller, clock, max_speed_rpm=60_000, run_up_s=0.5)
    return controller, spindle, bench, clock, line


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_a_stop_in_motion_holds_the_axes_and_stops_the_drill_without_losing_the_position(dialect: Dialect) -> None:
    motion, spindle, bench, _, _ = opened(dialect)
    motion.home()
    spindle.start(SPEED_RPM)
    spindle.wait_until_at_speed(5.0)
    assert bench.machine.spindle_rpm == pytest.approx(SPEED_RPM, rel=0.02)
    motion.start_move((10.0, 0.0, 10.0), feed_mm_per_s=5.0)
    spindle.stop()
    spindle.stop()  # a second override would start it again
    assert spindle.wait_until_at_speed(5.0).speed_rpm == 0.0
    assert bench.machine.spindle_rpm == pytest.approx(0.0, abs=60.0)
    status = motion.status()
    assert status.state is MotionState.IDLE
    assert status.alarm is None
    motion.start_move(status.position_mm, feed_mm_per_s=5.0)


def test_a_stop_override_that_got_lost_is_made_good_by_a_reset_at_standstill() -> None:
    motion, spindle, bench, _, line = opened()
    motion.home()
    spindle.start(SPEED_RPM)
    spindle.wait_until_at_speed(5.0)
    write = line.write
    line.write = lambda data: write(data.replace(b"\x9e", b""))  # type: ignore[method-assign]
    spindle.stop()
    assert bench.machine.spindle_rpm == pytest.approx(SPEED_RPM, rel=0.02)
    assert spindle.wait_until_at_speed(5.0).speed_rpm == 0.0
    assert bench.machine.spindle_rpm == pytest.approx(0.0, abs=60.0)
    assert motion.status().alarm is None
    motion.start_move(motion.status().position_mm, feed_mm_per_s=5.0)


def test_going_on_after_a_stop_would_start_the_drill_and_is_refused() -> None:
    motion, spindle, bench, clock, _ = opened()
    motion.home()
    spindle.start(SPEED_RPM)
    motion.start_move((10.0, 0.0, 10.0), feed_mm_per_s=5.0)
    spindle.stop()
    clock.sleep_s(0.5)
    with pytest.raises(DeviceFaultError, match="would start it"):
        motion.resume()
    motion.flush()
    clock.sleep_s(0.5)
    assert bench.machine.spindle_rpm == pytest.approx(0.0, abs=60.0)


def test_the_reset_of_a_flush_stops_the_drill_which_is_told_and_not_mended() -> None:
    motion, spindle, _, _, _ = opened()
    motion.home()
    spindle.start(SPEED_RPM)
    motion.flush()
    assert "switched off by the controller" in (spindle.status().fault or "")


def test_a_drill_starts_at_standstill_only() -> None:
    motion, spindle, _, _, _ = opened()
    motion.home()
    motion.start_move((10.0, 0.0, 10.0), feed_mm_per_s=5.0)
    with pytest.raises(DeviceFaultError, match="standstill"):
        spindle.start(SPEED_RPM)


def test_an_alarm_stops_the_drill_and_is_told() -> None:
    motion, spindle, bench, clock, _ = opened()
    motion.home()
    spindle.start(SPEED_RPM)
    bench.board.raise_alarm(1)
    clock.sleep_s(0.6)
    assert "which stops the drill" in (spindle.status().fault or "")
    assert bench.machine.spindle_rpm == pytest.approx(0.0, abs=60.0)
    motion.home()
    spindle.start(SPEED_RPM)


def test_closing_the_drill_leaves_the_controller_open_and_closing_the_controller_stops_the_drill() -> None:
    motion, spindle, bench, clock, _ = opened()
    spindle.start(SPEED_RPM)
    spindle.close()
    assert bench.machine.spindle_rpm == pytest.approx(0.0, abs=60.0)
    motion.status()
    again = GrblSpindle(motion, clock, max_speed_rpm=60_000, run_up_s=0.5)
    again.start(SPEED_RPM)
    again.wait_until_at_speed(2.0)
    motion.close()
    clock.sleep_s(0.5)
    assert bench.machine.spindle_rpm == pytest.approx(0.0, abs=60.0)
    again.close()


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
@pytest.mark.parametrize("lost", [None, 1])
def test_the_stop_script_stops_the_drill_also_when_its_first_reset_is_lost(dialect: Dialect, lost: int | None) -> None:
    motion, spindle, bench, clock, line = opened(dialect)
    line.__class__ = type("Reachable", (line.__class__,), {"descriptor": property(lambda _: 7)})
    path = motion.stop_path
    assert path is not None
    assert path.script == STOP_SCRIPT + DRILL_OFF
    motion.home()
    motion.start_move((15.0, 0.0, 10.0), feed_mm_per_s=15.0)
    motion.wait_until_idle(10.0)
    spindle.start(SPEED_RPM)
    motion.start_move((10.0, 0.0, 10.0), feed_mm_per_s=5.0)
    for number, (data, wait_s) in enumerate(path.script):
        if number != lost:
            line.write(data)
        clock.sleep_s(wait_s)
    clock.sleep_s(0.5)
    assert bench.machine.spindle_rpm == pytest.approx(0.0, abs=60.0)
    assert bench.board.state == "Idle", "the position is kept"


@pytest.mark.parametrize(("setting", "value"), [(32, 1.0), (30, 0.0)])
def test_a_controller_that_is_not_set_for_a_drill_is_refused(setting: int, value: float) -> None:
    clock, bench = SimClock(), Bench(Specimen(seed=1), spindle="grbl")
    bench.board.change_setting(setting, value)
    line, bus, _, _ = open_in_process(bench, clock)
    bus.shutdown()
    motion = GrblController(line, clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=MAX_FEED_MM_S)
    with pytest.raises(ConfigError, match=rf"\${setting}"):
        GrblSpindle(motion, clock, max_speed_rpm=60_000)
    motion.close()


def test_it_says_that_it_feels_nothing_and_that_nothing_watches_the_host() -> None:
    _, spindle, _, _, _ = opened()
    assert not spindle.feels_load
    assert math.isinf(spindle.heartbeat_s)
    assert math.isnan(spindle.status().torque_fraction)
    assert "without torque" in spindle.identity


@pytest.mark.parametrize("first", ["motion", "spindle"])
def test_a_rig_opens_both_on_one_port_in_either_order(first: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from cli import rig as rig_module

    clock, bench = SimClock(), Bench(Specimen(seed=1), spindle="grbl")
    opened_lines: list[InProcessLine] = []

    def open_one(table: GrblMotion, _clock: object, _trace: object) -> GrblController:
        opened_lines.append(InProcessLine(bench, clock))
        return GrblController(opened_lines[-1], clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=MAX_FEED_MM_S)

    monkeypatch.setattr(rig_module, "open_grbl", open_one)
    clock.attach(bench.advance_to)
    config = type("Config", (), {"motion": GrblMotion(port="x", origin_mm=ORIGIN_MM), "spindle": GrblSpindleTable()})()
    rig = rig_module.WiredRig(config, clock)
    devices = [rig.open_spindle(), rig.open_motion()] if first == "spindle" else [rig.open_motion(), rig.open_spindle()]
    assert len(opened_lines) == 1
    for device in devices:
        device.close()
    alone = rig.open_spindle()
    alone.close()
    assert len(opened_lines) == 2
    with pytest.raises(OSError, match="closed"):
        opened_lines[1].write(b"?")
