"""A motion controller beside which a supervisor stands, for those who move it in free air and know of none."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from drivers.errors import DeviceError, SafetyStop
from drivers.motion.forwarded import ForwardedMotion
from drivers.motion.interface import MotionController
from milling.guard import Guard


class GuardedMotion(ForwardedMotion):
    """Moves nothing more once the supervisor has stopped it. Close the guard first, then this.

    The supervisor is never armed: silence is allowed in free air, and it stops the motion only when it is told to. All
    but hold, halt and close raises SafetyStop where it has stopped the motion, or is gone, before or meanwhile.
    """

    def __init__(self, motion: MotionController, guard: Guard) -> None:
        """``guard`` holds the stop path of ``motion``."""
        super().__init__(motion)
        self._guard = guard

    def around(self, call: str, *, is_urgent: bool = False, **arguments: object) -> AbstractContextManager[object]:
        """See what the supervisor did, before and after."""
        return nullcontext() if is_urgent or call == "close" else self._watched()

    def require_unstopped(self, cause: DeviceError | None = None) -> None:
        """Also once the guard is closed, as a stop may have come just before that.

        Raises:
            SafetyStop: the supervisor has stopped the motion, or is gone without being told to leave.
        """
        why = self._guard.stopped()
        if why is not None:
            raise SafetyStop(f"supervisor: {why}; home next") from cause

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """What the controller says of a stop that was not its host's is no fault of it; and some say nothing."""
        self.require_unstopped()
        try:
            yield
        except DeviceError as error:
            self.require_unstopped(error)
            raise
        self.require_unstopped()
