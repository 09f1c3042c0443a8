"""Stops the motion when the process that mills falls silent. Run by its path, as a process of its own.

    python -I -S supervisor.py FD SILENCE_S SCRIPT

FD is the motion port, open; SCRIPT is JSON, pairs of hex bytes and of seconds to wait after them; SILENCE_S is how long
an armed supervisor waits for a sign of life. On stdin come lines:

    A  watch from now on      . TIME  a sign of life      D  watch no more      !  stop now      Q  leave

TIME is the sender's, in seconds since boot, sleep included: a supervisor that was itself kept waiting finds beats in
the pipe that were given in time, and a computer that slept finds that they were not.

It stops the motion when it is told to, when it is armed and the pipe ends, or when it is armed and nothing comes. It
does so once: it writes the script, says why on stdout after its first bytes, and leaves. It never resumes anything.

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


def now_s() -> float:
    """Seconds since boot; what is slept through counts."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def watch(port: int, silence_s: float, script: Sequence[tuple[bytes, float]]) -> str:
    """Watch until it must stop the motion, or may leave; the reason, empty where it left in peace."""
    armed, heard_s, rest = False, now_s(), b""
    while True:
        left_s = heard_s + silence_s - now_s()
        if not select.select([STDIN], [], [], max(0.0, left_s) if armed else None)[0]:
            return _stop(port, script, _silent(now_s() - heard_s))
        said = os.read(STDIN, 4096)
        if not said:
            return _stop(port, script, "the process that mills is gone") if armed else ""
        *lines, rest = (rest + said).split(b"\n")
        for line in lines:
            if line == STOP:
                return _stop(port, script, "told to stop")
            if line == LEAVE:
                return ""
            if line in (ARM, DISARM):
                armed, heard_s = line == ARM, now_s()
            elif line[:1] == BEAT:
                given_s = float(line[1:])
                if armed and given_s - heard_s > silence_s:
                    return _stop(port, script, _silent(given_s - heard_s))
                heard_s = max(heard_s, given_s)


def _silent(silent_s: float) -> str:
    return f"no sign of life for {silent_s:.3f} s"


def _stop(port: int, script: Sequence[tuple[bytes, float]], why: str) -> str:
    for number, (data, wait_s) in enumerate(script):
        if not _put(port, data):
            why = f"{why}; the port took no bytes"
            break
        if number == 0:
            # Once the hold is on the wire: who mills must hear it before it wonders what its controller does.
            _tell(why)
        time.sleep(wait_s)
    else:
        return why
    _tell(why)
    return why


def _tell(why: str) -> None:
    with contextlib.suppress(OSError):
        os.write(STDOUT, why.encode() + b"\n")


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
    watch(port, silence_s, script)


if __name__ == "__main__":
    main()
