"""Other programs that want every core, beside the one that mills."""

import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from firmware_sim.faults import Fault


@contextmanager
def hogs(faults: Sequence[Fault]) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """The programs of ``host.hog``, from the command's start or so long after it, until the with-statement ends."""
    busy: list[subprocess.Popen[bytes]] = []
    ended = threading.Lock()

    def start(count: int) -> None:
        with ended:
            busy.extend(subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count))

    timers = [
        threading.Timer(fault.after_s or 0.0, start, [round(fault.value)])
        for fault in faults
        if fault.name == "host.hog"
    ]
    for timer in timers:
        timer.daemon = True
        timer.start()
    try:
        yield busy
    finally:
        for timer in timers:
            timer.cancel()
            timer.join()
        with ended:
            for process in busy:
                process.kill()
                process.wait()
