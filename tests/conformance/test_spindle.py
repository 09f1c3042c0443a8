"""What every spindle promises, on every implementation; the rig's own with ``--rig FILE``."""

import math
import os
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
from spindle_benches import (
    MAX_SPEED_RPM,
    SpindleBench,
    in_process_bench,
    in_process_grbl_bench,
    in_process_modbus_bench,
    pty_bench,
    pty_grbl_bench,
    pty_modbus_bench,
    rig_file_bench,
)

from drivers.errors import DeviceBusyError, DeviceFaultError, DeviceTimeoutError
from drivers.spindle.interface import SILENT_AFTER

EMULATED: dict[str, Any] = {
    "in-process": partial(in_process_bench, lawicel=False),
    "in-process-slcan": partial(in_process_bench, lawicel=True),
    "pty-slcan": pty_bench,
    "in-process-modbus": in_process_modbus_bench,
    "pty-modbus": pty_modbus_bench,
    "in-process-grbl-gnea": partial(in_process_grbl_bench, "gnea"),
    "in-process-grbl-grblhal": partial(in_process_grbl_bench, "grblhal"),
    "pty-grbl": partial(pty_grbl_bench, "gnea"),
}
SPEED_RPM = 10_000.0
WATCHED_S = 1.0
"""For drills that nothing watches."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    for fixture in ("spindle_bench", "spindle_wire_bench"):
        if fixture in metafunc.fixturenames:
            makers = dict(EMULATED)
            rig_file = metafunc.config.getoption("--rig")
            if rig_file is not None and fixture == "spindle_bench":
                makers["hardware"] = partial(rig_file_bench, rig_file)
            metafunc.parametrize(fixture, makers.values(), ids=makers.keys(), indirect=True)


@pytest.fixture
def spindle_bench(request: pytest.FixtureRequest) -> Iterator[SpindleBench]:
    with request.param() as bench:
        yield bench


@pytest.fixture
def spindle_wire_bench(request: pytest.FixtureRequest) -> Iterator[SpindleBench]:
    with request.param() as bench:
        yield bench


def look_for(bench: SpindleBench, duration_s: float) -> None:
    """What a control loop does, as far as the spindle is concerned."""
    until_s = bench.clock.now_s() + duration_s
    while bench.clock.now_s() < until_s:
        bench.spindle.status()
        bench.clock.sleep_s(0.01)


def test_fresh_from_its_constructor_it_stands_and_says_who_it_is(spindle_bench: SpindleBench) -> None:
    status = spindle_bench.spindle.status()
    assert status.speed_rpm == pytest.approx(0.0, abs=60.0)
    assert status.fault is None
    assert abs(status.time_s - spindle_bench.clock.now_s()) < 0.5
    assert spindle_bench.spindle.identity
    assert spindle_bench.spindle.heartbeat_s > 0


def test_start_and_stop_twice(spindle_bench: SpindleBench) -> None:
    spindle = spindle_bench.spindle
    for _ in range(2):
        spindle.start(SPEED_RPM)
        assert spindle.wait_until_at_speed(5.0).speed_rpm == pytest.approx(SPEED_RPM, rel=0.03)
        look_for(spindle_bench, 2 * min(spindle.heartbeat_s, WATCHED_S))
        status = spindle.status()
        assert status.fault is None
        assert status.speed_rpm == pytest.approx(SPEED_RPM, rel=0.03)
        assert 0 < status.torque_fraction < 1 if spindle.feels_load else math.isnan(status.torque_fraction)
        spindle.stop()
        assert spindle.wait_until_at_speed(5.0).speed_rpm == pytest.approx(0.0, abs=60.0)


def test_another_speed_while_it_turns(spindle_bench: SpindleBench) -> None:
    spindle = spindle_bench.spindle
    for speed_rpm in (SPEED_RPM, 1.5 * SPEED_RPM, SPEED_RPM):
        spindle.start(speed_rpm)
        assert spindle.wait_until_at_speed(5.0).speed_rpm == pytest.approx(speed_rpm, rel=0.03)


@pytest.mark.parametrize("speed_rpm", [-1.0, 0.0, 10 * MAX_SPEED_RPM, float("nan"), float("inf")])
def test_a_speed_outside_the_limits_is_refused_and_nothing_turns(spindle_bench: SpindleBench, speed_rpm: float) -> None:
    with pytest.raises(ValueError, match="allowed"):
        spindle_bench.spindle.start(speed_rpm)
    assert spindle_bench.spindle.status().speed_rpm == pytest.approx(0.0, abs=60.0)


def test_stop_in_any_state_any_number_of_times(spindle_bench: SpindleBench) -> None:
    spindle = spindle_bench.spindle
    spindle.stop()
    spindle.stop()
    spindle.start(SPEED_RPM)
    spindle.stop()
    spindle.wait_until_at_speed(5.0)
    spindle.stop()
    assert spindle.status().fault is None
    spindle.start(SPEED_RPM)
    spindle.wait_until_at_speed(5.0)


def test_stop_reaches_the_drive_within_20_ms_whatever_the_first_thread_does(spindle_wire_bench: SpindleBench) -> None:
    bench = spindle_wire_bench
    bench.spindle.start(MAX_SPEED_RPM)
    called_s: list[float] = []

    def stop() -> None:
        called_s.append(bench.clock.now_s())
        bench.spindle.stop()

    bench.during_wait(stop)
    with pytest.raises(DeviceFaultError, match=r"stop\(\) came"):
        bench.spindle.wait_until_at_speed(10.0)
    bench.clock.sleep_s(0.02)
    heard_s = [time_s for time_s in bench.plug.stops_s if time_s >= called_s[0]]
    assert heard_s[0] - called_s[0] < 0.02
    assert bench.spindle.wait_until_at_speed(5.0).speed_rpm == pytest.approx(0.0, abs=60.0)


def test_status_waits_for_nothing_long(spindle_bench: SpindleBench) -> None:
    spindle, clock = spindle_bench.spindle, spindle_bench.clock
    clock.sleep_s(0.5)
    for _ in range(10):
        before_s = clock.now_s()
        spindle.status()
        assert clock.now_s() - before_s <= min(SILENT_AFTER * spindle.heartbeat_s, WATCHED_S) + 0.02


def test_a_frozen_loop_stops_the_drill(spindle_wire_bench: SpindleBench) -> None:
    bench = spindle_wire_bench
    bench.spindle.start(SPEED_RPM)
    bench.spindle.wait_until_at_speed(5.0)
    if math.isinf(bench.spindle.heartbeat_s):
        bench.clock.sleep_s(5.0)
        assert bench.load.speed_rpm == pytest.approx(SPEED_RPM, rel=0.03)  # nothing there minds: it says so
        return
    bench.clock.sleep_s(bench.spindle.heartbeat_s + 0.2)
    assert bench.load.speed_rpm == pytest.approx(0.0, abs=60.0)
    status = bench.spindle.status()
    assert status.fault is not None
    assert "heartbeat" in status.fault
    bench.clock.sleep_s(0.3)
    bench.spindle.status()
    assert bench.load.speed_rpm == pytest.approx(0.0, abs=60.0)  # and does not start by itself


def test_a_standing_drill_may_be_forgotten(spindle_wire_bench: SpindleBench) -> None:
    bench = spindle_wire_bench
    bench.clock.sleep_s(2 * min(bench.spindle.heartbeat_s, WATCHED_S))
    assert bench.spindle.status().fault is None
    bench.spindle.start(SPEED_RPM)
    bench.spindle.stop()
    bench.spindle.wait_until_at_speed(5.0)
    bench.clock.sleep_s(2 * min(bench.spindle.heartbeat_s, WATCHED_S))
    assert bench.spindle.status().fault is None
    bench.spindle.start(SPEED_RPM)
    bench.spindle.wait_until_at_speed(5.0)


def test_a_blocked_drill_is_a_fault_that_latches(spindle_wire_bench: SpindleBench) -> None:
    bench = spindle_wire_bench
    bench.spindle.start(SPEED_RPM)
    bench.spindle.wait_until_at_speed(5.0)
    bench.load.torque = 5.0
    if not bench.spindle.feels_load:
        bench.clock.sleep_s(1.0)
        assert bench.load.speed_rpm == pytest.approx(0.0, abs=60.0)
        status = bench.spindle.status()
        assert status.speed_rpm == SPEED_RPM  # what it was told; it says that it feels nothing
        assert math.isnan(status.torque_fraction)
        return
    until_s = bench.clock.now_s() + 5.0
    while (status := bench.spindle.status()).fault is None and bench.clock.now_s() < until_s:
        bench.clock.sleep_s(0.01)
    assert status.fault is not None
    assert "drive fault" in status.fault
    bench.load.torque = 0.05
    with pytest.raises(DeviceFaultError, match="drive fault"):
        bench.spindle.start(SPEED_RPM)
    bench.spindle.stop()
    assert bench.spindle.wait_until_at_speed(5.0).fault == status.fault
    bench.spindle.reset_fault()
    bench.clock.sleep_s(0.2)
    assert bench.spindle.status().fault is None
    assert bench.load.speed_rpm == pytest.approx(0.0, abs=60.0)  # a reset starts nothing
    bench.spindle.start(SPEED_RPM)
    bench.spindle.wait_until_at_speed(5.0)


def test_a_silent_drive_is_told_in_time(spindle_wire_bench: SpindleBench) -> None:
    bench = spindle_wire_bench
    bench.spindle.start(SPEED_RPM)
    bench.spindle.wait_until_at_speed(5.0)
    bench.plug.pulled = True
    before_s = bench.clock.now_s()
    with pytest.raises(DeviceTimeoutError, match=r"silent|no reply"):
        bench.spindle.status()
    watched_s = min(bench.spindle.heartbeat_s, WATCHED_S)
    assert bench.clock.now_s() - before_s < watched_s
    if bench.spindle.heartbeat_s > watched_s:
        assert bench.load.speed_rpm == pytest.approx(SPEED_RPM, rel=0.03)  # nothing there minds: it says so
    else:
        bench.clock.sleep_s(watched_s + 0.2)
        assert bench.load.speed_rpm == pytest.approx(0.0, abs=60.0)  # the drive heard nothing either, and stopped
    bench.plug.pulled = False


def test_closing_twice_leaves_it_standing_and_free_for_the_next(spindle_bench: SpindleBench) -> None:
    spindle_bench.spindle.start(SPEED_RPM)
    spindle_bench.spindle.close()
    spindle_bench.spindle.close()
    assert spindle_bench.load.speed_rpm == pytest.approx(0.0, abs=60.0)
    with spindle_bench.reopen() as again:
        again.start(SPEED_RPM)
        again.wait_until_at_speed(5.0)


def test_a_drill_left_turning_by_a_dead_host_is_stopped_by_the_next() -> None:
    with in_process_bench(lawicel=False) as bench:
        bench.spindle.start(SPEED_RPM)
        bench.spindle.wait_until_at_speed(5.0)
        with bench.reopen() as again:
            assert again.status().speed_rpm == pytest.approx(0.0, abs=60.0)


def test_an_adapter_has_one_owner() -> None:
    with pty_bench() as bench, pytest.raises(DeviceBusyError, match=f"pid {os.getpid()}"):
        bench.reopen()
