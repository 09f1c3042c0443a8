"""Devices that write down what is asked of them, so that a trace can be played to a driver again."""

from collections.abc import Mapping

from drivers.motion.interface import MotionController, MotionStatus, StopPath, Travel, Vector
from drivers.spindle.interface import AlarmPath, Spindle, SpindleStatus
from drivers.trace_file import Trace


class TracedMotion(MotionController):
    """A motion controller of any make."""

    def __init__(self, motion: MotionController, trace: Trace) -> None:
        self._motion = motion
        self._trace = trace

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
        """Write down and home."""
        with self._trace.call("motion", "home"):
            self._motion.home()

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        """Write down and move."""
        with self._trace.call("motion", "start_move", target_mm=target_mm, feed_mm_per_s=feed_mm_per_s):
            self._motion.start_move(target_mm, feed_mm_per_s=feed_mm_per_s)

    def status(self) -> MotionStatus:
        """Write down and ask."""
        with self._trace.call("motion", "status"):
            return self._motion.status()

    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        """Write down and wait."""
        with self._trace.call("motion", "wait_until_idle", timeout_s=timeout_s):
            return self._motion.wait_until_idle(timeout_s)

    def hold(self) -> None:
        """Hold, then write it down."""
        with self._trace.call("motion", "hold", is_urgent=True):
            self._motion.hold()

    def resume(self) -> None:
        """Write down and resume."""
        with self._trace.call("motion", "resume"):
            self._motion.resume()

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        """Write down and flush."""
        with self._trace.call("motion", "flush", timeout_s=timeout_s):
            return self._motion.flush(timeout_s)

    def halt(self) -> None:
        """Halt, then write it down."""
        with self._trace.call("motion", "halt", is_urgent=True):
            self._motion.halt()

    def set_floor(self, z_mm: float | None) -> None:
        """Write down and set the floor."""
        with self._trace.call("motion", "set_floor", z_mm=z_mm):
            self._motion.set_floor(z_mm)

    def close(self) -> None:
        """Write down and close."""
        with self._trace.call("motion", "close"):
            self._motion.close()


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
