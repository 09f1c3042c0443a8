"""One trajectory point: what was seen and felt of it, and the rules that need no estimate and no other point.

Standard library only, no clock, no device: every rule here can be read and tested by itself.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from drivers.errors import SafetyStop
from milling.limits import Limits

ROUNDING_MM = 1e-6
KEPT = (
    "upper", "completion", "load_ratio", "load_above_idle", "unheard_mm", "said_mm", "incredible", "frames", "lost_mm",
    "agreed", "why", "resting", "looks", "looked_at_mm",
)  # fmt: skip
"""Of a point's fields, those that outlive a run."""


class PointState(StrEnum):
    """Where a point stands."""

    OPEN = "open"
    STOPPED = "stopped"
    """It is probably through, or a limit was met: no bite until better evidence, or a look with the drill lifted."""
    DONE = "done"
    """Latched: it never opens again."""


@dataclass(frozen=True)
class Grant:
    """The depth that one visit may reach, below contact, and why it is no deeper."""

    depth_mm: float
    deeper: bool
    reason: str


@dataclass
class Point:
    """The evidence about one point. Depths are below its own contact."""

    limits: Limits
    contacted: bool = False
    cut_mm: float = 0.0
    granted_mm: float | None = None
    last_pass_s: float = float("-inf")
    seen_at_s: float = float("-inf")
    upper: float | None = None
    completion: float = 0.0
    load_ratio: float | None = None
    load_above_idle: bool = False
    unheard_mm: float = 0.0
    """Depth gained since a pass was last weighed."""
    said_mm: float | None = None
    """Where the picture first said "through", until it takes that back; the low end of the prior, if it was above."""
    incredible: bool = False
    """Whether the picture says "through" since where no skull is thin enough for that."""
    frames: int = 0
    """Frames in a row that contradict ``said_mm``."""
    lost_mm: float | None = None
    """Where next to no load was left, until whole loads refute it."""
    agreed: bool = False
    """Whether its load drooped where its picture said "through"."""
    left_probability: float = 1.0
    """Of bone that would hold the flap, here."""
    state: PointState = PointState.OPEN
    why: str = "no contact yet"
    resting: bool = False
    """Stopped by what is estimated, which the next picture or a neighbour may change."""
    looks: int = 0
    looked_at_mm: float = -1.0
    verdicts: Counter[str] = field(default_factory=Counter)

    def snapshot(self) -> dict[str, Any]:
        """What a later run must know of it, beside its depth; as JSON."""
        return {name: getattr(self, name) for name in KEPT} | {"state": self.state.value}

    def restore(self, kept: Mapping[str, Any]) -> None:
        """What an earlier run knew."""
        for name in KEPT:
            setattr(self, name, kept[name])
        self.state = PointState(kept["state"])

    def touched(self) -> None:
        """Its contact is found: depth counts from here, and the touch is the first load above idle."""
        self.contacted = True
        self.load_above_idle = True
        self.why = "contact found"

    def seen(self, *, completion: float, upper: float, exposed_at_s: float) -> bool:
        """A frame shows it; False for pictures older than what is known, or not of this world, which are ignored."""
        if not (0.0 <= completion <= 1.0 and completion <= upper <= 1.0) or exposed_at_s <= self.seen_at_s:
            return False
        self.seen_at_s, self.upper, self.completion = exposed_at_s, upper, completion
        limits = self.limits
        contradicts = upper >= limits.threshold if self.said_mm is None else completion < limits.bone
        self.frames = self.frames + 1 if contradicts else 0
        if self.frames >= limits.frames:
            says, self.frames = self.said_mm is None, 0
            self.said_mm = max(self.cut_mm, limits.thickness_low_mm) if says else None
            self.incredible = says and self.cut_mm < limits.early_share * limits.thickness_low_mm
        return True

    def felt(self, *, ratio: float | None, above_idle: bool) -> None:
        """The spindle load of a pass that took a bite here; see ``Ledger.felt``."""
        if ratio is not None:
            both = (ratio, self.load_ratio if self.load_ratio is not None else 1.0)
            if max(both) < self.limits.lost and self.lost_mm is None:
                self.lost_mm = self.cut_mm
            elif min(both) >= self.limits.whole:
                self.lost_mm = None
            self.load_ratio, self.unheard_mm = ratio, 0.0
            self.agreed = self.agreed or (ratio < self.limits.droop and self.said_mm is not None)
        self.load_above_idle = above_idle or self.cut_mm <= self.limits.entry_mm
        if not self.load_above_idle:
            self.stop("no load at the last pass")

    def passed(self, *, depth_mm: float, now_s: float) -> None:
        """The tip has left it, read back, having reached ``depth_mm``; the permission ends.

        Raises:
            SafetyStop: deeper than was permitted.
        """
        permitted = self.cut_mm if self.granted_mm is None else self.granted_mm
        self.granted_mm = None
        self.last_pass_s = now_s
        if depth_mm > permitted + ROUNDING_MM:
            raise SafetyStop(f"cut to {depth_mm:.4f} mm below contact, permitted were {permitted:.4f} mm")
        if depth_mm > self.cut_mm:
            self.unheard_mm += depth_mm - self.cut_mm
            self.cut_mm = depth_mm

    def judge(self, bite_mm: float, now_s: float, frame_at_s: float, *, deepest_mm: float, said_mm: float) -> Grant:
        """How deep the tip may go at this visit.

        Args:
            bite_mm: the bite that is asked for.
            now_s: the time.
            frame_at_s: when the newest frame was exposed.
            deepest_mm: the depth that its neighbours allow.
            said_mm: the way on that is allowed from where the picture first said "through".
        """
        limits = self.limits
        if self.state is not PointState.OPEN:
            return self._no(self.why)
        if not self.contacted:
            return self._no("no contact yet")
        if not bite_mm > ROUNDING_MM:
            return self._no("no bite asked")
        if not 0.0 <= now_s - frame_at_s <= limits.frame_age_s:
            return self._no("no fresh frame")
        if self.upper is None or self.seen_at_s <= self.last_pass_s:
            return self._no("not seen since its last pass")
        if not self.load_above_idle:
            return self._no("no load at the last pass")
        depth_mm = self.next_mm(bite_mm)
        if depth_mm > limits.thickness_high_mm:
            return self.stop("the high end of the thickness prior is reached")
        # No picture is believed that sees a hole in half of the thinnest bone: there the load cannot be weighed yet.
        holed = self.upper >= limits.threshold and depth_mm > limits.thickness_low_mm / 2
        doubtful = holed or depth_mm > limits.thickness_low_mm
        if doubtful and self.unheard_mm + depth_mm - self.cut_mm > limits.unheard_mm + ROUNDING_MM:
            return self.stop("it may be through, and its load is not known")
        if self.lost_mm is not None and depth_mm > self.lost_mm + limits.past_loss_mm + ROUNDING_MM:
            return self.stop("the load is lost")
        if self.said_mm is not None and depth_mm > self.said_mm + said_mm + ROUNDING_MM:
            return self.stop("the picture has said through for too long")
        if depth_mm > deepest_mm:
            return self._no("waits for its neighbours")
        return Grant(depth_mm, True, "bone")

    def next_mm(self, bite_mm: float) -> float:
        """The depth of a bite as deep as was asked for, or as is allowed here."""
        limits = self.limits
        late = self.cut_mm + limits.bite_mm > limits.thickness_low_mm - limits.late_margin_mm
        if self.upper is not None:
            # The picture's share of what bone may remain, taken at the thinnest bone of the prior.
            late = late or (1.0 - self.upper) * limits.thickness_low_mm < limits.late_margin_mm
        return self.cut_mm + min(bite_mm, limits.late_bite_mm if late else limits.bite_mm)

    def stop(self, why: str) -> Grant:
        """No bite until the next look."""
        if self.state is not PointState.DONE:
            self.state, self.why, self.resting = PointState.STOPPED, why, False
        return self._no(why)

    def rest(self, why: str) -> None:
        """No bite until what is known changes."""
        if self.state is PointState.OPEN or self.resting:
            self.state, self.why, self.resting = PointState.STOPPED, why, True

    def wake(self) -> None:
        """What is known has changed; a point that a limit stopped stays so."""
        if self.resting:
            self.state, self.why, self.resting = PointState.OPEN, "bone is left, as far as is known", False

    def finish(self, why: str) -> None:
        """Latch it."""
        self.state, self.why, self.resting = PointState.DONE, why, False

    def reopen(self) -> None:
        """Try again after a look."""
        # A look that followed no bite (its neighbours kept the point waiting) told nothing new.
        self.looks += self.cut_mm > self.looked_at_mm
        self.looked_at_mm = self.cut_mm
        hole_excluded = self.upper is not None and self.upper < self.limits.threshold
        if hole_excluded or self.left_probability > self.limits.bone_probability:
            self.unheard_mm = 0.0
        self.load_above_idle, self.resting = True, False
        self.state, self.why = PointState.OPEN, "re-opened after a look"

    def _no(self, reason: str) -> Grant:
        return Grant(self.cut_mm, False, reason)
