"""The near end of the supervisor: starts it, gives it signs of life, and hears whether it has stopped the motion."""

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
from types import TracebackType
from typing import Self

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.motion.interface import StopPath
from drivers.spindle.interface import AlarmPath
from milling import supervisor

SILENCE_S = 0.55
BEAT_EVERY_S = 0.01
START_S = 5.0
LEAVE_S = 2.0


class Guard:
    """One supervisor process. Open from construction; ``close`` lets it leave in peace."""

    def __init__(
        self, path: StopPath, clock: Clock, *, silence_s: float = SILENCE_S, alarm: AlarmPath | None = None
    ) -> None:
        """Start the process and see it watch.

        Args:
            path: the motion controller's.
            clock: for the rhythm of the signs of life.
            silence_s: how long the supervisor waits for one.
            alarm: the spindle's; its wire is read by the supervisor from now on, which stops the motion at an alarm.

        Raises:
            DeviceTimeoutError: it does not start.
        """
        self._clock = clock
        self._said = b""
        self._beat_at_s = float("-inf")
        script = json.dumps([(data.hex(), wait_s) for data, wait_s in path.script])
        words = [sys.executable, "-I", "-S", supervisor.__file__, str(path.fd), str(silence_s), script]
        passed = [path.fd]
        self._alarm = alarm
        near, far = socket.socketpair()
        far.setblocking(False)
        if alarm is not None:
            words += [str(alarm.fd), str(far.fileno()), alarm.pattern.hex()]
            passed += [alarm.fd, far.fileno()]
        hears, self._to = os.pipe()
        self._from, says = os.pipe()
        os.set_blocking(self._to, False)
        self._closed = False
        try:
            # A session of its own: what Ctrl-C does to this process must not reach that one.
            self._process = subprocess.Popen(words, stdin=hears, stdout=says, pass_fds=passed, start_new_session=True)
        except BaseException:
            near.close()
            os.close(self._to)
            os.close(self._from)
            raise
        finally:
            far.close()
            os.close(hears)
            os.close(says)
        self._systemd = _systemd()
        if not select.select([self._from], [], [], START_S)[0] or not os.read(self._from, 64):
            self.close()
            near.close()
            raise DeviceTimeoutError(f"supervisor: did not start within {START_S:g} s; is the machine overloaded?")
        if alarm is None:
            near.close()
        else:
            # Once it ends, whyever, the wire is read directly again.
            alarm.read_through(near.detach())

    @property
    def process_id(self) -> int:
        """Of the supervisor."""
        return self._process.pid

    @property
    def stop_end(self) -> int:
        """The pipe's end into which ``supervisor.STOP`` and a newline stop the motion, for a process that may do so.

        While that process keeps it open the supervisor learns of a killed run from its silence, and not at once.
        """
        return self._to

    def arm(self) -> None:
        """From now on silence stops the motion."""
        self._say(supervisor.ARM)

    def disarm(self) -> None:
        """From now on silence is allowed: the drill is out of the bone."""
        self._say(supervisor.DISARM)

    def beat(self) -> None:
        """A sign of life, not more often than needed.

        Raises:
            DeviceError: the supervisor has stopped the motion, or is gone itself.
        """
        now_s = self._clock.now_s()
        if now_s - self._beat_at_s >= BEAT_EVERY_S:
            self._beat_at_s = now_s
            self._say(b"%s%.6f" % (supervisor.BEAT, supervisor.now_s()))
            if self._systemd is not None:
                with contextlib.suppress(OSError):
                    self._systemd.send(b"WATCHDOG=1")

    def stopped(self) -> str | None:
        """Why the supervisor has ended, once its script is over; None while it watches, and where it left in peace."""
        if self._closed:
            return self._last_words() if self._said else None
        return self._last_words() if select.select([self._from], [], [], 0.0)[0] else None

    def stop(self) -> None:
        """Let the supervisor stop the motion, whatever this process is doing. From any thread; never waits."""
        with contextlib.suppress(OSError):
            os.write(self._to, supervisor.STOP + b"\n")

    def close(self) -> None:
        """Let it leave; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(OSError):
            os.write(self._to, supervisor.DISARM + b"\n" + supervisor.LEAVE + b"\n")
        os.close(self._to)
        try:
            self._process.wait(LEAVE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        # It may have been told to stop just before it was told to leave.
        self._hear_it_out()
        os.close(self._from)
        if self._systemd is not None:
            self._systemd.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _say(self, word: bytes) -> None:
        try:
            os.write(self._to, word + b"\n")
        except BlockingIOError as error:
            raise DeviceError("supervisor: its process has not read for half a minute; end what stopped it") from error
        except OSError as error:
            raise DeviceError(f"supervisor: {self._last_words()}") from error
        if select.select([self._from], [], [], 0.0)[0]:
            raise DeviceError(f"supervisor: {self._last_words()}")

    def _last_words(self) -> str:
        """Why it has ended; its script is over then, so that nobody stops the motion twice at the same time."""
        if not self._closed:
            self._hear_it_out()
        if self._said:
            why = self._said.decode(errors="replace").splitlines()[0]
            name, _, heard = why.partition(" ")
            if self._alarm is not None and name == supervisor.ALARM:
                why = self._alarm.words(bytes.fromhex(heard))
            return f"it has stopped the motion: {why}"
        return "its process has ended; end what ended it, and start the run again"

    def _hear_it_out(self) -> None:
        while select.select([self._from], [], [], LEAVE_S)[0] and (more := os.read(self._from, 4096)):
            self._said += more


def _systemd() -> socket.socket | None:
    """Where systemd waits for signs of life, if this process runs under its watchdog (sd_notify(3))."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address or "WATCHDOG_USEC" not in os.environ:
        return None
    found = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        found.connect("\0" + address[1:] if address.startswith("@") else address)
    except OSError:
        found.close()
        return None
    return found
