"""What the machine does about a failure: the first one is kept, and nothing later softens it.

Standard library only.
"""

from dataclasses import dataclass
from enum import IntEnum

from drivers.errors import SafetyStop


class Reaction(IntEnum):
    """What the machine does about a failure; a later, harder one never softens an earlier one."""

    NONE = 0
    HOLD = 1
    """Feed hold, then 50-200 um up: dwelling on the membrane tears it."""
    RETRACT = 2
    """At least 1 mm up, confirmed, then the spindle off, confirmed."""
    KILL = 3
    """Spindle off and controller reset together; the position is lost."""


@dataclass
class Latch:
    """The first failure, kept; what comes later may only make the reaction harder."""

    reaction: Reaction = Reaction.NONE
    reason: str = ""

    def trip(self, reaction: Reaction, reason: str) -> None:
        """Latch a failure."""
        if not self.reason:
            self.reason = reason
        self.reaction = max(self.reaction, reaction)


def reaction_to(error: BaseException) -> Reaction:
    """The first reaction to an error or to a person's interrupt.

    Retract needs a trusted position and a controller that answers. Only the controller knows, so a retract that
    it refuses becomes a kill.
    """
    return Reaction.HOLD if isinstance(error, SafetyStop) else Reaction.RETRACT
