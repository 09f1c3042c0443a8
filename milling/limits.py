"""The figures that permission goes by. Standard library only."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """What the ledger enforces; lengths in mm.

    Attributes:
        bite_mm: the deepest bite of one visit.
        late_bite_mm: the same, once less than ``late_margin_mm`` of bone may remain.
        thickness_low_mm, thickness_high_mm: the thickness prior.
        threshold: upper bound of completion that means "through".
        entry_mm: how deep the contact alone is evidence of bone: its own uncertainty, run-out included.
        frame_age_s: the oldest newest frame.
        past_mm: how far past the inner surface a point may be, for all that is known. A membrane lies 70 um below it at
            least; the rest is run-out and slope.
        past_risk: how probable it may be that the next bite leads farther than that.
        left_mm: a point is finished with less bone than that left.
        left_risk: how probable it may be that a finished point has more than that left.
        bridge_mm: bone of at least that thickness may hold the flap: the published criterion.
        unheard_mm: how deep a point may go, on passes whose load could not be weighed, past the low end of the prior or
            under a picture that may say "through".
        early_share: a picture that says "through" above so much of the low end of the prior is not believed at that
            point, until it takes it back.
        bone_probability: under a picture of a hole a look gives ``unheard_mm`` back where bone is left with more than
            this.
        said_mm: how far all other evidence may lead a point on from where the picture first said "through".
        said_proven_mm: the same, once the load has proved that it knows a hole: drooped at ``proven_share`` of all
            points, each under a picture that said so as well. A torque that never droops leads on for ``said_mm`` only.
        proven_share: see there.
        droop: a load below this share of what bone takes has drooped.
        frames: so many frames in a row make the picture say "through", or take it back.
        bone: completion, as the picture estimates it, below which it takes "through" back.
        lost: two loads in a row below this share, and the load is lost; nothing but whole loads can overrule that.
        whole: loads of at least this share, two in a row, are whole.
        past_loss_mm: how far a point may go past where its load was lost.
        neighbour_mm: how much deeper than its shallower neighbour a point may go.
        looks: how often a point may be re-opened.
    """

    bite_mm: float = 0.05
    late_bite_mm: float = 0.015
    late_margin_mm: float = 0.1
    thickness_low_mm: float = 0.25
    thickness_high_mm: float = 0.6
    threshold: float = 0.995
    entry_mm: float = 0.03
    frame_age_s: float = 0.1
    past_mm: float = 0.05
    past_risk: float = 0.1
    left_mm: float = 0.01
    left_risk: float = 0.03
    bridge_mm: float = 0.03
    unheard_mm: float = 0.04
    early_share: float = 0.8
    bone_probability: float = 0.5
    said_mm: float = 0.06
    said_proven_mm: float = 0.2
    proven_share: float = 0.25
    droop: float = 0.85
    frames: int = 3
    bone: float = 0.9
    lost: float = 0.6
    whole: float = 0.9
    past_loss_mm: float = 0.02
    neighbour_mm: float = 0.12
    looks: int = 6
