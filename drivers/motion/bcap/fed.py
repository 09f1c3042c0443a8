"""A DENSO robot that a process of its own feeds (``drivers.motion.bcap.apart``): the near end.

Every call but a stop is a question to that process and takes a millisecond or two. ``hold`` and ``halt`` write one byte
into a pipe that is heard within any wait over there; so does a supervisor, by ``stop_path``.
"""

import contextlib
import itertools
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from drivers.clock import Clock
from drivers.errors import ConnectionLostError, DeviceTimeoutError, MillError
from drivers.lock import DeviceLock, udp_device
from drivers.motion.bcap import apart
from drivers.motion.bcap.path import PERIOD_S
from drivers.motion.interface import MotionController, MotionState, MotionStatus, StopPath, Travel, Vector
from drivers.motion.udp_line import connected

ANSWER_S = 60.0
"""Longer than anything takes: over there every wait has a limit of its own."""
LEAVE_S = 5.0
HELD_S = 0.2
"""From the first word of a supervisor to its second: the arm has slowed down by then."""
SPARE_S = 0.3
"""For processes that are run late."""
Noted = Callable[[float, str, bytes], None]
"""Takes a datagram: when it passed, "out" or "in", and its bytes."""


class FedRobot(MotionController):
    """As ``BcapController``, on the machine's own clock."""

    def __init__(
        self,
        host: str,
        port: int,
        clock: Clock,
        *,
        origin_mm: Vector,
        orientation_deg: Vector,
        travel: Travel,
        max_feed_mm_per_s: float,
        reply_s: float,
        silence_s: float,
        noted: Noted | None = None,
    ) -> None:
        """Start the process and have it open the controller.

        ``noted`` is told every datagram, with the answer to the next question; ``silence_s`` is how long a supervisor
        waits for a sign of life before it stops the arm; the rest is as for ``BcapController``.

        Raises:
            DeviceBusyError: another process, which the message names, speaks to that controller.
            ConnectionLostError: no such host, or the process does not start.
            ConfigError, DeviceError: as ``BcapController``.
        """
        self._name = f"udp:{host}:{port}"
        self._clock = clock
        self._noted = noted
        self._numbers = itertools.count()
        self._asking = threading.Lock()
        about = {
            "host": host, "port": port, "origin_mm": origin_mm, "orientation_deg": orientation_deg,
            "low_mm": travel.low_mm, "high_mm": travel.high_mm, "max_feed_mm_per_s": max_feed_mm_per_s,
            "reply_s": reply_s, "last_words_s": silence_s + HELD_S + SPARE_S, "noted": noted is not None,
        }  # fmt: skip
        self._closed = False
        self._lost = False
        lock = DeviceLock(udp_device(host, port))
        try:
            with connected(host, port) as sock:
                self._start(sock, lock, json.dumps(about))
        except BaseException:
            lock.release()
            raise
        lock.hand_over()
        try:
            self._answer_to(apart.OPEN)
            self._identity = str(self._ask("identity"))
            self._dead_time_s = float(self._ask("dead_time_s"))
        except BaseException:
            self._end()
            raise

    def _start(self, sock: socket.socket, lock: DeviceLock, about: str) -> None:
        near, far = socket.socketpair()
        hears, self._stops = os.pipe()
        os.set_blocking(self._stops, False)
        handed = [sock.fileno(), lock.fileno(), far.fileno(), hears]
        words = [sys.executable, "-m", apart.__name__, *map(str, handed), about]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        try:
            # A session of its own: what Ctrl-C does to this process must not reach that one.
            self._process = subprocess.Popen(words, pass_fds=handed, env=environment, start_new_session=True)
        except BaseException:
            near.close()
            os.close(self._stops)
            raise
        finally:
            far.close()
            os.close(hears)
        self._requests = Connection(near.detach())

    @property
    def process_id(self) -> int:
        """Of the process that feeds."""
        return self._process.pid

    @property
    def identity(self) -> str:
        """The make and the version that the controller tells."""
        return self._identity

    @property
    def travel(self) -> Travel:
        """The travel of the rig file, above the floor."""
        travel: Travel = self._ask("travel")
        return travel

    @property
    def dead_time_s(self) -> float:
        """Into slave mode, and the buffer of set-points."""
        return self._dead_time_s

    @property
    def stop_path(self) -> StopPath:
        """Into the process that feeds: hold, then up."""
        lift_s = apart.LIFT_MM / apart.LIFT_FEED_MM_PER_S
        return StopPath(self._stops, ((apart.STOP, HELD_S), (apart.LIFT, lift_s + SPARE_S)))

    def home(self) -> None:
        """As ``BcapController.home``."""
        self._ask("home")

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        """Queue one straight move over there."""
        self._ask("start_move", target_mm=target_mm, feed_mm_per_s=feed_mm_per_s)

    def status(self) -> MotionStatus:
        """A fresh report."""
        status: MotionStatus = self._ask("status")
        return status

    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        """Ask again and again, so that nothing has to wait behind it."""
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            status = self.status()
            self._ask("check")
            if status.state is MotionState.IDLE:
                return status
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self._name}: still {status.state} after {timeout_s:g} s, about {status.queued_s:.1f} s "
                    "queued; hold() or flush() stops it"
                )
            self._clock.sleep_s(PERIOD_S)

    def hold(self) -> None:
        """Slow down on the path; heard over there before anything that is asked later."""
        self._stop(apart.HOLD)

    def resume(self) -> None:
        """Go on after ``hold()``."""
        self._ask("resume")

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        """Hold, wait for standstill, drop the rest of the path."""
        status: MotionStatus = self._ask("flush", timeout_s=timeout_s)
        return status

    def halt(self) -> None:
        """ROBOT_HALT from over there; heard before anything that is asked later, and within any wait."""
        self._stop(apart.HALT)

    def set_floor(self, z_mm: float | None) -> None:
        """As ``BcapController.set_floor``."""
        self._ask("set_floor", z_mm=z_mm)

    def close(self) -> None:
        """Bring the arm to rest, switch its motor off, end the process."""
        if not self._closed:
            try:
                if not self._lost:
                    self._ask("close")
            finally:
                self._end()

    def _stop(self, word: bytes) -> None:
        if self._closed:
            raise self._is_closed()
        try:
            os.write(self._stops, word)
        except BlockingIOError:
            pass  # Thousands of stops are in there already.
        except OSError as error:
            raise self._gone() from error

    def _ask(self, verb: str, **arguments: Any) -> Any:
        if self._closed:
            raise self._is_closed()
        with self._asking:
            number = next(self._numbers)
            try:
                self._requests.send((number, verb, arguments))
            except OSError as error:
                raise self._gone() from error
            return self._answer_to(number)

    def _answer_to(self, number: int) -> Any:
        while True:
            try:
                if not self._requests.poll(ANSWER_S):
                    raise DeviceTimeoutError(
                        f"{self._name}: the process that feeds the robot (pid {self._process.pid}) has not answered "
                        f"for {ANSWER_S:g} s; end it, and home again"
                    )
                answered, told, datagrams = self._requests.recv()
            except (EOFError, OSError) as error:
                raise self._gone() from error
            if self._noted is not None:
                for datagram in datagrams:
                    self._noted(*datagram)
            # The answer to a question that Ctrl-C has broken off may still come.
            if answered == number:
                if isinstance(told, MillError):
                    raise told
                return told

    def _end(self) -> None:
        self._closed = True
        self._requests.close()
        os.close(self._stops)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(LEAVE_S)
            return
        self._process.kill()
        self._process.wait()

    def _is_closed(self) -> ConnectionLostError:
        return ConnectionLostError(f"{self._name}: the controller was closed; open it again")

    def _gone(self) -> ConnectionLostError:
        self._lost = True
        return ConnectionLostError(
            f"{self._name}: the process that feeds the robot has ended, and without set-points the arm has stopped; "
            "open it again, and home"
        )
