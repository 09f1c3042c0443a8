"""Wires that write down what passes over them. The drivers above and the devices below do not know."""

import contextlib
from collections.abc import Iterator

import can

from drivers.camera.interface import Image
from drivers.camera.stereo import FrameSource
from drivers.errors import MillError
from drivers.motion.transport import DatagramLine, SerialLine
from drivers.spindle.canbus import AlarmedBus
from drivers.spindle.interface import AlarmPath
from drivers.trace_file import ERROR, EXTENDED, REMOTE, Trace, frame_text


@contextlib.contextmanager
def _failures(trace: Trace, wire: str) -> Iterator[None]:
    try:
        yield
    except (MillError, can.CanError, OSError) as error:
        trace.note(trace.mark(), wire, "error", str(error))
        raise


class TracedDatagrams:
    """A ``DatagramLine``."""

    def __init__(self, line: DatagramLine, trace: Trace, wire: str) -> None:
        self._line = line
        self._trace = trace
        self._wire = wire

    @property
    def name(self) -> str:
        """The line's."""
        return self._line.name

    def write(self, data: bytes) -> None:
        """Put bytes on the wire, then write them down."""
        mark = self._trace.mark()
        with _failures(self._trace, self._wire):
            self._line.write(data)
        self._trace.note(mark, self._wire, "out", data.decode("latin-1"))

    def read(self, timeout_s: float) -> bytes:
        """What the line gives; silence is not written down."""
        with _failures(self._trace, self._wire):
            data = self._line.read(timeout_s)
        if data:
            self._trace.note(self._trace.mark(), self._wire, "in", data.decode("latin-1"))
        return data

    def close(self) -> None:
        """Give the line back."""
        self._line.close()


class TracedLine(TracedDatagrams):
    """A ``SerialLine``; what another process writes to its descriptor is not seen."""

    def __init__(self, line: SerialLine, trace: Trace, wire: str) -> None:
        super().__init__(line, trace, wire)
        self.descriptor = line.descriptor
        """The line's."""


class TracedBus(can.BusABC):
    """A python-can bus around another one, which is its own from here on."""

    def __init__(self, bus: can.BusABC, trace: Trace, wire: str) -> None:
        self._bus = bus
        self._trace = trace
        self._wire = wire
        self.channel_info = bus.channel_info
        super().__init__(channel=bus.channel_info)

    def alarm_path(self, node_id: int) -> AlarmPath | None:
        """The bus's."""
        return self._bus.alarm_path(node_id) if isinstance(self._bus, AlarmedBus) else None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send, then write it down."""
        mark = self._trace.mark()
        with _failures(self._trace, self._wire):
            self._bus.send(msg, timeout)
        self._trace.note(mark, self._wire, "out", _text(msg))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """What the bus gives; silence is not written down."""
        with _failures(self._trace, self._wire):
            message = self._bus.recv(timeout)
        if message is not None:
            self._trace.note(self._trace.mark(), self._wire, "in", _text(message))
        return message

    def shutdown(self) -> None:
        """Shut the bus down; a second call does nothing."""
        if not self._is_shutdown:
            super().shutdown()
            self._bus.shutdown()


class TracedSource:
    """One eye: when the exposure of each picture that the driver sees began. Pixels are not kept."""

    def __init__(self, source: FrameSource, trace: Trace, wire: str) -> None:
        self._source = source
        self._trace = trace
        self._wire = wire
        self._seen_s = float("-inf")

    @property
    def identity(self) -> str:
        """The source's."""
        return self._source.identity

    def newest(self) -> tuple[Image, float] | None:
        """The freshest picture at hand."""
        with _failures(self._trace, self._wire):
            frame = self._source.newest()
        return None if frame is None else self._noted(frame)

    def wait_newer(self, exposed_after_s: float, timeout_s: float) -> tuple[Image, float]:
        """A picture whose exposure began after ``exposed_after_s``."""
        with _failures(self._trace, self._wire):
            frame = self._source.wait_newer(exposed_after_s, timeout_s)
        return self._noted(frame)

    def close(self) -> None:
        """Give the camera back."""
        self._source.close()

    def _noted(self, frame: tuple[Image, float]) -> tuple[Image, float]:
        exposed_s = frame[1]
        if exposed_s != self._seen_s:
            self._seen_s = exposed_s
            self._trace.note(self._trace.mark(), self._wire, "in", {"exposed_s": self._trace.seconds(exposed_s)})
        return frame


def _text(message: can.Message) -> str:
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame | ERROR * message.is_error_frame
    return frame_text(message.arbitration_id, bytes(message.data), flags=flags)
