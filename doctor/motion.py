"""The motion controller by itself: who it is, how it is set, how fast it answers, how soon it stops."""

import math
from collections.abc import Iterator
from pathlib import Path

from doctor.check import Check, Patient, at_least, at_most, percentile
from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceFaultError, NotHomedError, OutOfTravelError
from drivers.motion.interface import MotionController, MotionState, Vector

ROUND_TRIPS = 100
MEDIAN_MS = 12.0
"""A USB adapter that hands bytes on at once takes 4 to 8; one that waits for 16 ms takes that in addition."""
TEST_MM, TEST_FEED_MM_S = 4.0, 5.0
BEYOND_MM = 0.01
LONGEST_LINE = 80
"""Bytes; a line of mill's is shorter."""
RESTARTED_S = 1.5
"""A board that was reset speaks again by then."""
TINY_MM, TINY_MOVES = 0.02, 40
OFF_MM = 0.02
_LATENCY = "set the adapter's latency timer to 1 ms (udev/README.md), and take it off a busy hub"


def examine(patient: Patient) -> Iterator[Check]:
    """Where motion is allowed it homes, and moves a few mm at the park position."""
    clock = patient.clock
    with patient.open_motion() as motion:
        yield Check("motion: identity", motion.identity, "", "answers, settings as in the rig file", True)
        yield from _against_certificate(patient, motion)
        yield from _adapter(patient.motion_port)
        if motion.buffer_bytes is not None:
            yield at_least(
                "motion: serial buffer", float(motion.buffer_bytes), LONGEST_LINE, "bytes", "another firmware"
            )
        trips_ms = []
        for _ in range(ROUND_TRIPS):
            asked_s = clock.now_s()
            motion.status()
            trips_ms.append((clock.now_s() - asked_s) * 1e3)
        yield at_most("motion: serial round trip, median", percentile(trips_ms, 0.5), MEDIAN_MS, "ms", _LATENCY)
        limit_ms = patient.limits.round_trip_ms
        yield at_most("motion: serial round trip, p99", percentile(trips_ms, 0.99), limit_ms, "ms", _LATENCY)
        if not patient.moving:
            return
        patient.doing("homing")
        motion.home()
        home_mm = motion.status().position_mm
        yield Check("motion: homes", f"x {home_mm[0]:.3f} y {home_mm[1]:.3f} z {home_mm[2]:.3f}", "mm", "idle", True)
        yield _edges(motion)
        motion.start_move(patient.park_mm, feed_mm_per_s=2 * TEST_FEED_MM_S)
        motion.wait_until_idle(timeout_s=60.0)
        yield _line_rate(motion, patient.park_mm, clock)
        patient.doing("stopping in motion")
        yield from _hold(motion, patient)
        yield from _halt(motion, patient)


def _against_certificate(patient: Patient, motion: MotionController) -> Iterator[Check]:
    earlier = patient.earlier
    if earlier is None:
        return
    same = motion.identity == earlier.motion
    yield Check(
        "motion: firmware as certified", motion.identity, "", earlier.motion, same,
        "if the change was meant, calibrate, and run `mill doctor --recertify`",
    )  # fmt: skip
    now = dict(motion.settings)
    changed = [
        f"{name} {earlier.settings.get(name, 'missing')} -> {now.get(name, 'missing')}"
        for name in sorted({*now, *earlier.settings})
        if now.get(name) != earlier.settings.get(name)
    ]
    yield Check(
        "motion: settings as certified", "; ".join(changed) or "the same", "", "the same", not changed,
        "write them back, or if the change was meant, calibrate, and run `mill doctor --recertify`",
    )  # fmt: skip


def _adapter(port: str) -> Iterator[Check]:
    """The latency timer of an FTDI adapter, where the port is one."""
    timer = Path("/sys/class/tty") / Path(port).resolve().name / "device/latency_timer"
    try:
        value = float(timer.read_text())
    except (OSError, ValueError):
        return
    yield at_most("motion: latency timer of the adapter", value, 1.0, "ms", _LATENCY)


def _edges(motion: MotionController) -> Check:
    """Targets just outside each of the six sides of the travel must be refused, and nothing may move."""
    travel, before = motion.travel, motion.status().position_mm
    taken = []
    for axis, letter in enumerate("XYZ"):
        for side, edge, away in (("low", travel.low_mm, -BEYOND_MM), ("high", travel.high_mm, BEYOND_MM)):
            target = list(before)
            target[axis] = edge[axis] + away
            try:
                motion.start_move((target[0], target[1], target[2]), feed_mm_per_s=TEST_FEED_MM_S)
            except OutOfTravelError:
                continue
            taken.append(f"{letter} {side}")
    still = motion.status().position_mm == before
    value = ", ".join(taken) or "refused at all six" + ("" if still else ", but it moved")
    return Check("motion: limits of the travel", value, "", "refused at all six", not taken and still)


def _line_rate(motion: MotionController, park_mm: Vector, clock: Clock) -> Check:
    """Tiny moves taken per second, each acknowledged: what short segments need."""
    x, y, z = park_mm
    began_s = clock.now_s()
    for number in range(TINY_MOVES):
        motion.start_move((x - TINY_MM * (number % 2), y, z), feed_mm_per_s=TEST_FEED_MM_S)
    rate = TINY_MOVES / (clock.now_s() - began_s)
    motion.wait_until_idle(timeout_s=10.0)
    return at_least("motion: segments taken", rate, 30.0, "/s", "the loop writes 25 a second")


def _hold(motion: MotionController, patient: Patient) -> Iterator[Check]:
    """From the request to hold until two reports show the same place, which must lie on the way; then back."""
    x, y, z = patient.park_mm
    motion.start_move((x - TEST_MM, y, z), feed_mm_per_s=TEST_FEED_MM_S)
    patient.clock.sleep_s(TEST_MM / TEST_FEED_MM_S / 2)
    asked_s = patient.clock.now_s()
    motion.hold()
    stood_s, at = _standstill(motion, patient.clock)
    motion.flush()
    after = motion.status().position_mm
    yield at_most("motion: hold to standstill", (stood_s - asked_s) * 1e3, patient.limits.hold_ms, "ms")
    off_mm = max(abs(at[1] - y), abs(at[2] - z), *(abs(p - q) for p, q in zip(at, after, strict=True)))
    yield at_most("motion: position after a stop", off_mm, OFF_MM, "mm", "it slipped off its way; look at the axes")
    motion.start_move(patient.park_mm, feed_mm_per_s=TEST_FEED_MM_S)
    motion.wait_until_idle(timeout_s=30.0)


def _standstill(motion: MotionController, clock: Clock) -> tuple[float, Vector]:
    """The time of the first report whose place the following ones repeat, and that place."""
    before = motion.status()
    deadline_s = clock.now_s() + 2.0
    while clock.now_s() < deadline_s:
        clock.sleep_s(0.005)
        after = motion.status()
        if after.position_mm == before.position_mm and after.state is MotionState.HELD:
            return before.time_s, before.position_mm
        before = after
    return deadline_s, before.position_mm


def _halt(motion: MotionController, patient: Patient) -> Iterator[Check]:
    """An emergency stop in motion: how far it still ran, and that nothing moves again before homing."""
    x, y, z = patient.park_mm
    motion.start_move((x - TEST_MM, y, z), feed_mm_per_s=TEST_FEED_MM_S)
    patient.clock.sleep_s(0.3)
    before = motion.status()
    asked_s = patient.clock.now_s()
    motion.halt()
    refused = False
    try:
        motion.start_move(patient.park_mm, feed_mm_per_s=TEST_FEED_MM_S)
    except (DeviceFaultError, NotHomedError):
        refused = True
    patient.clock.sleep_s(RESTARTED_S)
    after = motion.status()
    if after.time_s > asked_s:
        # What it ran after the report before, at the speed it had, less what it ran before it was asked.
        ran_s = math.dist(before.position_mm, after.position_mm) / TEST_FEED_MM_S - (asked_s - before.time_s)
        yield at_most("motion: halt to standstill", 1e3 * max(0.0, ran_s), patient.limits.hold_ms, "ms")
    try:
        motion.home()
    except DeviceError as error:
        refused, found = False, f"homing failed afterwards: {error}"
    else:
        found = "yes" if refused else "NO"
    yield Check("motion: emergency stop latches", found, "", "until homed", refused)
