"""The stage's driver: mill's promises (drivers/motion/interface.py) kept on this make's wire.

The stage latches a stop by itself, so that a line written just behind one is refused by the stage and needs no
bookkeeping here.
"""

import contextlib
import math
from collections.abc import Mapping
from typing import Any

from drivers.clock import Clock
from drivers.errors import (
    ConfigError,
    DeviceError,
    DeviceFaultError,
    DeviceTimeoutError,
    NotHomedError,
    OutOfTravelError,
    ProtocolError,
)
from drivers.motion.interface import MotionController, MotionState, MotionStatus, StopPath, Travel, Vector
from drivers.motion.serial_line import open_serial
from drivers.motion.transport import SerialLine
from mill_example.table import Table, checked
from mill_example.wire import GO_ON, HOLD, STOP, Wire

REPLY_S = 0.2
HOMING_S = 60.0
POLL_S = 0.005


class StageTable(Table):
    """[motion] with backend = "example"."""

    port: str
    max_feed_mm_s: float = 20.0


def open_motion(table: Mapping[str, Any], clock: Clock) -> MotionController:
    """The entry point "motion.example"."""
    keys = checked(StageTable, "motion", table)
    line = open_serial(keys.port, 115_200)  # locked against other processes, absence told in words
    try:
        return ExampleStage(line, clock, max_feed_mm_per_s=keys.max_feed_mm_s)
    except BaseException:
        line.close()
        raise


class ExampleStage(MotionController):
    """Open from construction; a constructor that raises leaves nothing open."""

    def __init__(self, line: SerialLine, clock: Clock, *, max_feed_mm_per_s: float) -> None:
        self._wire = Wire(line, clock)
        self._clock = clock
        self._max_feed_mm_per_s = max_feed_mm_per_s
        self._closed = False
        self._identity = self._wire.ask("who", within_s=REPLY_S)
        self._whole = self._travel = self._read_travel()

    @property
    def identity(self) -> str:
        return self._identity

    @property
    def travel(self) -> Travel:
        return self._travel

    @property
    def dead_time_s(self) -> float:
        return 0.02

    @property
    def stop_path(self) -> StopPath | None:
        fd = self._wire.descriptor
        return None if fd is None else StopPath(fd, ((HOLD, 0.1), (STOP, 0.0)))

    def home(self) -> None:
        self._wire.ask("home", within_s=REPLY_S)
        deadline_s = self._clock.now_s() + HOMING_S
        while (status := self.status()).state is MotionState.HOMING:
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeoutError(f"{self._wire.name}: not homed within {HOMING_S:g} s; look at its switches")
            self._clock.sleep_s(POLL_S)
        if status.state is not MotionState.IDLE:
            raise self._latched(status)

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        if not 0 < feed_mm_per_s <= self._max_feed_mm_per_s:
            raise ConfigError(
                f"{self._wire.name}: feed {feed_mm_per_s:g} mm/s; allowed: above 0, up to {self._max_feed_mm_per_s:g}"
            )
        if not self._travel.contains(target_mm):
            raise OutOfTravelError(
                f"{self._wire.name}: target {target_mm} mm is outside the travel {self._travel.low_mm} to "
                f"{self._travel.high_mm} mm; nothing was sent; choose a target inside"
            )
        status = self.status()
        if status.state is MotionState.ALARM:
            raise self._latched(status)
        if status.state in (MotionState.HOLDING, MotionState.HELD):
            raise DeviceFaultError(f"{self._wire.name}: a hold stands; resume() or flush() first")
        x, y, z = target_mm
        self._wire.ask(f"go {x:.4f} {y:.4f} {z:.4f} {feed_mm_per_s:.4f}", within_s=REPLY_S)

    def status(self) -> MotionStatus:
        answer = self._wire.ask("where", within_s=REPLY_S)
        try:
            state, x, y, z, queued_s, *alarm = answer.split(" ")
            place_mm = (float(x), float(y), float(z))
            return MotionStatus(
                MotionState(state), place_mm, float(queued_s), self._clock.now_s(), " ".join(alarm) or None
            )
        except ValueError:
            raise ProtocolError(f"{self._wire.name}: {answer!r} is no status; check the cable") from None

    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        deadline_s = self._clock.now_s() + timeout_s
        while (status := self.status()).state is not MotionState.IDLE:
            if status.state is MotionState.ALARM:
                raise self._latched(status)
            if self._clock.now_s() > deadline_s:
                still = "held; resume()" if status.state is MotionState.HELD else "moving; wait longer"
                raise DeviceTimeoutError(f"{self._wire.name}: after {timeout_s:g} s still {still} or flush()")
            self._clock.sleep_s(POLL_S)
        return status

    def hold(self) -> None:
        self._wire.urgent(HOLD)

    def resume(self) -> None:
        if (status := self.status()).state is MotionState.ALARM:
            raise self._latched(status)
        self._wire.urgent(GO_ON)

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        if self.status().state is MotionState.IDLE:
            return self.status()
        self.hold()
        deadline_s = self._clock.now_s() + timeout_s
        while (status := self.status()).state not in (MotionState.HELD, MotionState.IDLE):
            if status.state is MotionState.ALARM:
                raise self._latched(status)
            if self._clock.now_s() > deadline_s:
                raise DeviceTimeoutError(f"{self._wire.name}: no standstill within {timeout_s:g} s; halt() stops it")
            self._clock.sleep_s(POLL_S)
        self._wire.ask("drop", within_s=REPLY_S)
        return self.status()

    def halt(self) -> None:
        self._wire.urgent(STOP)

    def set_floor(self, z_mm: float | None) -> None:
        low, high = self._whole.low_mm, self._whole.high_mm
        z = low[2] if z_mm is None else z_mm
        if not low[2] <= z <= high[2]:
            raise OutOfTravelError(
                f"{self._wire.name}: floor {z_mm:g} mm is outside the travel {low[2]:g} to {high[2]:g} mm"
            )
        self._wire.ask(f"floor {z:.4f}", within_s=REPLY_S)
        self._travel = self._read_travel()
        if not math.isclose(self._travel.low_mm[2], z, abs_tol=1e-3):
            raise DeviceFaultError(f"{self._wire.name}: floor {z:g} mm reads back {self._travel.low_mm[2]:g} mm")

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            # A stage that answers nothing more cannot be brought to rest any better.
            for leave_safe in (self.flush, lambda: self.set_floor(None)):
                with contextlib.suppress(DeviceError):
                    leave_safe()
        finally:
            self._wire.close()

    def _read_travel(self) -> Travel:
        answer = self._wire.ask("travel", within_s=REPLY_S)
        try:
            x0, y0, z0, x1, y1, z1 = map(float, answer.split(" "))
        except ValueError:
            raise ProtocolError(f"{self._wire.name}: {answer!r} is no travel; check the cable") from None
        return Travel((x0, y0, z0), (x1, y1, z1))

    def _latched(self, status: MotionStatus) -> DeviceError:
        kind: type[DeviceError] = NotHomedError if status.alarm == "not homed" else DeviceFaultError
        return kind(f"{self._wire.name}: {status.alarm}; home() releases it")
