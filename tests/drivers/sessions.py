"""Recorded sessions of the drivers with their devices, and wires that play them back, with a byte changed or not.

``python tests/drivers/sessions.py`` records them anew from the emulated devices. A line of a file is seconds, ``>`` for
the host or ``<`` for the device, and the bytes.
"""

import ast
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "data" / "sessions"
ORIGIN_MM = (-25.0, -10.0, -20.0)
QUESTION = b"?"
TARGETS_MM = ((22.0, 8.0, 18.0), (22.5, 8.0, 17.5))


@dataclass(frozen=True)
class Exchange:
    """What the host wrote, and what the device said until the host wrote again: (seconds later, bytes)."""

    asked: bytes
    replies: tuple[tuple[float, bytes], ...]

    @property
    def said(self) -> bytes:
        return b"".join(data for _, data in self.replies)


Change = Callable[[bytes], bytes]


def load(name: str) -> list[Exchange]:
    exchanges: list[Exchange] = []
    asked_s = 0.0
    for row in (FOLDER / name).read_text(encoding="ascii").splitlines():
        time_s, direction, literal = row.split(" ", 2)
        data: bytes = ast.literal_eval(literal)
        if direction == ">":
            exchanges.append(Exchange(data, ()))
            asked_s = float(time_s)
        else:
            last = exchanges[-1]
            exchanges[-1] = Exchange(last.asked, (*last.replies, (float(time_s) - asked_s, data)))
    return exchanges


def changed(exchanges: list[Exchange], place: int, change: Change) -> list[Exchange]:
    """The byte at ``place`` of all that the device says, changed; ``change`` may drop it."""
    result = list(exchanges)
    for number, exchange in enumerate(exchanges):
        for at, (delay_s, data) in enumerate(exchange.replies):
            if place < len(data):
                spoilt = data[:place] + change(data[place : place + 1]) + data[place + 1 :]
                replies = (*exchange.replies[:at], (delay_s, spoilt), *exchange.replies[at + 1 :])
                result[number] = Exchange(exchange.asked, replies)
                return result
            place -= len(data)
    raise IndexError(place)


def single_changes() -> Iterator[tuple[str, Change]]:
    """Deletion, and the flip of each bit."""
    yield "deleted", lambda byte: b""
    for bit in range(8):
        yield f"bit {bit} flipped", lambda byte, bit=bit: bytes((byte[0] ^ 1 << bit,))


class HandClock:
    def __init__(self) -> None:
        self.time_s = 100.0

    def now_s(self) -> float:
        return self.time_s

    def sleep_s(self, duration_s: float) -> None:
        self.time_s += max(0.0, duration_s)


class PlayedLine:
    """A serial line on which a recorded device answers.

    A question (``?``) that the recording does not have here is answered as the last one was, but never with a spoilt
    answer twice: the wire breaks one byte. Any other line that comes out of its turn is met with silence.
    """

    descriptor = None

    def __init__(
        self, session: list[Exchange], clock: HandClock, whole: list[Exchange], question: bytes = b"?"
    ) -> None:
        self.name = "played:wire"
        self.written: list[bytes] = []
        """What the host wrote, without its questions."""
        self._session, self._whole, self._clock = session, whole, clock
        self._next = 0
        self._last_answer: int | None = None
        self._due: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        turn = self._next
        if data == QUESTION:
            if turn < len(self._session) and self._session[turn].asked == data:
                self._last_answer, self._next = turn, turn + 1
                self._answer(self._session[turn])
            elif self._last_answer is not None:
                self._answer(self._whole[self._last_answer])
            return
        self.written.append(data)
        while turn < len(self._session) and self._session[turn].asked == QUESTION:
            turn += 1
        if turn < len(self._session) and self._session[turn].asked == data:
            self._next = turn + 1
            self._answer(self._session[turn])

    def read(self, timeout_s: float) -> bytes:
        until_s = self._clock.time_s + timeout_s
        if self._due and self._due[0][0] <= until_s:
            due_s, data = self._due.pop(0)
            self._clock.time_s = max(self._clock.time_s, due_s)
            return data
        self._clock.time_s = until_s
        return b""

    def close(self) -> None:
        pass

    def _answer(self, exchange: Exchange) -> None:
        now_s = self._clock.time_s
        self._due += [(now_s + delay_s, data) for delay_s, data in exchange.replies]


class RecordingLine:
    """A line that writes down what passes."""

    def __init__(self, line: Any, clock: Any) -> None:
        self._line, self._clock = line, clock
        self.name, self.descriptor = line.name, None
        self.rows: list[str] = []

    def write(self, data: bytes) -> None:
        self.rows.append(f"{self._clock.now_s():.6f} > {data!r}")
        self._line.write(data)

    def read(self, timeout_s: float) -> bytes:
        data: bytes = self._line.read(timeout_s)
        if data:
            self.rows.append(f"{self._clock.now_s():.6f} < {data!r}")
        return data

    def close(self) -> None:
        self._line.close()

    def save(self, name: str) -> None:
        FOLDER.mkdir(exist_ok=True)
        (FOLDER / name).write_text("\n".join(self.rows) + "\n", encoding="ascii")


def record() -> None:
    from grbl_wire import SETTINGS, Bench

    from drivers.motion.grbl.driver import GrblController
    from drivers.spindle.canbus import SlcanBus
    from drivers.spindle.cia402 import Cia402Spindle
    from firmware_sim.cia402_drive import Cia402Drive
    from firmware_sim.clock import SimClock
    from firmware_sim.lines import InProcessLine
    from firmware_sim.slcan_adapter import SlcanAdapter

    bench = Bench("gnea", SETTINGS)
    line = RecordingLine(InProcessLine(bench.board, bench.clock), bench.clock)
    drive_grbl(GrblController(line, bench.clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=20.0))
    line.save("grbl.txt")

    class Load:
        def turn(self, time_s: float, speed_rpm: float) -> None:
            pass

        def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
            return 0.05

    clock = SimClock()
    adapter = SlcanAdapter([Cia402Drive(Load())])
    clock.attach(adapter.advance_to)
    line = RecordingLine(InProcessLine(adapter, clock), clock)
    spindle = Cia402Spindle(SlcanBus(line, 1_000_000), clock, node_id=1, max_speed_rpm=60_000)
    spindle.start(30_000)
    spindle.status()
    spindle.stop()
    line.save("slcan.txt")


def drive_grbl(controller: Any) -> dict[str, Any]:
    """A session: home, two moves, and what the driver says of them."""
    controller.home()
    ends = []
    for target_mm in TARGETS_MM:
        controller.start_move(target_mm, feed_mm_per_s=15.0)
        ends.append(controller.wait_until_idle(5.0).position_mm)
    return {
        "identity": controller.identity,
        "settings": controller.settings,
        "travel": controller.travel,
        "ends_mm": ends,
    }


if __name__ == "__main__":
    sys.exit(record())
