"""The figures that permission goes by. Standard library only."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """What the ledger enforces; lengths in mm, loads as shares of what bone takes.

    A pass over whole bone measures its load to 7 % (one sigma, on the virtual bench), and a ball 15-30 um past the
    inner surface feels 0.77 of it: so ``droop`` lies two of its sigmas below bone, and a droop has to be felt twice.

    Attributes:
        bite_mm: the deepest bite of one visit.
        late_bite_mm: the same, once less than ``late_margin_mm`` of bone may remain.
        thickness_low_mm, thickness_high_mm: the thickness prior.
        threshold: upper bound of completion that means "through".
        entry_mm: how deep the contact alone is evidence of bone: its own uncertainty, run-out included.
        frame_age_s: the oldest newest frame.
        newest: the weight of the newest pass in a point's load.
        prior_slack_mm: how far above the low end of the thickness prior a droop of the load is first believed.
        droop: a load below this share raises a doubt, and confirms one.
        droop_of_hole: a load below this share confirms a picture of a hole.
        whole: a load of at least this share settles a doubt.
        unheard_mm: how deep a point may go past the low end of the prior on passes whose load could not be weighed.
        neighbour_mm: how much deeper than its shallower neighbour a point may go.
        pit_mm: the same where the picture says that the point is through.
        reopen_mm: what one look with the drill lifted may give back to a stopped point, beyond what its best
            estimate of completion leaves.
        most_reopen_mm: the bound on both together.
        past_loss_mm: how far all looks together may let a point go past where the load was first lost.
        agrees: the best estimate of completion that does not contradict a load that says "through".
        trial_mm: how far a point goes on below where the picture first said "through", as long as its load is weighed
            and is that of bone: a hole that the picture sees is felt within 30 um.
        felt_mm: how much shallower than neighbours whose breakthrough was felt a point may be that only the picture
            calls through; half of it, shallower than both its neighbours as they were cut.
        notch_mm: a point so much shallower than both its neighbours is not through, whatever its cues say.
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
    newest: float = 0.6
    prior_slack_mm: float = 0.05
    droop: float = 0.85
    droop_of_hole: float = 0.87
    whole: float = 0.9
    unheard_mm: float = 0.04
    neighbour_mm: float = 0.08
    pit_mm: float = 0.03
    reopen_mm: float = 0.03
    most_reopen_mm: float = 0.06
    past_loss_mm: float = 0.02
    agrees: float = 0.8
    trial_mm: float = 0.08
    felt_mm: float = 0.04
    notch_mm: float = 0.05
    looks: int = 6
