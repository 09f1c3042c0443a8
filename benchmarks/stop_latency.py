"""How long the supervisor takes from an alarm to the stop on the wire, idle and beside processes that want every core.

    python -m benchmarks.stop_latency --alarms 2000 --hogs 6 --json FILE

The alarm is a byte on the supervisor's pipe, as any thread of the process that mills may write it; the stop is the
first byte at the far end of a pty. Each alarm takes a fresh supervisor, since one stops once. Beside it stands what the
same alarm takes when a thread of a busy interpreter is to write the stop itself: the ratio says what the process buys.
What is timed includes this program's own waking up, which the load delays as well: it is an upper bound.
"""

import argparse
import json
import os
import pty
import select
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from drivers.clock import SystemClock
from drivers.motion.interface import StopPath
from milling.guard import Guard

SCRIPT: Final = ((b"!", 0.0),)
SILENCE_S: Final = 60.0
_PATIENCE_S: Final = 10.0


def measure(alarms: int, hogs: int) -> dict[str, float]:
    """Latencies in ms: percentiles of the supervisor's, and the same of a thread beside a busy one."""
    far, near = pty.openpty()
    tty.setraw(near)
    try:
        with _load(hogs):
            ours = [_supervised(near, far) for _ in range(alarms)]
            shared = [_shared(near, far) for _ in range(max(20, alarms // 20))]
    finally:
        os.close(near)
        os.close(far)
    figures = {"alarms": float(alarms), "hogs": float(hogs)}
    for name, values in (("supervisor", ours), ("shared_interpreter", shared)):
        for label, percent in (("p50", 50), ("p99", 99), ("max", 100)):
            figures[f"{name}_{label}_ms"] = float(np.percentile(values, percent))
    figures["p99_ratio"] = figures["shared_interpreter_p99_ms"] / figures["supervisor_p99_ms"]
    return figures


def _supervised(near: int, far: int) -> float:
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=SILENCE_S) as guard:
        guard.arm()
        started_s = time.monotonic()
        guard.stop()
        return _until_stop(far, started_s)


def _shared(near: int, far: int) -> float:
    """The same alarm to a thread that shares its interpreter with one that computes."""
    hears, says = os.pipe()
    ending = threading.Event()

    def stop() -> None:
        os.read(hears, 1)
        os.write(near, b"!")

    def compute() -> None:
        while not ending.is_set():
            sum(range(20_000))

    threads = [threading.Thread(target=stop), *(threading.Thread(target=compute) for _ in range(2))]
    for thread in threads:
        thread.start()
    try:
        started_s = time.monotonic()
        os.write(says, b"!")
        return _until_stop(far, started_s)
    finally:
        ending.set()
        for thread in threads:
            thread.join()
        os.close(hears)
        os.close(says)


def _until_stop(far: int, started_s: float) -> float:
    if not select.select([far], [], [], _PATIENCE_S)[0]:
        raise TimeoutError(f"no stop on the wire within {_PATIENCE_S:g} s")
    elapsed_s = time.monotonic() - started_s
    os.read(far, 16)
    return 1000.0 * elapsed_s


@contextmanager
def _load(hogs: int) -> Iterator[None]:
    """So many processes that compute and never wait."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(hogs)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def main(words: Sequence[str] | None = None) -> None:
    """Print the figures, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--alarms", type=int, default=2000)
    parser.add_argument("--hogs", type=int, default=6)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(words)
    figures = measure(given.alarms, given.hogs)
    for name, value in figures.items():
        print(f"{name}: {value:.4g}")
    if given.json:
        given.json.write_text(json.dumps({"command": "stop latency", **figures}), encoding="utf-8")


if __name__ == "__main__":
    main()
