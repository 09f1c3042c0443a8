"""What emulated devices have answered in a session of each make: inputs for ``fuzz.py``."""

from collections.abc import Sequence
from functools import cache

from tinyg_wire import Axes, Bench

from drivers.motion.bcap.driver import BcapController
from drivers.motion.interface import Travel
from drivers.spindle.modbus import ModbusSpindle
from firmware_sim.bcap_controller import RcController
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine, MotionBoard
from firmware_sim.modbus_drive import ModbusDrive


class KeptLine(InProcessLine):
    """Keeps what was read, each datagram or all that came between two writes, once."""

    def __init__(self, board: MotionBoard, clock: SimClock, *, datagrams: bool) -> None:
        super().__init__(board, clock)
        self._datagrams = datagrams
        self._answers = [b""]

    @property
    def said(self) -> Sequence[bytes]:
        return list(dict.fromkeys(filter(None, self._answers)))

    def write(self, data: bytes) -> None:
        self._answers.append(b"")
        super().write(data)

    def read(self, timeout_s: float) -> bytes:
        data = super().read(timeout_s)
        if self._datagrams:
            self._answers.append(data)
        else:
            self._answers[-1] += data
        return data


class _Load:
    def turn(self, time_s: float, speed_rpm: float) -> None:
        pass

    def torque_fraction(self, time_s: float, speed_rpm: float) -> float:
        return 0.1


@cache
def bcap_replies() -> Sequence[bytes]:
    """Datagrams: opening, homing, one move, closing."""
    clock = SimClock()
    board = RcController(Axes())
    clock.attach(board.advance_to)
    line = KeptLine(board, clock, datagrams=True)
    travel = Travel((-10.0, -30.0, -8.0), (24.5, 9.5, 19.5))
    with BcapController(
        line, clock, origin_mm=(326.0, -129.0, 221.0), orientation_deg=(180.0, 0.0, 180.0), travel=travel,
        max_feed_mm_per_s=20.0,
    ) as robot:  # fmt: skip
        robot.home()
        robot.start_move((22.0, 8.0, 18.0), feed_mm_per_s=20.0)
        robot.wait_until_idle(5.0)
    return line.said


@cache
def g2core_answers() -> Sequence[bytes]:
    """Pieces of the stream: opening, homing, one move."""
    bench, said = Bench(), dict[bytes, None]()

    def keep(data: bytes) -> bytes:
        if data:
            said[data] = None
        return data

    bench.line.to_host = keep
    controller = bench.homed()
    controller.start_move((20.0, 0.0, 15.0), feed_mm_per_s=20.0)
    controller.wait_until_idle(5.0)
    return list(said)


@cache
def modbus_replies() -> Sequence[bytes]:
    """Frames: opening, running up, stopping."""
    clock = SimClock()
    drive = ModbusDrive(_Load())
    clock.attach(drive.advance_to)
    line = KeptLine(drive, clock, datagrams=False)
    with ModbusSpindle(
        line, clock, max_speed_rpm=60_000, rated_current_a=3.0, baud=115_200, frequency_unit_hz=0.1, heartbeat_s=0.3
    ) as spindle:
        spindle.start(20_000)
        spindle.wait_until_at_speed(10.0)
    return line.said
