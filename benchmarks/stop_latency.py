"""How long the supervisor takes from an alarm to the stop on the wire, idle and beside processes that want every core.

    python -m benchmarks.stop_latency --alarms 2000 --hogs 6 --json FILE

The alarm is the drive's EMCY frame as an SLCAN adapter puts it on its wire (a pty), read by the supervisor, which hands
every byte on; the stop is the first byte at the far end of the motion's wire. ``told`` is the same for an alarm that
comes by the supervisor's pipe, as from a button. Each alarm takes a fresh supervisor, since one stops once. Beside it
stands what an alarm takes when a thread of a busy interpreter is to write the stop itself: the ratio says what the
process buys.
What is timed includes this program's own waking up, which the load delays as well: it is an upper bound.
"""

import argparse
import contextlib
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
from pathlib import Path
from typing import Final

import numpy as np

from drivers.clock import SystemClock
from drivers.motion.interface import StopPath
from drivers.motion.serial_line import PortLine, open_serial
from drivers.spindle.canbus import SLCAN_BAUD, SlcanBus
from drivers.spindle.interface import AlarmPath
from milling.guard import Guard

SCRIPT: Final = ((b"!", 0.0),)
SILENCE_S: Final = 60.0
_PATIENCE_S: Final = 10.0
BITRATE: Final = 1_000_000
NODE_ID: Final = 1
HEARTBEAT: Final = b"t701105\r"
EMERGENCY: Final = b"t08181023010000000000\r"
"""Continuous over-current at the output, CiA 402 0x2310; a frame of 8 bytes with an empty maker's field."""


def measure(alarms: int, hogs: int) -> dict[str, float]:
    """Latencies in ms: percentiles of the supervisor's, and the same of a thread beside a busy one."""
    far, near = pty.openpty()
    adapter, drives = pty.openpty()
    tty.setraw(near)
    tty.setraw(drives)
    try:
        with contextlib.closing(open_serial(os.ttyname(drives), SLCAN_BAUD)) as line:
            bus = SlcanBus(line, BITRATE)
            alarm = bus.alarm_path(NODE_ID)
            assert alarm is not None
            with _load(hogs):
                cried = [_cried(near, far, adapter, line, alarm) for _ in range(alarms)]
                told = [_told(near, far) for _ in range(max(20, alarms // 20))]
                shared = [_shared(near, far) for _ in range(max(20, alarms // 20))]
            bus.shutdown()
    finally:
        for end in (near, far, drives, adapter):
            os.close(end)
    figures = {"alarms": float(alarms), "hogs": float(hogs)}
    for name, values in (("supervisor", cried), ("told", told), ("shared_interpreter", shared)):
        for label, percent in (("p50", 50), ("p99", 99), ("max", 100)):
            figures[f"{name}_{label}_ms"] = float(np.percentile(values, percent))
    figures["p99_ratio"] = figures["shared_interpreter_p99_ms"] / figures["supervisor_p99_ms"]
    return figures


def _cried(near: int, far: int, adapter: int, line: PortLine, alarm: AlarmPath) -> float:
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=SILENCE_S, alarm=alarm) as guard:
        guard.arm()
        # What is handed on after it was told to arm says that it is armed.
        os.write(adapter, HEARTBEAT)
        if line.read(_PATIENCE_S) != HEARTBEAT:
            raise TimeoutError("the supervisor hands nothing on")
        started_s = time.monotonic()
        os.write(adapter, EMERGENCY)
        return _until_stop(far, started_s)


def _told(near: int, far: int) -> float:
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


@contextlib.contextmanager
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
