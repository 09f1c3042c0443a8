"""Stops the motion when the process that mills falls silent. Run by its path, as a process of its own.

    python -I -S supervisor.py FD SILENCE_S SCRIPT [WIRE ONWARD PATTERN]

FD is the motion port, open; SCRIPT is JSON, pairs of hex bytes and of seconds to wait after them; SILENCE_S is how long
an armed supervisor waits for a sign of life. WIRE is another device's port, which is read here, ONWARD the socket on
which every byte goes on to the process that mills, PATTERN (hex) what an alarm looks like. On stdin come lines:

    A  watch from now on      . TIME  a sign of life      D  watch no more      !  stop now      Q  leave

TIME is the sender's, in seconds since boot, sleep included: a supervisor that was itself kept waiting finds beats in
the pipe that were given in time, and a computer that slept finds that they were not.

It stops the motion when it is told to, when it is armed and the pipe ends, when it is armed and nothing comes, or when
it is armed and a device cries out. It does so once: it writes the script, says why on stdout after its first bytes,
and leaves. It never resumes anything.

Standard library only, and nothing of mill: it must start fast, share no interpreter with a network, and be readable.
"""

import contextlib
import gc
import json
import os
import re
import select
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

ARM, DISARM, BEAT, STOP, LEAVE = b"A", b"D", b".", b"!", b"Q"
STDIN, STDOUT = 0, 1
TAKES_NOTHING_S = 0.05
"""A port that takes no byte for so long is given up; the spindle's drive stops by itself."""
REAL_TIME = 10
ALARM = "alarm"
"""Stands before what a device said, in hex, where that is why."""
CHUNK = 4096
LONGEST_ALARM = 64


def now_s() -> float:
    """Seconds since boot; what is slept through counts."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Tap:
    """Reads a device's wire in place of the process that mills, which gets every byte, and knows an alarm."""

    def __init__(self, wire: int, onward: int, pattern: bytes) -> None:
        """``pattern`` is a regular expression of at most ``LONGEST_ALARM`` bytes."""
        self.wire = wire
        self._onward = onward
        self._pattern = re.compile(pattern)
        self._before = b""
        """The newest bytes that came before: an alarm may come in pieces."""

    def read(self) -> bytes:
        """What has come; nothing once the wire is gone."""
        try:
            return os.read(self.wire, CHUNK)
        except OSError:
            return b""

    def alarm_in(self, data: bytes) -> bytes:
        """The alarm that ends in these bytes, if one does."""
        heard = self._before + data
        self._before = heard[-LONGEST_ALARM:]
        for found in self._pattern.finditer(heard):
            if found.end() > len(heard) - len(data):
                return found[0]
        return b""

    def hand_on(self, data: bytes) -> None:
        """To the process that mills; one that does not read loses it, and finds gaps where it listens again."""
        with contextlib.suppress(OSError):
            os.write(self._onward, data)

    def close(self) -> None:
        """Who mills reads the wire itself from now on, and hears from it what is wrong with it."""
        os.close(self._onward)


def watch(port: int, silence_s: float, script: Sequence[tuple[bytes, float]], tap: Tap | None = None) -> str:
    """Watch until it must stop the motion, or may leave; the reason, empty where it left in peace."""
    armed, heard_s, rest = False, now_s(), b""
    while True:
        left_s = heard_s + silence_s - now_s()
        listened = [STDIN] if tap is None else [STDIN, tap.wire]
        ready = select.select(listened, [], [], max(0.0, left_s) if armed else None)[0]
        # A wire that is never silent must not hide that the process that mills is.
        if not ready or (armed and STDIN not in ready and now_s() - heard_s >= silence_s):
            return _stop(port, script, _silent(now_s() - heard_s))
        if tap is not None and tap.wire in ready and STDIN not in ready:
            data = tap.read()
            alarm = tap.alarm_in(data)
            if armed and alarm:
                return _stop(port, script, f"{ALARM} {alarm.hex()}", partial(tap.hand_on, data))
            tap.hand_on(data)
            if not data:
                tap.close()
                tap = None
        # What the process that mills said comes first: it may just have disarmed.
        if STDIN not in ready:
            continue
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


def _stop(port: int, script: Sequence[tuple[bytes, float]], why: str, held: Callable[[], None] = lambda: None) -> str:
    for number, (data, wait_s) in enumerate(script):
        if not _put(port, data):
            why = f"{why}; the port took no bytes"
            break
        if number == 0:
            # Once the hold is on the wire: who mills must hear it before it wonders what its controller does.
            _tell(why)
            held()
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
    tap = Tap(int(sys.argv[4]), int(sys.argv[5]), bytes.fromhex(sys.argv[6])) if len(sys.argv) > 4 else None
    watch(port, silence_s, script, tap)


if __name__ == "__main__":
    main()
