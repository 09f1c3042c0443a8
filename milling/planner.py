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
from milling.load import chord_mm

_PAPER_V_MAX_MM_S = 0.019
"""With it the windows that `paper` calls complete take the published 2.1 min in the median."""
_PAPER_DONE = 0.95
_LEAST_BITE_MM = 0.012
_FULL_BITE_UNTIL = 0.85
_MOST_MM3_S = 0.056
"""Keeps the estimated heating of the bone below 10 C: 22 C per mm^3, gone with a time constant of 8 s. Both are
choices; no milling of mouse skulls was published with its temperatures."""


class Policy(Protocol):
    """Asks for a bite; whether it is given is not the policy's business."""

    @property
    def guarded(self) -> bool:
        """Whether contact, permission and the verify pass apply."""

    @property
    def flat_start(self) -> bool:
        """Whether every point starts at one height, above the highest of the ring."""

    def bite_mm(self, completion: float, *, depth_mm: float = 0.0) -> float:
        """The bite asked for at a point of this completion, cut to ``depth_mm``, at its next visit."""


@dataclass(frozen=True)
class Damper:
    """Policy ``default``: full bites until the picture sees bone thin out, then damped, never below a least bite.

    A full bite is bounded by itself, by the area it removes along the path per second, and by the volume.
    """

    job: Job
    guarded: bool = True
    flat_start: bool = False

    def bite_mm(self, completion: float, *, depth_mm: float = 0.0) -> float:
        """T v_max (1 - c) with T v_max such that the bound is met at ``_FULL_BITE_UNTIL``."""
        job = self.job
        width_mm = chord_mm(depth_mm, job.ball_radius_mm)
        most_mm = min(job.bite_mm, job.removal_rate_mm2_s / job.feed_mm_s)
        if width_mm > 0:
            most_mm = min(most_mm, _MOST_MM3_S / (job.feed_mm_s * width_mm))
        damped_mm = most_mm * (1.0 - completion) / (1.0 - _FULL_BITE_UNTIL)
        return min(most_mm, max(min(_LEAST_BITE_MM, most_mm), damped_mm))


@dataclass(frozen=True)
class PaperDamper:
    """The paper's words: proportional to what is missing, and done at 0.95."""

    lap_s: float
    flat_start: bool
    guarded: bool = False

    def bite_mm(self, completion: float, *, depth_mm: float = 0.0) -> float:
        """T v_max (1 - c), zero once done."""
        del depth_mm
        return 0.0 if completion >= _PAPER_DONE else self.lap_s * _PAPER_V_MAX_MM_S * (1.0 - completion)


def policy_for(job: Job) -> Policy:
    """The policy that the job names."""
    if job.policy == "default":
        return Damper(job)
    return PaperDamper(lap_s=job.lap_s, flat_start=job.policy == "previous")
