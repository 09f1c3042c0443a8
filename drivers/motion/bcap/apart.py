"""Feeds a robot from a process of its own, so that whoever mills may look through cameras meanwhile.

    python -m drivers.motion.bcap.apart SOCKET LOCK REQUESTS STOPS ARGUMENTS

SOCKET is the way to the controller, LOCK its lock, both open; ARGUMENTS is JSON. On REQUESTS, a socket, come pickled
``(number, verb, arguments)``, each answered by ``(number, value or error, datagrams)``. On STOPS, a pipe, come single
bytes, which are obeyed before anything else and within any wait:

    h  hold      !  halt      s  hold, and take no move      ^  drop what is queued, lift the tip, then halt

The last two are a supervisor's. When whoever asks is gone, or this process fails, the arm slows down to standstill; for
a moment a supervisor may still have it lifted. Then the motor is switched off. What was queued before is all that an
arm whose owner hangs can still do.

The standard library and this driver, and nothing of mill beside it: it shares no interpreter with a network.
"""

import contextlib
import gc
import json
import os
import select
import signal
import socket
import sys
from multiprocessing.connection import Connection
from typing import Any

from drivers.clock import SystemClock
from drivers.errors import ConnectionLostError, DeviceError, DeviceFaultError, MillError
from drivers.lock import DeviceLock
from drivers.motion.bcap.driver import BcapController
from drivers.motion.interface import Travel
from drivers.motion.udp_line import UdpLine

HOLD, HALT, STOP, LIFT = b"h", b"!", b"s", b"^"
LIFT_MM, LIFT_FEED_MM_PER_S = 1.5, 15.0
LIFTED_S = 1.5
"""Longer than that no lift is waited for."""
REAL_TIME = 10
_FEED_S = 0.001
_MOST_NOTES = 20_000
"""Of datagrams that nobody has fetched yet."""
OPEN = -1
"""The number of the answer that comes unasked, once the controller is open."""

Note = tuple[float, str, bytes]
"""When, "out" or "in", and the datagram."""


class Apart:
    """One controller, and who may stop it. It is a ``DatagramLine`` itself, of which a read hears the stops as well."""

    def __init__(self, line: UdpLine, stops: int, *, last_words_s: float, noted: bool) -> None:
        """``last_words_s`` is how long a supervisor may still speak when whoever asks is gone."""
        self._line = line
        self._stops: int | None = stops
        self._last_words_s = last_words_s
        self._noted = noted
        self._clock = SystemClock()
        self._notes: list[Note] = []
        self._stopped = False
        """By a supervisor that has not had it lifted yet; a hold alone is forgotten with the path that it holds."""
        self._lift_asked = self._lifting = False
        self.name = line.name
        self.descriptor = None
        self.controller: BcapController | None = None

    def write(self, data: bytes) -> None:
        """One datagram."""
        self._line.write(data)
        self._note("out", data)

    def read(self, timeout_s: float) -> bytes:
        """One datagram; who wants to stop is heard meanwhile."""
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            self._hear(self._line.fileno(), max(0.0, deadline_s - self._clock.now_s()))
            data = self._line.read(0.0)
            if data:
                self._note("in", data)
            if data or self._clock.now_s() >= deadline_s:
                return data

    def close(self) -> None:
        """Give socket and lock back."""
        self._line.close()

    def open(self, requests: Connection, about: dict[str, Any]) -> bool:
        """Open the controller and say so; whether that went well."""
        try:
            self.controller = BcapController(
                self,
                self._clock,
                origin_mm=tuple(about["origin_mm"]),
                orientation_deg=tuple(about["orientation_deg"]),
                travel=Travel(tuple(about["low_mm"]), tuple(about["high_mm"])),
                max_feed_mm_per_s=about["max_feed_mm_per_s"],
                reply_s=about["reply_s"],
            )
        except MillError as error:
            requests.send((OPEN, error, self._fetched()))
            return False
        requests.send((OPEN, None, self._fetched()))
        return True

    def serve(self, requests: Connection) -> None:
        """Feed, obey, answer; until whoever asks closes the controller, or is gone."""
        controller = self.controller
        assert controller is not None
        closed = False
        while not closed:
            if self._hear(requests.fileno(), _FEED_S if controller.is_fed else None):
                try:
                    number, verb, arguments = requests.recv()
                except (EOFError, OSError):
                    return
                # What was written into the other pipe before this is heard before this.
                self._hear(None, 0.0)
                answer = self._carried_out(controller, verb, arguments)
                closed = verb == "close"
                with contextlib.suppress(OSError):
                    requests.send((number, answer, self._fetched()))
            controller.feed()
            self._lift_if_asked(controller)

    def abandoned(self) -> None:
        """Whoever asked is gone: to a standstill, and for a moment hear what a supervisor says."""
        controller = self.controller
        assert controller is not None
        controller.hold()
        until_s = self._clock.now_s() + self._last_words_s
        try:
            while self._stops is not None and self._clock.now_s() < until_s:
                self._hear(None, _FEED_S)
                controller.feed()
                self._lift_if_asked(controller)
        finally:
            with contextlib.suppress(DeviceError):
                controller.close()

    def _hear(self, other: int | None, timeout_s: float | None) -> bool:
        """Wait for the other descriptor, and obey who wants to stop; whether there is something of the other."""
        readable = select.select([each for each in (self._stops, other) if each is not None], [], [], timeout_s)[0]
        if self._stops in readable:
            said = os.read(self._stops, 64)
            if not said:
                # A pipe that has ended is readable for ever.
                self._stops = None
            for word in (said[index : index + 1] for index in range(len(said))):
                self._obey(word)
        return other in readable

    def _obey(self, word: bytes) -> None:
        controller = self.controller
        if controller is None:
            return
        if word == HALT:
            controller.halt()
        elif not self._lifting:
            controller.hold()
            self._stopped |= word in (STOP, LIFT)
            self._lift_asked |= word == LIFT

    def _lift_if_asked(self, controller: BcapController) -> None:
        if self._lift_asked:
            # On the way up only a halt is heard.
            self._lift_asked, self._lifting = False, True
            with contextlib.suppress(MillError):
                x, y, z = controller.flush().position_mm
                up_mm = (x, y, min(z + LIFT_MM, controller.travel.high_mm[2]))
                controller.start_move(up_mm, feed_mm_per_s=LIFT_FEED_MM_PER_S)
                controller.wait_until_idle(LIFTED_S)
            # Whoever asks may live after all, and must not go on as if nothing had been.
            with contextlib.suppress(DeviceError):
                controller.halt()
            self._stopped = self._lifting = False

    def _carried_out(self, controller: BcapController, verb: str, arguments: dict[str, Any]) -> Any:
        if self._stopped and verb in ("start_move", "resume"):
            return DeviceFaultError(
                f"{self.name}: a supervisor is stopping the arm; position kept; home() once it has lifted the tip"
            )
        try:
            told = getattr(controller, verb)
            return told(**arguments) if callable(told) else told
        except MillError as error:
            return error

    def _note(self, kind: str, data: bytes) -> None:
        if self._noted and len(self._notes) < _MOST_NOTES:
            self._notes.append((self._clock.now_s(), kind, data))

    def _fetched(self) -> list[Note]:
        notes, self._notes = self._notes, []
        return notes


def main() -> None:
    """Take over socket, lock and pipes, ask the kernel for a good place in its queue, and serve."""
    sock, lock, requests, stops = (int(word) for word in sys.argv[1:5])
    about = json.loads(sys.argv[5])
    # Only who asks ends this process in peace; Ctrl-C at the terminal is for that one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME))
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, -REAL_TIME)
    held = DeviceLock.inherited(lock)
    line = UdpLine(about["host"], about["port"], socket.socket(fileno=sock), held)
    asked = Connection(requests)
    apart = Apart(line, stops, last_words_s=about["last_words_s"], noted=about["noted"])
    if not apart.open(asked, about):
        return
    gc.collect()
    gc.freeze()
    with contextlib.suppress(ConnectionLostError):
        try:
            apart.serve(asked)
        finally:
            if not line.is_closed:
                with contextlib.suppress(OSError):
                    held.sign("the end of a mill command that is gone")
                apart.abandoned()


if __name__ == "__main__":
    main()
