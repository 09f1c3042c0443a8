"""`mill doctor`: opens, identifies, reads back and measures each device through the interfaces of `drivers`."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import click

from cli.options import BenchChoice, json_option, on_a_bench
from cli.output import console_beside, for_people, write_json
from cli.rig import Rig, rig_for
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceError
from drivers.motion.interface import MotionController, MotionState

ROUND_TRIPS = 50
FRAMES = 30
STOP_TEST_MM = 4.0
STOP_TEST_FEED_MM_S = 5.0


@dataclass(frozen=True)
class Check:
    """One finding: what was measured, in which unit, against which limit."""

    name: str
    value: float | str
    unit: str
    limit: str
    passed: bool

    def to_json(self) -> dict[str, float | str]:
        """As the results file has it."""
        verdict = "pass" if self.passed else "fail"
        return {"name": self.name, "value": self.value, "unit": self.unit, "limit": self.limit, "verdict": verdict}


@click.command()
@on_a_bench
@json_option
@click.option(
    "--no-motion", is_flag=True, help="Leave the axes and the spindle still; measure only what needs neither."
)
def doctor(chosen: BenchChoice, json_file: Path | None, no_motion: bool) -> None:
    """Open, identify, read back and measure each device of a rig.

    The axes home, rise to the park position and move a few mm in the air there; the spindle turns for some seconds.
    Exits 0 only if every check passes.
    """
    console = console_beside(json_file)
    checks: list[Check] = []
    with rig_for(chosen) as bench:
        moving = not no_motion
        for check in chain(
            _whole("motion", _motion_checks(bench, moving)),
            _whole("spindle", _spindle_checks(bench, moving)),
            _whole("camera", _camera_checks(bench)),
        ):
            checks.append(check)
            _show(console, check)
    passed = all(check.passed for check in checks)
    if json_file:
        found = [check.to_json() for check in checks]
        write_json(json_file, "doctor", seed=chosen.drawn_from, passed=passed, checks=found)
    failed = sum(not check.passed for check in checks)
    console.print(
        "[bold green]every check passed[/]" if passed else f"[bold red]{failed} of {len(checks)} checks failed[/]"
    )
    if not passed:
        raise SystemExit(1)


def _show(console: Any, check: Check) -> None:
    value = f"{check.value:.4g}" if isinstance(check.value, float) else check.value
    mark = "[green]pass[/]" if check.passed else "[bold red]FAIL[/]"
    line = f"{mark}  {check.name:<34} {value} {check.unit:<6} [dim]{check.limit}[/]"
    console.print(line, highlight=False, soft_wrap=True)


def _at_most(name: str, value: float, limit: float, unit: str) -> Check:
    return Check(name, value, unit, f"at most {limit:g}", value <= limit)


def _within(name: str, value: float, low: float, high: float, unit: str) -> Check:
    return Check(name, value, unit, f"{low:g} to {high:g}", low <= value <= high)


def _whole(name: str, checks: Iterator[Check]) -> Iterator[Check]:
    """The checks of one device; one that fails in the middle is a finding, and the next device's turn.

    So is a device that is not set as the rig file says, or not as mill needs it: the file itself was found good before.
    """
    try:
        yield from checks
    except (DeviceError, ConfigError) as error:
        yield Check(f"{name}: answers", for_people(error), "", "no error", False)


def _percentile(values: list[float], share: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def _motion_checks(rig: Rig, moving: bool) -> Iterator[Check]:
    with rig.open_motion() as motion:
        yield Check("motion: identity", motion.identity, "", "answers, settings as in the rig file", True)
        trips_ms = []
        for _ in range(ROUND_TRIPS):
            asked_s = rig.clock.now_s()
            motion.status()
            trips_ms.append((rig.clock.now_s() - asked_s) * 1e3)
        yield _at_most("motion: round trip, median", _percentile(trips_ms, 0.5), 20.0, "ms")
        yield _at_most("motion: round trip, p99", _percentile(trips_ms, 0.99), 50.0, "ms")
        if not moving:
            return
        motion.home()
        home_mm = motion.status().position_mm
        yield Check("motion: homes", f"x {home_mm[0]:.3f} y {home_mm[1]:.3f} z {home_mm[2]:.3f}", "mm", "idle", True)
        motion.start_move(rig.config.bench.park_mm, feed_mm_per_s=STOP_TEST_FEED_MM_S * 2)
        motion.wait_until_idle(timeout_s=60.0)
        yield _stop_latency(motion, rig)


def _stop_latency(motion: MotionController, rig: Rig) -> Check:
    """From the request to hold until two reports show the same place; then back to where it was."""
    park_mm = rig.config.bench.park_mm
    away_mm = (park_mm[0] - STOP_TEST_MM, park_mm[1], park_mm[2])
    motion.start_move(away_mm, feed_mm_per_s=STOP_TEST_FEED_MM_S)
    rig.clock.sleep_s(STOP_TEST_MM / STOP_TEST_FEED_MM_S / 2)
    asked_s = rig.clock.now_s()
    motion.hold()
    stood_s = _standstill_s(motion, rig.clock)
    motion.flush()
    motion.start_move(park_mm, feed_mm_per_s=STOP_TEST_FEED_MM_S)
    motion.wait_until_idle(timeout_s=30.0)
    return _at_most("motion: hold to standstill", (stood_s - asked_s) * 1e3, 250.0, "ms")


def _standstill_s(motion: MotionController, clock: Clock) -> float:
    """The time of the first report whose place the following ones repeat."""
    before = motion.status()
    deadline_s = clock.now_s() + 2.0
    while clock.now_s() < deadline_s:
        clock.sleep_s(0.005)
        after = motion.status()
        if after.position_mm == before.position_mm and after.state is MotionState.HELD:
            return before.time_s
        before = after
    return deadline_s


def _spindle_checks(rig: Rig, moving: bool) -> Iterator[Check]:
    with rig.open_spindle() as spindle:
        yield Check("spindle: identity", spindle.identity, "", "answers, host heartbeat read back", True)
        status = spindle.status()
        yield Check("spindle: fault", status.fault or "none", "", "none", status.fault is None)
        yield _at_most("spindle: at rest", abs(status.speed_rpm), 50.0, "rpm")
        if not moving:
            return
        speed_rpm = float(rig.config.spindle.model_dump().get("speed_rpm", 20_000.0))
        asked_s = rig.clock.now_s()
        spindle.start(speed_rpm)
        spindle.wait_until_at_speed(timeout_s=10.0)
        yield _at_most("spindle: run-up", rig.clock.now_s() - asked_s, 5.0, "s")
        speeds, torques = [], []
        for _ in range(ROUND_TRIPS):
            rig.clock.sleep_s(0.01)
            status = spindle.status()
            speeds.append(status.speed_rpm)
            torques.append(status.torque_fraction)
        mean_rpm = sum(speeds) / len(speeds)
        yield _within("spindle: steady speed", mean_rpm / speed_rpm * 100.0, 98.0, 102.0, "%")
        yield _within("spindle: torque idle", sum(torques) / len(torques) * 100.0, 0.1, 30.0, "%")
        asked_s = rig.clock.now_s()
        spindle.stop()
        spindle.wait_until_at_speed(timeout_s=10.0)
        yield _at_most("spindle: stop", rig.clock.now_s() - asked_s, 5.0, "s")
        yield _heartbeat_loss(rig, spindle, speed_rpm)


def _heartbeat_loss(rig: Rig, spindle: Any, speed_rpm: float) -> Check:
    """Silence for three heartbeats: the drive must have stopped driving by itself."""
    spindle.start(speed_rpm)
    spindle.wait_until_at_speed(timeout_s=10.0)
    rig.clock.sleep_s(3.0 * spindle.heartbeat_s + 1.0)
    status = spindle.status()
    share = abs(status.speed_rpm) / speed_rpm * 100.0
    spindle.stop()
    return _at_most("spindle: speed after host silence", share, 50.0, "%")


def _camera_checks(rig: Rig) -> Iterator[Check]:
    import numpy as np

    with rig.open_camera() as camera:
        yield Check("camera: identity", camera.identity, "", "both open", True)
        started_s = rig.clock.now_s()
        ages_ms, stamps = [], []
        for _ in range(FRAMES):
            frame = camera.capture()
            ages_ms.append((rig.clock.now_s() - frame.exposed_at_s) * 1e3)
            stamps.append(frame.exposed_at_s)
        rate_hz = FRAMES / (rig.clock.now_s() - started_s)
        yield Check("camera: fresh pairs", rate_hz, "/s", "at least 5", rate_hz >= 5.0)
        yield _at_most("camera: age at delivery, median", _percentile(ages_ms, 0.5), 100.0, "ms")
        for side, image in (("left", frame.left), ("right", frame.right)):
            yield _within(f"camera: {side} brightness", float(image.mean()), 20.0, 235.0, "dn")
            yield _at_most(f"camera: {side} saturated", float((image >= 254).mean() * 100.0), 10.0, "%")
            detail = float(abs(np.diff(image.astype(np.int16), axis=1)).mean())
            yield Check(f"camera: {side} detail", detail, "dn", "at least 0.5", detail >= 0.5)
