"""Stops the motion when the process that mills falls silent. Run by its path, as a process of its own.

    python -I -S supervisor.py FD SILENCE_S SCRIPT

FD is the motion port, open; SCRIPT is JSON, pairs of hex bytes and of seconds to wait after them; SILENCE_S is how long
an armed supervisor waits for a sign of life. On stdin come single bytes:

    A  watch from now on      .  a sign of life      D  watch no more      !  stop now      Q  leave

It stops the motion when it is told to, when it is armed and the pipe ends, or when it is armed and nothing comes. It
does so once: it writes the script, says why on stdout, and leaves. It never starts or resumes anything.

Standard library only, and nothing of mill: it must start fast, share no interpreter with a network, and be readable.
"""

import contextlib
import gc
import json
import os
import select
import sys
import time
from collections.abc import Sequence

ARM, DISARM, BEAT, STOP, LEAVE = b"A", b"D", b".", b"!", b"Q"
STDIN, STDOUT = 0, 1
TAKES_NOTHING_S = 0.05
"""A port that takes no byte for so long is given up; the spindle's drive stops by itself."""
REAL_TIME = 10


def watch(port: int, silence_s: float, script: Sequence[tuple[bytes, float]]) -> str:
    """Watch until it must stop the motion, or may leave; the reason, empty where it left in peace."""
    armed, heard_s = False, time.monotonic()
    while True:
        left_s = heard_s + silence_s - time.monotonic() if armed else None
        ready = select.select([STDIN], [], [], None if left_s is None else max(0.0, left_s))[0]
        if not ready:
            return _stop(port, script, f"no sign of life for {time.monotonic() - heard_s:.3f} s")
        said = os.read(STDIN, 4096)
        if not said:
            return _stop(port, script, "the process that mills is gone") if armed else ""
        # A sign of life that comes too late is none, however many came with it.
        silent_s = time.monotonic() - heard_s
        if armed and silent_s > silence_s:
            return _stop(port, script, f"no sign of life for {silent_s:.3f} s")
        if STOP in said:
            return _stop(port, script, "told to stop")
        if LEAVE in said:
            return ""
        armed = _armed(armed, said)
        heard_s = time.monotonic()


def _armed(before: bool, said: bytes) -> bool:
    """As the last of these bytes leaves it."""
    last = max(said.rfind(ARM), said.rfind(DISARM))
    return before if last < 0 else said[last : last + 1] == ARM


def _stop(port: int, script: Sequence[tuple[bytes, float]], why: str) -> str:
    for data, wait_s in script:
        if not _put(port, data):
            return f"{why}; the port took no bytes"
        time.sleep(wait_s)
    return why


def _put(port: int, data: bytes) -> bool:
    while data:
        try:
            data = data[os.write(port, data) :]
        except BlockingIOError:
            if not select.select([], [port], [], TAKES_NOTHING_S)[1]:
                return False
        except OSError:
            return False
    return True


def main() -> None:
    """Read the arguments, ask the kernel for a good place in its queue, and watch."""
    port, silence_s = int(sys.argv[1]), float(sys.argv[2])
    script = [(bytes.fromhex(data), float(wait_s)) for data, wait_s in json.loads(sys.argv[3])]
    gc.disable()
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME))
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, -REAL_TIME)
    os.write(STDOUT, b"watching\n")
    if why := watch(port, silence_s, script):
        with contextlib.suppress(OSError):
            os.write(STDOUT, why.encode())


if __name__ == "__main__":
    main()
