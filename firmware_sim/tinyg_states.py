"""The words that the parts of the emulated g2core board share."""

from enum import Enum, auto

UNSUPPORTED_TYPE, NOT_ACCEPTED, SYNTAX_ERROR = 103, 106, 111
LIMIT_HIT, REJECTED, KILLED, SOFT_LIMIT, LAST_SOFT_LIMIT, HOMING_FAILED = 203, 204, 207, 220, 233, 240
ALARMS = {1: LIMIT_HIT, 2: SOFT_LIMIT}
"""By the numbers that the bench's faults have for them."""


def exception_words(status: int) -> str:
    """What an exception report calls a status."""
    if SOFT_LIMIT <= status <= LAST_SOFT_LIMIT:
        return "Soft limit"
    return {LIMIT_HIT: "Limit hit", KILLED: "Kill job"}.get(status, "System alarm")


class State(Enum):
    """What the machine does, when nothing moves."""

    READY = 1
    ALARM = 2
    STOP = 3
    END = 4


class Exit(Enum):
    """What follows when a feed hold stands."""

    WAIT = auto()
    KILL = auto()
    ALARM = auto()
