"""The board's serial port over USB, and how g2core finds lines in it: control lines first, single characters at once.

The manual's rules (g2core wiki, Communications): a line that begins with a brace, and a single character at the start
of a line, are control; all else is data, which waits for the planner.
"""

from collections import deque

FRAME_S = 0.001
"""A full-speed USB frame: what is written arrives with the next one."""
LONGEST_LINE = 255
_ENDS = b"\r\n"
_SINGLE = b"!~\x05\x18\x04"


class Usb:
    """Bytes both ways, each a frame late."""

    def __init__(self) -> None:
        self._incoming: deque[tuple[float, bytes]] = deque()
        self._outgoing: deque[tuple[float, bytes]] = deque()

    def send_to_board(self, data: bytes, now_s: float) -> None:
        """The host writes."""
        self._incoming.append((now_s + FRAME_S, data))

    @property
    def waits(self) -> bool:
        """Whether something is on its way to the board."""
        return bool(self._incoming)

    def arrived(self, now_s: float) -> bytes:
        """What has reached the board."""
        return _taken(self._incoming, now_s)

    def say(self, text: str, now_s: float) -> None:
        """One line for the host."""
        self._outgoing.append((now_s + FRAME_S, text.encode("latin-1") + b"\n"))

    def collect(self, now_s: float) -> bytes:
        """What has reached the host."""
        return _taken(self._outgoing, now_s)


def _taken(wire: deque[tuple[float, bytes]], now_s: float) -> bytes:
    data = b""
    while wire and wire[0][0] <= now_s + 1e-9:
        data += wire.popleft()[1]
    return data


class LineBuffer:
    """What has been received, in lines."""

    def __init__(self) -> None:
        self._line = bytearray()
        self.controls: deque[str] = deque()
        self.data: deque[str] = deque()

    def take(self, byte: int, *, in_hold: bool) -> None:
        """One byte; a percent sign is a command in a feed hold only."""
        if byte == 0:
            self.forget()
        elif byte in _ENDS:
            self._end()
        elif not self._line and (byte in _SINGLE or (byte == ord("%") and in_hold)):
            self.controls.append(chr(byte))
        elif len(self._line) < LONGEST_LINE:
            self._line.append(byte)

    def _end(self) -> None:
        if self._line:
            text = self._line.decode("latin-1")
            (self.controls if text.startswith("{") else self.data).append(text)
            self._line.clear()

    def drop_data(self) -> None:
        """A queue flush or the end of a job throws away the lines that wait."""
        self.data.clear()

    def forget(self) -> None:
        """All of it."""
        self._line.clear()
        self.controls.clear()
        self.data.clear()
