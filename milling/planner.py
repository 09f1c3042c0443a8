"""How fast each point asks to go deeper: the paper's velocity damper, bounded.

    z_i(t + T) = z_i(t) - T v_max (1 - c_i(t))

T is one lap. A proportional damper alone never arrives (with 80 um bites on 400 um of bone, 17 laps leave 10 um), so
policy ``default`` keeps a least bite as long as there is permission, and bounds the bite by the removal rate. A bite
that was not granted is lost: a late lap is never caught up.

Policies ``paper`` and ``previous`` repeat published systems, for comparison on the virtual bench: they descend unless
the picture says "done", without contact, without permission, and a completion of 0.95 counts as 1.
"""

from dataclasses import dataclass
from typing import Protocol

from milling.job import Job

_PAPER_V_MAX_MM_S = 0.012
_PAPER_DONE = 0.95
_LEAST_BITE_MM = 0.012
_FULL_BITE_UNTIL = 0.85


class Policy(Protocol):
    """Asks for a bite; whether it is given is not the policy's business."""

    @property
    def guarded(self) -> bool:
        """Whether contact, permission and the verify pass apply."""

    @property
    def flat_start(self) -> bool:
        """Whether every point starts at one height, above the highest of the ring."""

    def bite_mm(self, completion: float) -> float:
        """The bite asked for at a point of this completion, at its next visit."""


@dataclass(frozen=True)
class Damper:
    """Policy ``default``: full bites until the picture sees bone thin out, then damped, never below a least bite."""

    most_mm: float
    least_mm: float = _LEAST_BITE_MM
    guarded: bool = True
    flat_start: bool = False

    def bite_mm(self, completion: float) -> float:
        """T v_max (1 - c) with T v_max such that the bound is met at ``_FULL_BITE_UNTIL``."""
        damped = self.most_mm * (1.0 - completion) / (1.0 - _FULL_BITE_UNTIL)
        return min(self.most_mm, max(min(self.least_mm, self.most_mm), damped))


@dataclass(frozen=True)
class PaperDamper:
    """The paper's words: proportional to what is missing, and done at 0.95."""

    lap_s: float
    flat_start: bool
    guarded: bool = False

    def bite_mm(self, completion: float) -> float:
        """T v_max (1 - c), zero once done."""
        return 0.0 if completion >= _PAPER_DONE else self.lap_s * _PAPER_V_MAX_MM_S * (1.0 - completion)


def policy_for(job: Job) -> Policy:
    """The policy that the job names."""
    if job.policy == "default":
        return Damper(most_mm=job.rate_bite_mm)
    return PaperDamper(lap_s=job.lap_s, flat_start=job.policy == "previous")
