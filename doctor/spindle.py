"""The spindle: who it is, how it answers, run-up, speed, torque, stop, and what it does when the host falls silent."""

import math
from collections.abc import Iterator

from doctor.check import Check, Patient, at_most, percentile, within
from drivers.spindle.interface import Spindle

REPORTS = 400
REPORT_EVERY_S = 0.01
LOST_SHARE = 0.005
"""Of all answers of a wire: a good bus loses none."""


def examine(patient: Patient) -> Iterator[Check]:
    """Where motion is allowed the drill turns for some seconds."""
    clock, earlier = patient.clock, patient.earlier
    with patient.open_spindle() as spindle:
        yield Check("spindle: identity", spindle.identity, "", "answers, host heartbeat read back", True)
        if earlier is not None:
            same = spindle.identity == earlier.spindle
            yield Check("spindle: drive as certified", spindle.identity, "", earlier.spindle, same)
        past = spindle.past_faults()
        yield Check("spindle: errors in its history", "; ".join(past) or "none", "", "told, not required", True)
        status = spindle.status()
        yield Check("spindle: fault", status.fault or "none", "", "none", status.fault is None)
        yield at_most("spindle: at rest", abs(status.speed_rpm), 50.0, "rpm", "it turns without being told")
        if not patient.moving:
            return
        speed_rpm = patient.speed_rpm
        asked_s = clock.now_s()
        spindle.start(speed_rpm)
        spindle.wait_until_at_speed(timeout_s=10.0)
        yield at_most("spindle: run-up", clock.now_s() - asked_s, 5.0, "s")
        yield from _steady(patient, spindle, speed_rpm)
        asked_s = clock.now_s()
        spindle.stop()
        spindle.wait_until_at_speed(timeout_s=10.0)
        yield at_most("spindle: stop", clock.now_s() - asked_s, patient.limits.spindle_stop_s, "s")
        yield from _silence(patient, spindle, speed_rpm)


def _steady(patient: Patient, spindle: Spindle, speed_rpm: float) -> Iterator[Check]:
    clock = patient.clock
    speeds, torques, trips_ms = [], [], []
    before = spindle.answers
    for _ in range(REPORTS):
        asked_s = clock.now_s()
        status = spindle.status()
        trips_ms.append((clock.now_s() - asked_s) * 1e3)
        speeds.append(status.speed_rpm)
        torques.append(status.torque_fraction)
        clock.sleep_s(REPORT_EVERY_S)
    after = spindle.answers
    mean_rpm = sum(speeds) / len(speeds)
    yield within("spindle: steady speed", mean_rpm / speed_rpm * 100.0, 98.0, 102.0, "%", "the drill turns at a speed "
                 "it was not told; look at the drive's limits and its load")  # fmt: skip
    if spindle.feels_load:
        yield within("spindle: torque idle", sum(torques) / len(torques) * 100.0, 0.1, 30.0, "%")
    else:
        yield Check("spindle: torque idle", "not told", "", "told, not required; it does not mill", True)
    yield at_most("spindle: round trip, median", percentile(trips_ms, 0.5), 10.0, "ms")
    yield at_most("spindle: round trip, p99", percentile(trips_ms, 0.99), 50.0, "ms")
    if before is not None and after is not None:
        asked, answered = after[0] - before[0], after[1] - before[1]
        lost = 100.0 * (1.0 - answered / asked)
        advice = "the wire loses frames: check terminators (CAN: 60 ohm across the bus), plugs and bit rate"
        yield at_most("spindle: answers lost", max(0.0, lost), 100.0 * LOST_SHARE, "%", advice)


def _silence(patient: Patient, spindle: Spindle, speed_rpm: float) -> Iterator[Check]:
    """The host says nothing: the drive must have stopped driving by itself, where it says that it does."""
    if math.isinf(spindle.heartbeat_s):
        yield Check("spindle: watches the host", "no", "", "told, not required; only the supervisor stops it", True)
        return
    spindle.start(speed_rpm)
    spindle.wait_until_at_speed(timeout_s=10.0)
    patient.clock.sleep_s(3.0 * spindle.heartbeat_s + 1.0)
    status = spindle.status()
    share = abs(status.speed_rpm) / speed_rpm * 100.0
    spindle.stop()
    advice = "the drive does not mind a silent host: set its heartbeat consumer (1016h) and 6007h"
    yield at_most("spindle: speed after host silence", share, 50.0, "%", advice)
