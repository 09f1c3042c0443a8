"""How the g2core board of the bench is set, and which of the bench's faults it can have."""

from collections.abc import Mapping, Sequence
from typing import Final

from drivers.errors import ConfigError
from firmware_sim.faults import Fault
from firmware_sim.mechanics import Mechanics
from firmware_sim.tinyg_board import TinyGBoard
from firmware_sim.tinyg_states import ALARMS

FIRMWARE: Final = "101."
"""What its build begins with."""
MECHANICAL_SETTINGS: Final[Mapping[str, float]] = {
    "sl": 1, "lim": 1,
    "xtn": -35, "ytn": -40, "ztn": -28, "xtm": -1, "ytm": -1, "ztm": -1,
    "xvm": 1200, "yvm": 1200, "zvm": 1200, "xfr": 1200, "yfr": 1200, "zfr": 1200,
    "xjm": 10800, "yjm": 10800, "zjm": 10800,
    "1sa": 1.8, "2sa": 1.8, "3sa": 1.8, "1mi": 8, "2mi": 8, "3mi": 8, "1tr": 1.6, "2tr": 1.6, "3tr": 1.6,
}  # fmt: skip
"""What a host may expect to read back: limits on, mm of travel, mm/min, millions of mm/min3, and 1000 steps/mm."""
_COMMISSIONING: Final = {
    f"{axis}{name}": value for name, value in {"sv": 1200, "lv": 120, "lb": 2, "zb": 1}.items() for axis in "xyz"
}


def new_board(mechanics: Mechanics) -> TinyGBoard:
    """The board of the bench, just switched on."""
    return TinyGBoard(mechanics, settings={**MECHANICAL_SETTINGS, **_COMMISSIONING})


def check_faults(faults: Sequence[Fault]) -> None:
    """Refuse what this board cannot have.

    Raises:
        ConfigError: naming the fault and what may be planted instead.
    """
    for fault in faults:
        if fault.name == "motion.alarm" and round(fault.value) not in ALARMS:
            raise ConfigError(
                f"fault {fault}: the g2core board has alarms 1 (limit switch) and 2 (soft limit); plant one of them"
            )
        if fault.name == "motion.firmware" and not fault.word.replace(".", "").isdigit():
            raise ConfigError(f"fault {fault}: builds of g2core are numbers; plant one such as motion.firmware=100.26")
