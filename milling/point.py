"""One trajectory point: the evidence about it, and the rules that need no other point.

Standard library only, no clock, no device: every rule here can be read and tested by itself.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum

from drivers.errors import SafetyStop
from milling.limits import Limits

ROUNDING_MM = 1e-6


class PointState(StrEnum):
    """Where a point stands."""

    OPEN = "open"
    STOPPED = "stopped"
    """One cue says "through", or a limit was met: no bite until a look with the drill lifted."""
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
    doubt: bool = False
    unheard_mm: float = 0.0
    """Depth gained since a pass was last weighed."""
    frames_through: int = 0
    picture_through: bool = False
    load_through: bool = False
    picture_said_mm: float | None = None
    """Where the picture first said "through"."""
    on_trial: bool = False
    """While the load, weighed at every pass, judges a picture that says "through"."""
    state: PointState = PointState.OPEN
    why: str = "no contact yet"
    looks: int = 0
    load_lost_mm: float | None = None
    """Where the load first said "through", until both cues refute it."""
    looked_at_mm: float = -1.0
    allowance_mm: float | None = None
    """While re-opened or on trial: the depth that is allowed."""
    verdicts: Counter[str] = field(default_factory=Counter)

    def touched(self) -> None:
        """Its contact is found: depth counts from here, and the touch is the first load above idle."""
        self.contacted = True
        self.load_above_idle = True
        self.why = "contact found"

    def seen(self, *, completion: float, upper: float, exposed_at_s: float) -> None:
        """A frame shows it. Pictures older than what is known, or not of this world, are ignored."""
        if not (0.0 <= completion <= 1.0 and completion <= upper <= 1.0) or exposed_at_s <= self.seen_at_s:
            return
        self.seen_at_s = exposed_at_s
        self.upper = upper
        self.completion = max(self.completion, completion) if self.picture_through else completion
        if self.on_trial:
            return
        # A re-opened point has its bound from a better look than this one: only a hole that is seen stops it.
        says = upper if self.allowance_mm is None else completion
        self.frames_through = self.frames_through + 1 if says >= self.limits.threshold else 0
        if self.frames_through >= 2 and not self.picture_through:
            self._seen_through()

    def felt(self, *, ratio: float | None, above_idle: bool) -> None:
        """The spindle load of a pass that took a bite here; see ``Ledger.felt``."""
        limits = self.limits
        if ratio is not None:
            before = 1.0 if self.load_ratio is None else self.load_ratio
            # More load than bone takes is no more bone: it must not hide the droop that follows.
            self.load_ratio = before + limits.newest * (min(ratio, 1.0) - before)
            self.unheard_mm = 0.0
        self.load_above_idle = above_idle or self.cut_mm <= limits.entry_mm
        if not self.load_above_idle:
            self._stop_by_load()
        elif ratio is not None and self.load_ratio is not None and self._may_be_through:
            self._weigh(self.load_ratio)

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

    def judge(self, bite_mm: float, now_s: float, frame_at_s: float, deepest_mm: float) -> Grant:
        """How deep the tip may go at this visit, where its neighbours allow ``deepest_mm``."""
        limits = self.limits
        if self.state is not PointState.OPEN:
            return self._no(self.why)
        if not self.contacted:
            return self._no("no contact yet")
        if not bite_mm > 0:
            return self._no("no bite asked")
        if not 0.0 <= now_s - frame_at_s <= limits.frame_age_s:
            return self._no("no fresh frame")
        if self.upper is None or self.seen_at_s <= self.last_pass_s:
            return self._no("not seen since its last pass")
        if self.upper >= limits.threshold and self.allowance_mm is None:
            return self._no("the picture may say through")
        if not self.load_above_idle:
            return self._no("no load at the last pass")
        depth = self.cut_mm + min(bite_mm, self._bite_limit_mm)
        if self.allowance_mm is not None and depth > self.allowance_mm + ROUNDING_MM:
            return self.stop("its allowance is used up")
        if depth > limits.thickness_high_mm:
            return self.stop("the high end of the thickness prior is reached")
        unheard = self.unheard_mm + depth - self.cut_mm
        if depth > limits.thickness_low_mm and unheard > limits.unheard_mm + ROUNDING_MM:
            return self.stop("past the low end of the thickness prior, and its load is not known")
        if depth > deepest_mm:
            return self._no("waits for its neighbours")
        return Grant(depth, True, "bone")

    @property
    def hole_not_excluded(self) -> bool:
        """Whether the newest picture does not exclude a hole."""
        return self.upper is not None and self.upper >= self.limits.threshold

    @property
    def felt_through(self) -> bool:
        """Whether it is finished, and by its load."""
        return self.state is PointState.DONE and self.load_through

    @property
    def tried(self) -> bool:
        """Whether a trial of what the picture says is used up, or nothing more can be weighed in it."""
        limits = self.limits
        last_mm = limits.late_bite_mm
        used_up = self.picture_said_mm is not None and self.cut_mm > self.picture_said_mm + limits.trial_mm - last_mm
        return used_up or (self.looks > 0 and self.unheard_mm > limits.unheard_mm - last_mm)

    @property
    def blind(self) -> bool:
        """Whether it was looked at before, and could not be weighed since as far as it was allowed to go."""
        allowed_mm = self.cut_mm if self.allowance_mm is None else self.allowance_mm
        used_up = self.cut_mm > allowed_mm - self.limits.late_bite_mm
        return self.looks > 0 and used_up and (self.unheard_mm > 0.0 or self.cut_mm <= self.looked_at_mm)

    def stop(self, why: str) -> Grant:
        """No bite until the next look."""
        if self.state is not PointState.DONE:
            self.state, self.why = PointState.STOPPED, why
        return self._no(why)

    def finish(self, why: str) -> None:
        """Latch it."""
        self.state, self.why = PointState.DONE, why

    def forget(self) -> None:
        """What stopped it is refuted, and is tried anew."""
        self.picture_said_mm = self.load_lost_mm = self.load_ratio = None
        self.load_through = self.doubt = False
        self.unheard_mm = 0.0

    def reopen(self, plausible: bool, felt_mm: float) -> None:
        """Give a bounded amount back, after a look.

        Args:
            plausible: whether the picture does not contradict a hole.
            felt_mm: how much deeper the neighbours were felt to be through; a point that may be through as well gets no
                deeper than that without being weighed.
        """
        limits, picture = self.limits, self.hole_not_excluded
        # A look that followed no bite (its neighbours kept the point waiting) told nothing new.
        self.looks += self.cut_mm > self.looked_at_mm
        self.looked_at_mm = self.cut_mm
        if not picture:
            self.picture_said_mm, self.unheard_mm = None, 0.0
        elif self.picture_said_mm is None:
            self.picture_said_mm = self.cut_mm
        self.on_trial = False
        far_mm = self.cut_mm + self._return_mm
        if self.load_lost_mm is not None:
            far_mm = min(far_mm, self.load_lost_mm + limits.past_loss_mm)
        self.allowance_mm = min(far_mm, limits.thickness_high_mm)
        if picture and not self.load_through:
            self._try_picture()
        elif plausible:
            self.allowance_mm = min(self.allowance_mm, self.cut_mm + felt_mm)
        self.load_above_idle, self.doubt = True, self.load_through
        self.picture_through = picture and self.on_trial
        self.load_through = False
        self.frames_through = 0
        self.state, self.why = PointState.OPEN, "re-opened after a look"

    # What the cues say.

    @property
    def _may_be_through(self) -> bool:
        return self.cut_mm > self.limits.thickness_low_mm - self.limits.prior_slack_mm

    def _seen_through(self) -> None:
        """Stop, or let a load that was weighed just now, and is that of bone, judge the picture."""
        self.picture_through = True
        if self.picture_said_mm is None:
            self.picture_said_mm = self.cut_mm
        weighed = self.load_ratio is not None and self.unheard_mm < 0.5 * self.limits.unheard_mm
        if self.doubt:
            self._stop_by_load()
        elif weighed and self._may_be_through and self.state is PointState.OPEN and self.allowance_mm is None:
            self._try_picture()
        else:
            self.stop("the picture says through")

    def _try_picture(self) -> None:
        """A bounded way on, on which only the load can stop the point."""
        assert self.picture_said_mm is not None
        self.on_trial = True
        self.allowance_mm = min(self.picture_said_mm + self.limits.trial_mm, self.limits.thickness_high_mm)

    def _weigh(self, load: float) -> None:
        """What the newest load ratio says of a point deep enough to be through."""
        hole = self.picture_through or self.hole_not_excluded
        if load >= self.limits.whole:
            self.doubt = False
            if not hole:
                # Both cues refute what stopped the point, if it was stopped.
                self.allowance_mm = self.load_lost_mm = self.picture_said_mm = None
        elif load < (self.limits.droop_of_hole if hole else self.limits.droop) and (hole or self.doubt):
            self._stop_by_load()
        elif load < self.limits.droop:
            self.doubt = True

    def _stop_by_load(self) -> None:
        self.load_through = True
        if self.load_lost_mm is None:
            self.load_lost_mm = self.cut_mm
        self.stop("the load says through")

    # How far.

    @property
    def _bite_limit_mm(self) -> float:
        limits = self.limits
        late = self.cut_mm + limits.bite_mm > limits.thickness_low_mm - limits.late_margin_mm
        if self.upper is not None:
            # The picture's share of what bone may remain, taken at the thinnest bone of the prior.
            late = late or (1.0 - self.upper) * limits.thickness_low_mm < limits.late_margin_mm
        return limits.late_bite_mm if late or self.allowance_mm is not None else limits.bite_mm

    @property
    def _return_mm(self) -> float:
        """What a look gives back: the picture's best estimate of the bone left, and a little.

        Against the load it gives back only that little: bites enough to tell bone from a hole.
        """
        if self.load_through:
            return self.limits.reopen_mm
        left_mm = self.cut_mm * (1.0 - self.completion) / max(self.completion, 0.1)
        return min(left_mm + self.limits.reopen_mm, self.limits.most_reopen_mm)

    def _no(self, reason: str) -> Grant:
        return Grant(self.cut_mm, False, reason)
