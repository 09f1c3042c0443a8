"""Devices that write down what is asked of them, so that a trace can be played to a driver again."""

from contextlib import AbstractContextManager

from drivers.motion.forwarded import ForwardedMotion
from drivers.motion.interface import MotionController
from drivers.spindle.interface import AlarmPath, Spindle, SpindleStatus
from drivers.trace_file import Trace


class TracedMotion(ForwardedMotion):
    """A motion controller of any make; what is urgent is done first, then written down."""

    def __init__(self, motion: MotionController, trace: Trace) -> None:
        super().__init__(motion)
        self._trace = trace

    def around(self, call: str, *, is_urgent: bool = False, **arguments: object) -> AbstractContextManager[object]:
        """Write down."""
        return self._trace.call("motion", call, is_urgent=is_urgent, **arguments)


class TracedSpindle(Spindle):
    """A spindle of any make."""

    def __init__(self, spindle: Spindle, trace: Trace) -> None:
        self._spindle = spindle
        self._trace = trace

    @property
    def identity(self) -> str:
        """The spindle's."""
        return self._spindle.identity

    @property
    def heartbeat_s(self) -> float:
        """The spindle's."""
        return self._spindle.heartbeat_s

    @property
    def alarm_path(self) -> AlarmPath | None:
        """The spindle's."""
        return self._spindle.alarm_path

    @property
    def answers(self) -> tuple[int, int] | None:
        """Write down, for it reads the wire, and count."""
        with self._trace.call("spindle", "answers"):
            return self._spindle.answers

    @property
    def feels_load(self) -> bool:
        """The spindle's."""
        return self._spindle.feels_load

    @property
    def errors_on_wire(self) -> int | None:
        """The spindle's."""
        return self._spindle.errors_on_wire

    def heartbeats_s(self, duration_s: float) -> list[float]:
        """Write down and listen."""
        with self._trace.call("spindle", "heartbeats_s", duration_s=duration_s):
            return self._spindle.heartbeats_s(duration_s)

    def speed_unheard_rpm(self) -> float | None:
        """Write down and ask."""
        with self._trace.call("spindle", "speed_unheard_rpm"):
            return self._spindle.speed_unheard_rpm()

    def reset_fault(self) -> None:
        """Write down and acknowledge."""
        with self._trace.call("spindle", "reset_fault"):
            self._spindle.reset_fault()

    def past_faults(self) -> list[str]:
        """Write down and ask."""
        with self._trace.call("spindle", "past_faults"):
            return self._spindle.past_faults()

    def start(self, speed_rpm: float) -> None:
        """Write down and start."""
        with self._trace.call("spindle", "start", speed_rpm=speed_rpm):
            self._spindle.start(speed_rpm)

    def stop(self) -> None:
        """Stop, then write it down."""
        with self._trace.call("spindle", "stop", is_urgent=True):
            self._spindle.stop()

    def status(self) -> SpindleStatus:
        """Write down and ask."""
        with self._trace.call("spindle", "status"):
            return self._spindle.status()

    def wait_until_at_speed(self, timeout_s: float) -> SpindleStatus:
        """Write down and wait."""
        with self._trace.call("spindle", "wait_until_at_speed", timeout_s=timeout_s):
            return self._spindle.wait_until_at_speed(timeout_s)

    def close(self) -> None:
        """Write down and close."""
        with self._trace.call("spindle", "close"):
            self._spindle.close()
