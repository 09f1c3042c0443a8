"""The words that the parts of the emulated firmware share."""

from collections.abc import Generator
from enum import Enum, IntEnum, auto

Waits = Generator[float | None, None, None]
"""A part of the program that may wait."""
HomingPart = Generator[float | None, None, "Alarm | None"]
"""A part of homing, with its alarm if it fails."""


class State(Enum):
    """What the board says it is."""

    __hash__ = object.__hash__  # Enum's own is in Python, and sets of these are asked for ten thousand times a second.

    IDLE = "Idle"
    ALARM = "Alarm"
    CHECK = "Check"
    HOME = "Home"
    RUN = "Run"
    HOLD = "Hold"
    JOG = "Jog"
    DOOR = "Door"
    SLEEP = "Sleep"


class Flag(Enum):
    """What interrupts ask of the program."""

    __hash__ = object.__hash__

    RESET = auto()
    STATUS = auto()
    CYCLE_START = auto()
    CYCLE_STOP = auto()
    HOLD = auto()
    DOOR = auto()
    MOTION_CANCEL = auto()
    SLEEP = auto()


class Aborted(Exception):  # noqa: N818  (not an error: a reset takes the program back to its start)
    """A reset has been asked for; the line in hand is still answered, with ok."""


class Alarm(IntEnum):
    """Alarm codes."""

    HARD_LIMIT = 1
    SOFT_LIMIT = 2
    ABORTED = 3
    PROBE_START = 4
    PROBE_END = 5
    HOMING_RESET = 6
    HOMING_DOOR = 7
    HOMING_PULL_OFF = 8
    HOMING_APPROACH = 9


class Suspend:
    """Why the program waits in mid-motion, and how far the way down has come."""

    def __init__(self) -> None:
        self.active = False
        self.complete = False
        self.motion_cancel = False
        self.jog_cancel = False
        self.restoring = False
        self.told = False
        """What happens once at standstill (spindle off, a message) has happened."""
