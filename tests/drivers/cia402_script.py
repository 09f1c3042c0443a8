"""A CAN bus that plays a table: what the host must send, in this order, and what a drive answers to each frame."""

from collections import deque

import can

from drivers.spindle.cia402 import Cia402Spindle

Frame = tuple[int, bytes]


def frame(text: str) -> Frame:
    """ "201 0F 00" is identifier 201h with two bytes."""
    can_id, *data = text.split()
    return int(can_id, 16), bytes.fromhex("".join(data))


def show(can_id: int, data: bytes) -> str:
    return f"{can_id:03X} {data.hex(' ').upper()}".strip()


class HandClock:
    def __init__(self) -> None:
        self.time_s = 50.0

    def now_s(self) -> float:
        return self.time_s

    def sleep_s(self, duration_s: float) -> None:
        self.time_s += max(0.0, duration_s)


class ScriptedBus(can.BusABC):
    """Rows are "host frame > answer | answer"; without a row left, ``always`` answers, and nothing else is allowed."""

    def __init__(self, clock: HandClock, rows: str = "", always: str = "") -> None:
        self.channel_info = "script"
        self.clock = clock
        self.rows = deque(self._parse(rows))
        self.always = dict(self._parse(always))
        self.sent: list[str] = []
        self.arrived: deque[can.Message | Exception] = deque()
        super().__init__(channel="script")

    @staticmethod
    def _parse(text: str) -> list[tuple[Frame, list[Frame]]]:
        rows = []
        for line in text.strip().splitlines():
            host, _, answers = line.partition("#")[0].partition(">")
            if host.strip():
                rows.append((frame(host), [frame(answer) for answer in answers.split("|") if answer.strip()]))
        return rows

    def play(self, rows: str, always: str = "") -> None:
        """Go on with another table."""
        assert not self.rows, f"never sent: {show(*self.rows[0][0])}"
        self.rows = deque(self._parse(rows))
        self.always = dict(self._parse(always))

    def arrive(self, text: str, *, is_error_frame: bool = False) -> None:
        """A frame that nobody asked for."""
        can_id, data = frame(text)
        self.arrived.append(
            can.Message(arbitration_id=can_id, data=data, is_extended_id=False, is_error_frame=is_error_frame)
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        sent = (msg.arbitration_id, bytes(msg.data))
        self.sent.append(show(*sent))
        if self.rows and (sent == self.rows[0][0] or sent not in self.always):
            expected, answers = self.rows.popleft()
            assert sent == expected, f"sent {show(*sent)}, the table says {show(*expected)}"
        else:
            assert sent in self.always, f"{show(*sent)} is in no table"
            answers = self.always[sent]
        for can_id, data in answers:
            self.arrived.append(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if not self.arrived:
            self.clock.sleep_s(timeout or 0.0)
            return None
        arrived = self.arrived.popleft()
        if isinstance(arrived, Exception):
            raise arrived
        return arrived


OPENING = """
000 80 01                                                          # NMT: enter pre-operational
601 40 00 10 00 00 00 00 00 > 581 43 00 10 00 92 01 02 00          # is anybody there
601 40 00 10 00 00 00 00 00 > 581 43 00 10 00 92 01 02 00          # device type: 402, servo drive
601 2B 40 60 00 02 00 00 00 > 581 60 40 60 00 00 00 00 00          # controlword: quick stop
601 40 08 10 00 00 00 00 00 > 581 41 08 10 00 09 00 00 00          # device name: nine bytes, in segments
601 60 00 00 00 00 00 00 00 > 581 00 47 65 6E 65 72 69 63
601 70 00 00 00 00 00 00 00 > 581 1B 20 31 00 00 00 00 00
601 40 18 10 01 00 00 00 00 > 581 43 18 10 01 FB 00 00 00          # vendor
601 40 18 10 02 00 00 00 00 > 581 43 18 10 02 00 00 51 60          # product
601 40 18 10 03 00 00 00 00 > 581 80 18 10 03 11 00 09 06          # no revision
601 40 18 10 04 00 00 00 00 > 581 43 18 10 04 39 30 00 00          # serial number
601 40 80 60 00 00 00 00 00 > 581 43 80 60 00 50 C3 00 00          # motor: 50000 rpm at most
601 40 7F 60 00 00 00 00 00 > 581 80 7F 60 00 00 00 02 06          # no profile limit
601 40 02 65 00 00 00 00 00 > 581 43 02 65 00 04 00 00 00          # supported modes: profile velocity
601 40 A9 60 00 00 00 00 00 > 581 43 A9 60 00 00 47 B4 00          # velocity unit: rpm
601 2F 60 60 00 03 00 00 00 > 581 60 60 60 00 00 00 00 00          # mode: profile velocity
601 40 61 60 00 00 00 00 00 > 581 4F 61 60 00 00 00 00 00          # not yet
601 40 61 60 00 00 00 00 00 > 581 4F 61 60 00 03 00 00 00
601 23 83 60 00 A0 86 01 00 > 581 60 83 60 00 00 00 00 00          # ramps: 100000 rpm/s up
601 40 83 60 00 00 00 00 00 > 581 43 83 60 00 A0 86 01 00
601 23 84 60 00 A0 86 01 00 > 581 60 84 60 00 00 00 00 00          # and down
601 40 84 60 00 00 00 00 00 > 581 43 84 60 00 A0 86 01 00
601 23 85 60 00 20 A1 07 00 > 581 60 85 60 00 00 00 00 00          # quick stop: 500000 rpm/s
601 40 85 60 00 00 00 00 00 > 581 43 85 60 00 20 A1 07 00
601 2B 07 60 00 03 00 00 00 > 581 60 07 60 00 00 00 00 00          # abort connection: quick stop
601 40 07 60 00 00 00 00 00 > 581 4B 07 60 00 03 00 00 00
601 40 5A 60 00 00 00 00 00 > 581 4B 5A 60 00 06 00 00 00          # quick stop option
601 2B 5A 60 00 02 00 00 00 > 581 60 5A 60 00 00 00 00 00          # ramp down, then switch on disabled
601 40 5A 60 00 00 00 00 00 > 581 4B 5A 60 00 02 00 00 00
601 40 29 10 01 00 00 00 00 > 581 80 29 10 01 00 00 02 06          # no error behaviour object
601 2B 17 10 00 7D 00 00 00 > 581 60 17 10 00 00 00 00 00          # the drive's heartbeat: 125 ms
601 40 17 10 00 00 00 00 00 > 581 4B 17 10 00 7D 00 00 00
601 23 16 10 01 FA 00 7F 00 > 581 60 16 10 01 00 00 00 00          # watches node 127, 250 ms
601 40 16 10 01 00 00 00 00 > 581 43 16 10 01 FA 00 7F 00
601 40 01 18 01 00 00 00 00 > 581 43 01 18 01 81 02 00 40          # TPDO2 is on: off
601 23 01 18 01 81 02 00 C0 > 581 60 01 18 01 00 00 00 00
601 40 02 18 01 00 00 00 00 > 581 43 02 18 01 81 03 00 C0          # TPDO3 is off
601 40 03 18 01 00 00 00 00 > 581 80 03 18 01 00 00 02 06          # no TPDO4
601 40 00 18 01 00 00 00 00 > 581 43 00 18 01 81 01 00 40          # TPDO1
601 23 00 18 01 81 01 00 C0 > 581 60 00 18 01 00 00 00 00          # off
601 2F 00 18 02 01 00 00 00 > 581 60 00 18 02 00 00 00 00          # at each SYNC
601 40 00 18 02 00 00 00 00 > 581 4F 00 18 02 01 00 00 00
601 2F 00 1A 00 00 00 00 00 > 581 60 00 1A 00 00 00 00 00          # map cleared
601 23 00 1A 01 10 00 41 60 > 581 60 00 1A 01 00 00 00 00          # statusword
601 40 00 1A 01 00 00 00 00 > 581 43 00 1A 01 10 00 41 60
601 23 00 1A 02 20 00 6C 60 > 581 60 00 1A 02 00 00 00 00          # velocity actual value
601 40 00 1A 02 00 00 00 00 > 581 43 00 1A 02 20 00 6C 60
601 23 00 1A 03 10 00 77 60 > 581 60 00 1A 03 00 00 00 00          # torque actual value
601 40 00 1A 03 00 00 00 00 > 581 43 00 1A 03 10 00 77 60
601 2F 00 1A 00 03 00 00 00 > 581 60 00 1A 00 00 00 00 00
601 40 00 1A 00 00 00 00 00 > 581 4F 00 1A 00 03 00 00 00
601 23 00 18 01 81 01 00 40 > 581 60 00 18 01 00 00 00 00          # on
601 40 00 18 01 00 00 00 00 > 581 43 00 18 01 81 01 00 40
601 40 00 14 01 00 00 00 00 > 581 43 00 14 01 01 02 00 00          # RPDO1
601 23 00 14 01 01 02 00 80 > 581 60 00 14 01 00 00 00 00
601 2F 00 14 02 FF 00 00 00 > 581 60 00 14 02 00 00 00 00          # at once
601 40 00 14 02 00 00 00 00 > 581 4F 00 14 02 FF 00 00 00
601 2F 00 16 00 00 00 00 00 > 581 60 00 16 00 00 00 00 00
601 23 00 16 01 10 00 40 60 > 581 60 00 16 01 00 00 00 00          # controlword
601 40 00 16 01 00 00 00 00 > 581 43 00 16 01 10 00 40 60
601 23 00 16 02 20 00 FF 60 > 581 60 00 16 02 00 00 00 00          # target velocity
601 40 00 16 02 00 00 00 00 > 581 43 00 16 02 20 00 FF 60
601 2F 00 16 00 02 00 00 00 > 581 60 00 16 00 00 00 00 00
601 40 00 16 00 00 00 00 00 > 581 4F 00 16 00 02 00 00 00
601 23 00 14 01 01 02 00 00 > 581 60 00 14 01 00 00 00 00
601 40 00 14 01 00 00 00 00 > 581 43 00 14 01 01 02 00 00
000 01 01                                                          # NMT: start
201 02 00 00 00 00 00                                              # quick stop
080 > 181 40 02 00 00 00 00 00 00                                  # switch on disabled, standing
601 23 16 10 01 00 00 00 00 > 581 60 16 10 01 00 00 00 00          # watches nobody
601 40 16 10 01 00 00 00 00 > 581 43 16 10 01 00 00 00 00
"""
"""Node 1, 60000 rpm asked for, heartbeat 250 ms; typed from CiA 301 and CiA 402."""

WATCH = """
601 23 16 10 01 FA 00 7F 00 > 581 60 16 10 01 00 00 00 00          # watches node 127 again
601 40 16 10 01 00 00 00 00 > 581 43 16 10 01 FA 00 7F 00
77F 05                                                             # the first beat
"""

STARTING = (
    """
000 01 01
080 > 181 40 02 00 00 00 00 00 00                                  # no fault
"""
    + WATCH
    + """
080 > 181 40 02 00 00 00 00 00 00                                  # switch on disabled
201 06 00 00 00 00 00                                              # shutdown
080 > 181 21 02 00 00 00 00 00 00                                  # ready to switch on
201 07 00 00 00 00 00                                              # switch on
080 > 181 23 02 00 00 00 00 00 00                                  # switched on
201 0F 00 30 75 00 00                                              # enable operation, 30000 rpm
080 > 181 27 02 00 00 00 00 00 00                                  # operation enabled
201 0F 00 30 75 00 00
"""
)
"""``start(30000)`` from standstill."""

RUNNING = "080 > 181 27 06 30 75 00 00 64 00"  # target reached, 30000 rpm, 10 % torque
STANDING = "080 > 181 40 02 00 00 00 00 00 00"
BEAT = "77F 05"


def opened() -> tuple[Cia402Spindle, ScriptedBus, HandClock]:
    clock = HandClock()
    bus = ScriptedBus(clock, OPENING)
    spindle = Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=60_000)
    assert not bus.rows
    return spindle, bus, clock


def started() -> tuple[Cia402Spindle, ScriptedBus, HandClock]:
    spindle, bus, clock = opened()
    bus.play(STARTING, always=BEAT)
    spindle.start(30_000)
    bus.play("", always=f"{RUNNING}\n{BEAT}\n201 02 00 00 00 00 00")
    return spindle, bus, clock
