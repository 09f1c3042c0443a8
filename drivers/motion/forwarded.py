"""A motion controller in front of another one: passes every call on, with something around it."""

from abc import abstractmethod
from collections.abc import Mapping
from contextlib import AbstractContextManager

from drivers.motion.interface import MotionController, MotionStatus, StopPath, Travel, Vector


class ForwardedMotion(MotionController):
    """What lies around a call is ``around``; all else is the controller's own."""

    def __init__(self, motion: MotionController) -> None:
        self._motion = motion

    @abstractmethod
    def around(self, call: str, *, is_urgent: bool = False, **arguments: object) -> AbstractContextManager[object]:
        """Entered before a call, and left after it; nothing may delay one that is urgent."""

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
        """Home."""
        with self.around("home"):
            self._motion.home()

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        """Move."""
        with self.around("start_move", target_mm=target_mm, feed_mm_per_s=feed_mm_per_s):
            self._motion.start_move(target_mm, feed_mm_per_s=feed_mm_per_s)

    def status(self) -> MotionStatus:
        """Ask."""
        with self.around("status"):
            return self._motion.status()

    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        """Wait."""
        with self.around("wait_until_idle", timeout_s=timeout_s):
            return self._motion.wait_until_idle(timeout_s)

    def hold(self) -> None:
        """Hold; never waits."""
        with self.around("hold", is_urgent=True):
            self._motion.hold()

    def resume(self) -> None:
        """Go on."""
        with self.around("resume"):
            self._motion.resume()

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        """Hold and drop the queue."""
        with self.around("flush", timeout_s=timeout_s):
            return self._motion.flush(timeout_s)

    def halt(self) -> None:
        """Halt; never waits."""
        with self.around("halt", is_urgent=True):
            self._motion.halt()

    def set_floor(self, z_mm: float | None) -> None:
        """Set the floor."""
        with self.around("set_floor", z_mm=z_mm):
            self._motion.set_floor(z_mm)

    def close(self) -> None:
        """Close the controller."""
        with self.around("close"):
            self._motion.close()
