"""The computer that mills: room and speed of its disk, its clock, what else it does, and what it may ask for."""

import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryFile

from doctor.check import Check, Patient, at_least, at_most, percentile

_SYNCS = 20
_NAPS = 50
_NAP_S = 0.004


def examine(patient: Patient) -> Iterator[Check]:
    """Nothing of it moves anything."""
    yield at_least(
        "computer: free disk", patient.free_disk_mb(), patient.limits.free_disk_mb, "MB",
        "make room where records go, or give --record another disk",
    )  # fmt: skip
    yield at_most("computer: write to disk, p99", percentile(_sync_ms(), 0.99), 200.0, "ms", "use a faster disk")
    naps = _late_ms()
    yield at_most("computer: wakes up late, p99", percentile(naps, 0.99), 50.0, "ms", "end what else runs")
    # What the load does to the loop is how late it wakes up; the figure itself is for whoever wonders why.
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    yield Check("computer: load per core", load, "", "told, not required", True)
    drift_ms = _drift_ms()
    yield at_most("computer: clock against boot time", drift_ms, 1.0, "ms", "the computer slept, or its clock jumps")
    yield Check("computer: real-time priority", _real_time(), "", "told, not required", True)


def _sync_ms() -> list[float]:
    """Appending an event to a record, on the disk."""
    took = []
    with TemporaryFile(dir=Path.cwd() if os.access(Path.cwd(), os.W_OK) else None) as file:
        for _ in range(_SYNCS):
            began_s = time.perf_counter()
            file.write(b"x" * 512)
            file.flush()
            os.fdatasync(file.fileno())
            took.append(1e3 * (time.perf_counter() - began_s))
    return took


def _late_ms() -> list[float]:
    late = []
    for _ in range(_NAPS):
        began_s = time.perf_counter()
        time.sleep(_NAP_S)
        late.append(1e3 * (time.perf_counter() - began_s - _NAP_S))
    return late


def _drift_ms() -> float:
    """How differently two of the kernel's clocks run over a tenth of a second."""
    before = time.clock_gettime(time.CLOCK_MONOTONIC), time.clock_gettime(time.CLOCK_BOOTTIME)
    time.sleep(0.1)
    after = time.clock_gettime(time.CLOCK_MONOTONIC), time.clock_gettime(time.CLOCK_BOOTTIME)
    return 1e3 * abs((after[0] - before[0]) - (after[1] - before[1]))


def _real_time() -> str:
    """What the supervisor may ask of the scheduler."""
    if os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] > 0:
        return "permitted"
    return "not permitted: `@users - rtprio 20` in /etc/security/limits.conf lets the supervisor wake up at once"
