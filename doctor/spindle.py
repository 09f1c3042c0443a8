"""The spindle: who it is, how it answers, run-up, speed, torque, stop, and what it does when the host falls silent."""

import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from doctor.check import Check, Patient, at_most, percentile, within
from drivers.spindle.interface import Spindle

LISTEN_S = 3.0
BEAT_SHARE = 0.5
"""Of the drive's heartbeat: the host takes it for silent when one is late by more than that."""
REPORTS = 400
REPORT_EVERY_S = 0.01
FEW_BEATS = 4
STANDS_RPM = 50.0
MOST_ERRORS = 2
"""A lone one is forgiven; an adapter tells one refused frame twice."""
INTERFACES = Path("/sys/class/net")
_WIRE = "the wire loses or spoils frames: check terminators (CAN: 60 ohm across the bus), plugs and bit rate"
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
        patient.doing("listening to the drive")
        yield from _heartbeat(spindle)
        if not patient.moving:
            yield from _errors(patient, spindle)
            return
        patient.doing("running up")
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
        patient.doing("falling silent, to see whether the drive stops by itself")
        yield from _silence(patient, spindle, speed_rpm)
        yield from _errors(patient, spindle)


def _heartbeat(spindle: Spindle) -> Iterator[Check]:
    """How evenly the drive's own signs of life come."""
    beats_s = spindle.heartbeats_s(LISTEN_S)
    gaps_s = [after - before for before, after in pairwise(beats_s)]
    if len(gaps_s) < FEW_BEATS:
        return
    middle_s = percentile(gaps_s, 0.5)
    jitter = percentile([abs(gap_s - middle_s) / middle_s for gap_s in gaps_s], 0.9)
    yield at_most("spindle: heartbeat jitter, p90", 100.0 * jitter, 100.0 * BEAT_SHARE, "%", _WIRE)


def _errors(patient: Patient, spindle: Spindle) -> Iterator[Check]:
    """What driver, adapter and kernel have counted."""
    if (errors := spindle.errors_on_wire) is not None:
        yield at_most("spindle: errors on its wire", float(errors), MOST_ERRORS, "", _WIRE)
    for name in ("rx_errors", "tx_errors"):
        counter = INTERFACES / patient.spindle_port / "statistics" / name
        if patient.spindle_port and counter.is_file():
            yield Check(f"spindle: {name} of {patient.spindle_port}", counter.read_text().strip(), "",
                        "told, not required", True)  # fmt: skip


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
        yield at_most("spindle: answers lost", max(0.0, lost), 100.0 * LOST_SHARE, "%", _WIRE)


def _silence(patient: Patient, spindle: Spindle, speed_rpm: float) -> Iterator[Check]:
    """The host says nothing: the drive must have stopped driving by itself, where it says that it does."""
    if math.isinf(spindle.heartbeat_s):
        yield Check("spindle: watches the host", "no", "", "told, not required; only the supervisor stops it", True)
        return
    spindle.start(speed_rpm)
    spindle.wait_until_at_speed(timeout_s=10.0)
    clock, silent_s = patient.clock, patient.clock.now_s()
    most_s = 3.0 * spindle.heartbeat_s + patient.limits.spindle_stop_s
    stood_s, advice = math.inf, "the drive does not mind a silent host: set its heartbeat consumer (1016h) and 6007h"
    while clock.now_s() - silent_s < most_s:
        speed_rpm_now = spindle.speed_unheard_rpm()
        if speed_rpm_now is None:
            clock.sleep_s(most_s)
        elif abs(speed_rpm_now) < STANDS_RPM:
            stood_s = clock.now_s() - silent_s
            break
        clock.sleep_s(REPORT_EVERY_S)
    share = abs(spindle.status().speed_rpm) / speed_rpm * 100.0
    spindle.stop()
    yield at_most("spindle: speed after host silence", share, 50.0, "%", advice)
    if math.isfinite(stood_s):
        limit_s = spindle.heartbeat_s + patient.limits.spindle_stop_s
        yield at_most("spindle: host silence to standstill", stood_s, limit_s, "s", advice)
