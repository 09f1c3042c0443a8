"""A trace played again: to the driver, whose calls it holds, and to the emulator, whose answers it holds."""

from collections import deque
from collections.abc import Callable
from pathlib import Path

import can

from drivers.clock import Clock
from drivers.errors import MillError
from drivers.trace_file import Entry, frame_of, frame_text, read_trace
from firmware_sim.bench import Bench

SLACK_S = 0.005
"""Who looks without waiting finds what came in so soon after: a computer spends time on a program, this clock none."""
STEP_S = 0.0005


class Playback:
    """One wire of a trace, and a clock that follows it: exactly what was written must be written, in that order.

    Only a ``beat``, which the host writes by the clock, may come before or behind its neighbour: whether it was due at
    a line of the program is a matter of microseconds. They must be as many, with one astray at most.
    """

    def __init__(self, file: Path, wire: str, *, beat: str | None = None) -> None:
        log = read_trace(file)
        self.header = log.header
        self.entries = deque(entry for entry in log.entries if entry.wire == wire)
        self.raised: list[str] = []
        self._beat = beat
        self._early = 0
        self._silences = 0
        self._now_s = 0.0

    def now_s(self) -> float:
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        self._now_s += max(0.0, duration_s)

    def write(self, data: str) -> None:
        entry = self._next()
        if data == self._beat and (entry is None or entry.data != data):
            self._stray(1)
            return
        if data != self._beat:
            entry = self._without_beat()
        assert entry is not None, f"wrote {data!r} after the end of the trace"
        assert (entry.kind, entry.data) == ("out", data), (
            f"line {entry.number} at {entry.t_s:.6f} s: the trace says {entry.kind} {entry.data!r}, written {data!r}"
        )
        self._take()

    def read(self, timeout_s: float) -> str | None:
        """What came in next. Who waits is given it whenever it came: the trace says that nothing was written before."""
        if not self.raised and self.entries and self.entries[0].kind == "error":
            # The call is about to raise it; nothing came before.
            self._silences += 1
            assert self._silences < 100, f"a call is waited for to raise {self.entries[0].data!r}"
            self._now_s += timeout_s
            return None
        self._silences = 0
        entry = self._next()
        if entry is None or entry.kind != "in" or (timeout_s <= 0 and entry.t_s > self._now_s + SLACK_S):
            self._now_s += timeout_s
            return None
        self._take()
        return str(entry.data)

    def call(self, verbs: Callable[[str], Callable[..., object]]) -> bool:
        """Make the next call, which must raise what it raised then; False when the trace is at its end."""
        entry = self._next()
        if entry is None:
            return False
        assert entry.kind == "call", f"line {entry.number} at {entry.t_s:.6f} s: never happened: {entry.data!r}"
        self._take()
        try:
            verbs(entry.data["verb"])(**entry.data["args"])
        except MillError as error:
            self.raised.append(str(error))
        left = self._without_beat()
        assert left is None or left.kind == "call", f"line {left.number}: never happened: {left.kind} {left.data!r}"
        return True

    def _next(self) -> Entry | None:
        while self.entries and self.entries[0].kind == "error":
            assert self.raised, f"the trace says that a call raised {self.entries[0].data!r}"
            assert self.raised.pop(0) == self.entries.popleft().data
        while self._early > 0 and self._is_beat():
            self._take()
            self._stray(-1)
        return self.entries[0] if self.entries else None

    def _without_beat(self) -> Entry | None:
        """The next entry, leaving a beat out that will come late."""
        while self._next() is not None and self._is_beat():
            self._take()
            self._stray(-1)
        return self._next()

    def _is_beat(self) -> bool:
        return bool(self.entries) and (self.entries[0].kind, self.entries[0].data) == ("out", self._beat)

    def _stray(self, by: int) -> None:
        self._early += by
        assert abs(self._early) <= 1, f"at {self._now_s:.6f} s: more than one {self._beat} too many or too few"

    def _take(self) -> None:
        self._now_s = max(self._now_s, self.entries.popleft().t_s)
        if self.entries and self._now_s < self.entries[0].t_s < self._now_s + STEP_S:
            # Nobody waits so short a time: it was spent on computing.
            self._now_s = self.entries[0].t_s


class PlayedLine:
    """A serial line."""

    name = "trace"
    descriptor = None

    def __init__(self, playback: Playback) -> None:
        self._playback = playback

    def write(self, data: bytes) -> None:
        self._playback.write(data.decode("latin-1"))

    def read(self, timeout_s: float) -> bytes:
        return (self._playback.read(timeout_s) or "").encode("latin-1")

    def close(self) -> None:
        pass


class PlayedBus(can.BusABC):
    """A CAN bus."""

    def __init__(self, playback: Playback) -> None:
        self._playback = playback
        self.channel_info = "trace"
        super().__init__(channel="trace")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._playback.write(frame_text(msg.arbitration_id, bytes(msg.data)))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        text = self._playback.read(timeout or 0.0)
        if text is None:
            return None
        can_id, _, data = frame_of(text)
        return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def play(playback: Playback, opened: Callable[[Clock], object]) -> None:
    """Call everything that was called, on a device that ``opened`` opens on the played wire."""
    device: list[object] = []

    def verb(name: str) -> Callable[..., object]:
        if name == "open":
            return lambda: device.append(opened(playback))
        if name == "answers":
            return lambda: device[-1].answers  # type: ignore[attr-defined]
        found: Callable[..., object] = getattr(device[-1], name)
        return found

    while playback.call(verb):
        pass


def fed_board(file: Path) -> tuple[bytes, bytes]:
    """What the motion board said in the trace, and what a fresh one says when it is told the same at the same times."""
    log = read_trace(file)
    entries = [entry for entry in log.entries if entry.wire == "motion"]
    bench = Bench(seed=log.header["seed"])
    said = b""
    for entry in entries:
        if entry.kind == "out":
            bench.advance_to(entry.t_s)
            said += bench.transmit()
            bench.receive(entry.data.encode("latin-1"))
    bench.advance_to(entries[-1].t_s + 0.05)
    was = "".join(entry.data for entry in entries if entry.kind == "in").encode("latin-1")
    return was, said + bench.transmit()


def fed_drive(file: Path) -> tuple[list[str], list[str]]:
    """The frames of the drive in the trace, and those of a fresh one that is told the same at the same times."""
    log = read_trace(file)
    entries = [entry for entry in log.entries if entry.wire == "spindle"]
    bench = Bench(seed=log.header["seed"])
    port = bench.can.open_port()
    for entry in entries:
        if entry.kind == "out":
            bench.advance_to(entry.t_s)
            can_id, _, data = frame_of(entry.data)
            port.send(can_id, data)
    bench.advance_to(entries[-1].t_s + 0.05)
    was = [entry.data for entry in entries if entry.kind == "in"]
    began_s = next(entry.t_s for entry in entries if entry.kind == "out")
    return was, [frame_text(can_id, data) for time_s, (can_id, data) in port.heard if time_s > began_s]
