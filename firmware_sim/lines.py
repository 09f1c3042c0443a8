"""In-process wires: what lies below a driver's logic, answered synchronously on the virtual clock.

The driver above is the one that runs on hardware. Waiting advances the virtual world in small steps until there is
something to read or the time is over; nothing here spins, sleeps on the wall clock, or starts a thread.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import can

from drivers.camera.interface import Image
from drivers.errors import ConnectionLostError, DeviceTimeoutError
from firmware_sim.can_wire import CanNode, CanWire, as_wire
from firmware_sim.clock import SimClock

if TYPE_CHECKING:
    from firmware_sim.microscope import Shot

_MOTION_STEP_S = 0.001
_CAN_STEP_S = 0.0005


class MotionBoard(Protocol):
    """A board with a serial port, or one that takes datagrams; somebody else advances its time."""

    def receive(self, data: bytes) -> None:
        """Bytes from the host, or one datagram."""

    def transmit(self) -> bytes:
        """The bytes sent to the host since the last call, or the next datagram."""


Shutter = Callable[[float], "Shot | None"]
"""Left and right picture of the world as it is at a time; None where there is none."""


class InProcessLine:
    """A ``SerialLine`` or a ``DatagramLine`` of ``drivers.motion.transport`` straight into a board.

    The board must be advanced by the same clock (``clock.attach``), by its bench or by the caller.
    """

    def __init__(self, board: MotionBoard, clock: SimClock, *, name: str = "in-process:motion") -> None:
        self._board = board
        self._clock = clock
        self._name = name
        self._open = True

    @property
    def name(self) -> str:
        """The name that error messages show."""
        return self._name

    @property
    def descriptor(self) -> int | None:
        """None: no other process can reach it."""
        return None

    def write(self, data: bytes) -> None:
        """Put bytes, or one datagram, on the wire at the present virtual time; takes no virtual time of its own."""
        self._require_open()
        with self._clock.lock:
            self._board.receive(data)

    def read(self, timeout_s: float) -> bytes:
        """What has arrived, or one datagram, letting up to ``timeout_s`` pass for it; zero lets none pass."""
        self._require_open()
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            with self._clock.lock:
                data = self._board.transmit()
            remaining_s = deadline_s - self._clock.now_s()
            if data or remaining_s <= 0:
                return data
            self._clock.sleep_s(min(_MOTION_STEP_S, remaining_s))

    def close(self) -> None:
        """Give the line back; a second call does nothing."""
        self._open = False

    def _require_open(self) -> None:
        if not self._open:
            raise ConnectionLostError(f"{self._name}: the line is closed; open it again")


class InProcessBus(can.BusABC):
    """A python-can bus straight into the emulated wire, with virtual time stamps."""

    def __init__(self, node: CanNode | CanWire, clock: SimClock, *, name: str = "in-process:spindle") -> None:
        self._wire = as_wire(node)
        self._port = self._wire.open_port()
        self._clock = clock
        self.channel_info = name
        super().__init__(channel=name)
        if self._wire is not node:
            clock.attach(self._wire.advance_to)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Give a frame to the arbitration at the present virtual time."""
        if msg.is_extended_id or msg.is_remote_frame:
            raise can.CanOperationError(f"{self.channel_info}: only standard data frames are carried, not {msg}")
        with self._clock.lock:
            self._port.send(msg.arbitration_id, bytes(msg.data))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The oldest frame that passes the filters, letting up to ``timeout`` pass; zero lets none pass."""
        deadline_s = math.inf if timeout is None else self._clock.now_s() + timeout
        while True:
            message = self._next()
            remaining_s = deadline_s - self._clock.now_s()
            if message is not None or remaining_s <= 0:
                return message
            self._clock.sleep_s(min(_CAN_STEP_S, remaining_s))

    def _next(self) -> can.Message | None:
        with self._clock.lock:
            while self._port.heard:
                time_s, (can_id, data) = self._port.heard.popleft()
                message = can.Message(
                    timestamp=time_s, arbitration_id=can_id, data=data, is_extended_id=False, channel=self.channel_info
                )
                if self._matches_filters(message):
                    return message
        return None


class InProcessSource:
    """One eye of an emulated camera pair, for ``drivers.camera.stereo.StereoPair``.

    A picture is drawn when it is asked for, of the world at that moment; then the time that exposure and transport
    take is charged to the clock, and the picture is handed out. It is never kinder than a camera: what ``newest``
    returns is up to one frame period and one latency old.
    """

    def __init__(self, pair: "_Exposures", side: int, identity: str) -> None:
        self._pair = pair
        self._side = side
        self.identity = identity
        self._open = True

    def newest(self) -> tuple[Image, float] | None:
        """The freshest picture and when its exposure began."""
        self._require_open()
        return self._pair.newest(self._side)

    def wait_newer(self, exposed_after_s: float, timeout_s: float) -> tuple[Image, float]:
        """A picture whose exposure began after ``exposed_after_s``.

        Raises:
            DeviceTimeoutError: none within ``timeout_s``.
        """
        self._require_open()
        exposure = self._pair.wait_newer(self._side, exposed_after_s, timeout_s)
        if exposure is None:
            raise DeviceTimeoutError(f"{self.identity}: no picture within {timeout_s:.3f} s; check the camera")
        return exposure

    def close(self) -> None:
        """Give the camera back; a second call does nothing."""
        self._open = False

    def _require_open(self) -> None:
        if not self._open:
            raise ConnectionLostError(f"{self.identity}: the camera is closed; open it again")


class _Exposures:
    """The shutter that both eyes share, so that one instant is drawn once."""

    def __init__(self, shoot: Shutter, clock: SimClock, period_s: float, latency_s: float) -> None:
        self._shoot = shoot
        self._clock = clock
        self._period_s = period_s
        self._latency_s = latency_s
        self._shot_at_s = -math.inf
        self._last: tuple[tuple[Image, float], tuple[Image, float]] | None = None
        """Picture and exposure of either eye."""

    def newest(self, side: int) -> tuple[Image, float] | None:
        if self._clock.now_s() - self._shot_at_s >= self._period_s + self._latency_s:
            self._expose()
        return None if self._last is None else self._last[side]

    def wait_newer(self, side: int, exposed_after_s: float, timeout_s: float) -> tuple[Image, float] | None:
        now_s = self._clock.now_s()
        until_s, next_after_s = now_s + timeout_s, max(exposed_after_s, now_s)
        while self._last is None or self._last[side][1] <= exposed_after_s:
            # A free-running camera opens its shutter at multiples of its period, not when somebody asks.
            start_s = (math.floor(next_after_s / self._period_s) + 1) * self._period_s
            if start_s + self._latency_s > until_s:
                self._clock.sleep_s(max(0.0, until_s - self._clock.now_s()))
                return None
            self._clock.run_until(start_s)
            self._expose()
            next_after_s = self._clock.now_s()
        return self._last[side]

    def _expose(self) -> None:
        self._shot_at_s = exposed_at_s = self._clock.now_s()
        with self._clock.lock:
            shot = self._shoot(exposed_at_s)
        if shot is not None:
            left_at_s, right_at_s = exposed_at_s - shot.left_late_s, exposed_at_s - shot.right_late_s
            self._last = ((shot.left, left_at_s), (shot.right, right_at_s))
        self._clock.sleep_s(self._latency_s)


def in_process_sources(
    shoot: Shutter, clock: SimClock, *, fps: float = 30.0, latency_s: float = 0.025, name: str = "in-process"
) -> tuple[InProcessSource, InProcessSource]:
    """A left and a right eye behind one shutter; ``latency_s`` is exposure and transport together."""
    pair = _Exposures(shoot, clock, 1.0 / fps, latency_s)
    return InProcessSource(pair, 0, f"{name}-left"), InProcessSource(pair, 1, f"{name}-right")
