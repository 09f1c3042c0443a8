"""The virtual bench: one world with its motion board, spindle drive, CAN adapter and cameras."""

import zlib
from collections.abc import Mapping
from functools import cached_property
from typing import Any, Final, Literal

from firmware_sim.can_wire import CanWire
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.clock import TICK_S, SimClock
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.lines import InProcessBus, InProcessLine, InProcessSource, in_process_sources
from firmware_sim.machine import Machine
from firmware_sim.microscope import Microscope
from firmware_sim.slcan_adapter import SlcanAdapter
from firmware_sim.specimen import Specimen, draw_specimen

Dialect = Literal["gnea", "grblhal"]

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
_COMMISSIONING: Final[Mapping[str, float]] = {"$24": 120, "$25": 1200}
_DIALECT_SETTINGS: Final[Mapping[Dialect, Mapping[str, float]]] = {"gnea": {"$10": 3}, "grblhal": {}}


class Bench:
    """Every board of the bench, on one time.

    Left out: power switches, the operator's hands, temperature, and cables that fail.
    """

    def __init__(self, specimen: Specimen | None = None, *, dialect: Dialect = "gnea", seed: int = 0) -> None:
        """A bench that was just switched on; without a specimen, one is drawn from ``seed``."""
        self.specimen = draw_specimen(seed) if specimen is None else specimen
        self.machine = Machine(self.specimen)
        settings = {**MECHANICAL_SETTINGS, **_COMMISSIONING, **_DIALECT_SETTINGS[dialect]}
        self.board = GrblBoard(self.machine, dialect=dialect, settings=settings)
        self.board.commission(f"mill-bench-{self.serial_number}")
        self.drive = Cia402Drive(
            self.machine, node_id=NODE_ID, max_speed_rpm=MAX_SPEED_RPM, serial_number=self.serial_number
        )
        self.can = CanWire([self.drive])
        self.adapter = SlcanAdapter(self.can)
        self.now_s = 0.0

    @property
    def serial_number(self) -> int:
        """Of every device of this rig; another rig has others, and a calibration holds for one rig only."""
        return zlib.crc32(self.specimen.rig.model_dump_json().encode()) % 1_000_000

    @cached_property
    def microscope(self) -> Microscope:
        """Both pictures; made on first use, because its first picture takes a while."""
        return Microscope(self.machine)

    def advance_to(self, time_s: float) -> None:
        """Let everything go on until ``time_s``, in ticks of at most 2 ms."""
        while self.now_s < time_s:
            self.now_s = min(time_s, self.now_s + TICK_S)
            self.board.advance_to(self.now_s)
            self.adapter.advance_to(self.now_s)
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
    bench: Bench, clock: SimClock, *, fps: float = 30.0
) -> tuple[InProcessLine, InProcessBus, InProcessSource, InProcessSource]:
    """The bench's four wires on a virtual clock, for the drivers: serial line, CAN bus, left and right eye."""
    clock.attach(bench.advance_to)
    left, right = in_process_sources(bench.microscope, clock, fps=fps, name=str(bench.serial_number))
    return InProcessLine(bench.board, clock), InProcessBus(bench.can, clock), left, right
