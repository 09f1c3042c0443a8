"""A motion controller beside which a supervisor stands, for those who move it in free air and know of none."""

import contextlib
from collections.abc import Iterator, Mapping

from drivers.errors import DeviceError, SafetyStop
from drivers.motion.interface import MotionController, MotionStatus, StopPath, Travel, Vector
from milling.guard import Guard


class GuardedMotion(MotionController):
    """Moves nothing more once the supervisor has stopped it. Close the guard first, then this.

    The supervisor is never armed: silence is allowed in free air, and it stops the motion only when it is told to.
    """

    def __init__(self, motion: MotionController, guard: Guard) -> None:
        """``guard`` holds the stop path of ``motion``."""
        self._motion = motion
        self._guard = guard

    @property
    def identity(self) -> str:
        """The controller's."""
        return self._motion.identity

    @property
    def settings(self) -> Mapping[str, float]:
        """The controller's."""
        return self._motion.settings

    @property
    def buffer_bytes(self) -> int | None:
        """The controller's."""
        return self._motion.buffer_bytes

    @property
    def travel(self) -> Travel:
        """The controller's."""
        return self._motion.travel

    @property
    def dead_time_s(self) -> float:
        """The controller's."""
        return self._motion.dead_time_s

    @property
    def stop_path(self) -> StopPath | None:
        """The controller's."""
        return self._motion.stop_path

    def home(self) -> None:
        """Home.

        Raises:
            SafetyStop: the supervisor has stopped the motion, or is gone, before or meanwhile.
        """
        with self._watched():
            self._motion.home()

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        """Move.

        Raises:
            SafetyStop: as ``home``.
        """
        with self._watched():
            self._motion.start_move(target_mm, feed_mm_per_s=feed_mm_per_s)

    def status(self) -> MotionStatus:
        """Ask.

        Raises:
            SafetyStop: as ``home``.
        """
        with self._watched():
            return self._motion.status()

    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        """Wait.

        Raises:
            SafetyStop: as ``home``.
        """
        with self._watched():
            return self._motion.wait_until_idle(timeout_s)

    def hold(self) -> None:
        """Hold; never waits."""
        self._motion.hold()

    def resume(self) -> None:
        """Go on.

        Raises:
            SafetyStop: as ``home``.
        """
        with self._watched():
            self._motion.resume()

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        """Hold and drop the queue.

        Raises:
            SafetyStop: as ``home``.
        """
        with self._watched():
            return self._motion.flush(timeout_s)

    def halt(self) -> None:
        """Halt; never waits."""
        self._motion.halt()

    def set_floor(self, z_mm: float | None) -> None:
        """Set the floor.

        Raises:
            SafetyStop: as ``home``.
        """
        with self._watched():
            self._motion.set_floor(z_mm)

    def close(self) -> None:
        """Close the controller."""
        self._motion.close()

    def require_unstopped(self, cause: DeviceError | None = None) -> None:
        """Also once the guard is closed, as a stop may have come just before that.

        Raises:
            SafetyStop: the supervisor has stopped the motion, or is gone without being told to leave.
        """
        why = self._guard.stopped()
        if why is not None:
            raise SafetyStop(f"supervisor: {why}; home next") from cause

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        """What the controller says of a stop that was not its host's is no fault of it; and some say nothing."""
        self.require_unstopped()
        try:
            yield
        except DeviceError as error:
            self.require_unstopped(error)
            raise
        self.require_unstopped()
