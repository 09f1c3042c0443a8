"""The virtual bench: one world with its motion board, spindle drive, CAN adapter and cameras."""

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Final, Literal

from drivers.errors import ConfigError, ConnectionLostError
from firmware_sim import tinyg_bench
from firmware_sim.bcap_controller import POWER_UP_POSE, RcController
from firmware_sim.can_wire import CanWire
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.clock import TICK_S, SimClock
from firmware_sim.faults import Fault
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.lines import InProcessBus, InProcessLine, InProcessSource, in_process_sources
from firmware_sim.machine import POWER_UP_TIP_MM, Machine
from firmware_sim.microscope import EachEye, Image, Microscope, Shot
from firmware_sim.modbus_drive import ModbusDrive
from firmware_sim.sabotage import Sabotage
from firmware_sim.slcan_adapter import SlcanAdapter
from firmware_sim.specimen import Specimen, draw_specimen
from firmware_sim.spindle_motor import SpindleMotor
from firmware_sim.tinyg_board import TinyGBoard

Dialect = Literal["gnea", "grblhal"]
MotionMake = Literal["grbl", "tinyg", "bcap"]
SpindleMake = Literal["cia402", "modbus", "grbl"]

ORIGIN_MM: Final = (-25.0, -10.0, -20.0)
"""Where the board's machine coordinates put the origin of {R}: machine zero is at the home switches."""
PARK_MM: Final = (23.0, -10.0, 12.0)
NODE_ID: Final = 1
MAX_SPEED_RPM: Final = 60_000
MAX_FEED_MM_S: Final = 20.0

MECHANICAL_SETTINGS: Final[Mapping[str, float]] = {
    "$20": 1, "$21": 1, "$22": 1, "$23": 0, "$27": 1,
    "$100": 1000, "$101": 1000, "$102": 1000,
    "$110": 1200, "$111": 1200, "$112": 1200,
    "$120": 500, "$121": 500, "$122": 500,
    "$130": 35, "$131": 40, "$132": 28,
}  # fmt: skip
"""What a host may expect to read back: limits and homing on, steps/mm, mm/min, mm/s2, mm of travel."""
_COMMISSIONING: Final[Mapping[str, float]] = {"$1": 255, "$24": 120, "$25": 1200}
"""Motors that stay on at standstill (their release costs 25 ms a move, and holds nothing); homing feeds."""
FIRMWARE: Final[Mapping[Dialect, str]] = {"gnea": "1.1h", "grblhal": "1.1f"}
"""What the version of the motion board begins with."""
ROBOT_ORIGIN_MM: Final = (
    POWER_UP_POSE[0] - POWER_UP_TIP_MM[0],
    POWER_UP_POSE[1] - POWER_UP_TIP_MM[1],
    POWER_UP_POSE[2] - POWER_UP_TIP_MM[2],
)
"""Where the origin of {R} is in the frame of the robot."""
ROBOT_ORIENTATION_DEG: Final = (POWER_UP_POSE[3], POWER_UP_POSE[4], POWER_UP_POSE[5])
ROBOT_TRAVEL_LOW_MM: Final = (-10.0, -30.0, -8.0)
ROBOT_TRAVEL_HIGH_MM: Final = (24.0, 9.0, 19.0)
_DIALECT_SETTINGS: Final[Mapping[Dialect, Mapping[str, float]]] = {"gnea": {"$10": 3}, "grblhal": {}}


class Bench:
    """Every board of the bench, on one time.

    Left out: power switches, the operator's hands, and temperature.
    """

    def __init__(
        self,
        specimen: Specimen | None = None,
        *,
        motion: MotionMake = "grbl",
        dialect: Dialect = "gnea",
        spindle: SpindleMake = "cia402",
        seed: int = 0,
        faults: Sequence[Fault] = (),
    ) -> None:
        """A bench that was just switched on; without a specimen, one is drawn from ``seed``.

        ``dialect`` is the firmware of a GRBL board, and of no other.

        Raises:
            ConfigError: a fault or a spindle that this make of motion controller cannot have.
        """
        self.specimen = draw_specimen(seed) if specimen is None else specimen
        self.dialect: Dialect = dialect
        self.spindle: SpindleMake = spindle
        self.machine = Machine(self.specimen)
        self.motion: MotionMake = motion
        if spindle == "grbl" and motion != "grbl":
            raise ConfigError(f"spindle grbl: is on a GRBL board, found motion {motion}; choose another spindle")
        self.board = self._motion_board()
        self.board.commission(f"mill-bench-{self.serial_number}")
        self.drive = Cia402Drive(
            self.machine, node_id=NODE_ID, max_speed_rpm=MAX_SPEED_RPM, serial_number=self.serial_number
        )
        self.can = CanWire([self.drive])
        self.adapter = SlcanAdapter(self.can)
        self.inverter = ModbusDrive(self.machine)
        self.motor = SpindleMotor(self.machine)
        """Only the drive that ``spindle`` names is switched on."""
        self.now_s = 0.0
        self._sabotage: Sabotage | None = None
        if faults:
            self.plant(faults)

    def _motion_board(self) -> GrblBoard | TinyGBoard | RcController:
        if self.motion == "tinyg":
            return tinyg_bench.new_board(self.machine)
        if self.motion == "bcap":
            return RcController(self.machine)
        settings = {**MECHANICAL_SETTINGS, **_COMMISSIONING, **_DIALECT_SETTINGS[self.dialect]}
        if self.spindle == "grbl":
            settings |= {"$30": MAX_SPEED_RPM, "$31": 0, "$32": 0}
        return GrblBoard(self.machine, dialect=self.dialect, settings=settings)

    @property
    def motion_settings(self) -> Mapping[str, float]:
        """What a host may expect to read back from the motion board."""
        return {"grbl": MECHANICAL_SETTINGS, "tinyg": tinyg_bench.MECHANICAL_SETTINGS, "bcap": {}}[self.motion]

    @property
    def motion_firmware(self) -> str:
        """What the version of the motion board begins with."""
        return {"grbl": FIRMWARE[self.dialect], "tinyg": tinyg_bench.FIRMWARE, "bcap": ""}[self.motion]

    @property
    def serial_number(self) -> int:
        """Of every device of this rig; another rig has others, and a calibration holds for one rig only."""
        return zlib.crc32(self.specimen.rig.model_dump_json().encode()) % 1_000_000

    @property
    def spindle_drive(self) -> Cia402Drive | ModbusDrive | SpindleMotor:
        """What turns the drill."""
        drives: dict[SpindleMake, Cia402Drive | ModbusDrive | SpindleMotor] = {
            "cia402": self.drive,
            "modbus": self.inverter,
            "grbl": self.motor,
        }
        return drives[self.spindle]

    @property
    def spindle_port(self) -> SlcanAdapter | ModbusDrive | None:
        """What hangs on the spindle's serial port; None where the motion board has the drill."""
        if self.spindle == "grbl":
            return None
        return self.adapter if self.spindle == "cia402" else self.inverter

    def plant(self, faults: Sequence[Fault]) -> None:
        """Break it, once; what has no time of its own is broken from now on.

        Raises:
            ConfigError: its motion board cannot have this fault, or it has not the wire.
        """
        if self.motion == "tinyg":
            tinyg_bench.check_faults(faults)
        if self.spindle != "cia402" and (lost := [fault for fault in faults if fault.name.startswith("can.")]):
            raise ConfigError(f"fault {lost[0]}: a bench with a {self.spindle} spindle has no CAN bus")
        self._sabotage = Sabotage(self, tuple(faults), seed=self.specimen.seed)
        self.can.carried = self._sabotage.carried

    @cached_property
    def microscope(self) -> Microscope:
        """Both pictures; made on first use, because its first picture takes a while."""
        return Microscope(self.machine)

    def receive(self, data: bytes) -> None:
        """What the host sends to the motion port: bytes, or one datagram.

        Raises:
            ConnectionLostError: somebody has pulled its plug.
        """
        self._require_plug()
        self.board.receive(data if self._sabotage is None else self._sabotage.from_host(data))

    def transmit(self) -> bytes:
        """What the motion port sends to the host: the bytes since the last call, or the next datagram.

        Raises:
            ConnectionLostError: somebody has pulled its plug.
        """
        self._require_plug()
        data = self.board.transmit()
        return data if self._sabotage is None else self._sabotage.to_host(data)

    @property
    def unplugged(self) -> bool:
        """Whether somebody has pulled the motion port's plug."""
        return self._sabotage is not None and self._sabotage.unplugged

    @property
    def port_held(self) -> bool:
        """Whether another program has the motion port."""
        return self._sabotage is not None and self._sabotage.port_held

    def _require_plug(self) -> None:
        if self.unplugged:
            raise ConnectionLostError("in-process:motion: the other side is gone; plug it in and home again")

    def shoot(
        self, time_s: float, *, each: EachEye = map, render: Callable[[float], tuple[Image, Image]] | None = None
    ) -> Shot | None:
        """Both pictures as the cameras give them; None where they give none.

        ``each`` draws the eyes side by side; ``render`` stands where the microscope stands.
        """

        def pictures() -> tuple[Image, Image]:
            return self.microscope.render(time_s, each=each) if render is None else render(time_s)

        return Shot(*pictures()) if self._sabotage is None else self._sabotage.shoot(pictures, time_s)

    def advance_to(self, time_s: float) -> None:
        """Let everything go on until ``time_s``, in ticks of at most 2 ms."""
        while self.now_s < time_s:
            self.now_s = min(time_s, self.now_s + TICK_S)
            if self._sabotage is not None:
                self._sabotage.advance_to(self.now_s)
            self.board.advance_to(self.now_s)
            if self.spindle_port is None:
                assert isinstance(self.board, GrblBoard)
                self.motor.advance_to(self.now_s, self.board.spindle_rpm)
            else:
                self.spindle_port.advance_to(self.now_s)
            self.machine.advance_to(self.now_s)

    @property
    def depth_mm(self) -> float:
        """How deep the ball is below the uncut surface; negative above it, NaN beside the skull."""
        x, y, z = self.machine.ball_center_mm
        skull = self.machine.skull
        return float(skull.grid.sample(skull.outer_z, x, y)) - float(z) + self.specimen.tool.ball_radius_mm

    def truth(self) -> dict[str, Any]:
        """What only a scorer may know, ready for JSON; lengths in {R}, times of the bench."""
        truth = self.machine.truth()
        left_px, right_px = self.microscope.project(self.machine.ball_center_mm[None, :])
        return {
            "time_s": self.now_s,
            "tip_mm": self.machine.tip_mm.tolist(),
            "ball_px": {"left": left_px[0].tolist(), "right": right_px[0].tolist()},
            "spindle_rpm": self.machine.spindle_rpm,
            "success": truth.success,
            "flap_free": truth.flap_free,
            "membrane_touched": truth.membrane_touched,
            "membrane_touched_at_s": truth.membrane_touched_at_s,
            "membrane_touched_mm": truth.membrane_touched_mm,
            "membrane_overrun_mm": truth.membrane_overrun_mm,
            "heat_rise_c": truth.heat_rise_c,
            "greatest_force_n": truth.greatest_force_n,
            "ring": {
                "center_mm": truth.center_mm,
                "radius_mm": truth.radius_mm,
                "angles_rad": truth.angles_rad.tolist(),
                "completion": truth.completion.tolist(),
                "depth_mm": truth.depth_mm.tolist(),
            },
        }


def open_in_process(
    bench: Bench,
    clock: SimClock,
    *,
    fps: float = 30.0,
    render: Callable[[float], tuple[Image, Image]] | None = None,
) -> tuple[InProcessLine, InProcessBus, InProcessSource, InProcessSource]:
    """The bench's four wires on a virtual clock, for the drivers: motion line, CAN bus, left and right eye.

    ``render`` stands where the microscope stands.
    """

    def shoot(time_s: float) -> Shot | None:
        return bench.shoot(time_s, render=render)

    clock.attach(bench.advance_to)
    left, right = in_process_sources(shoot, clock, fps=fps, name=str(bench.serial_number))
    return InProcessLine(bench, clock), InProcessBus(bench.can, clock), left, right
