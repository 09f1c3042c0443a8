"""Feeling a breakthrough: the load follows the chord while there is bone, and droops when its middle is gone."""

from math import sqrt

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from milling.load import Idle, LoadMeter, chord_mm

IDLE = Idle(0.08, 0.01)
GAIN = 16.0
PITCH_MM = 0.4


def passes(
    meter: LoadMeter, cuts: list[float], bites: list[float], *, gone: float = 0.0, speed: float = 1.0
) -> list[float | None]:
    """Laps of a ring of three equal points; ``gone`` is the width missing from the chord at the last pass."""
    ratios: list[float | None] = []
    depth = 0.0
    for lap, (cut, bite) in enumerate(zip(cuts, bites, strict=True)):
        depth += bite
        width = chord_mm(depth, 0.5) - (gone if lap == len(cuts) - 1 else 0.0)
        for index in range(3):
            for offset in np.linspace(-0.4, 0.4, 8):
                meter.report(index, IDLE.mean + GAIN * speed * cut * width, offset=float(offset), speed=speed)
            feeling = meter.leave(index, bite_mm=[bite] * 3, depth_mm=[depth] * 3)
            if index == 1:
                ratios.append(None if feeling is None else feeling.ratio)
    return ratios


def sprung(bites: list[float], compliance: float) -> list[float]:
    cuts, before = [], 0.0
    for bite in bites:
        before = (bite + compliance * before) / (1 + compliance)
        cuts.append(before)
    return cuts


def meter() -> LoadMeter:
    return LoadMeter([0.0] * 3, IDLE, pitch_mm=PITCH_MM, ball_radius_mm=0.5, sound_depth_mm=0.25)


def test_bone_reads_as_one() -> None:
    bites = [0.013] * 25
    ratios = [ratio for ratio in passes(meter(), sprung(bites, 0.6), bites) if ratio is not None]
    assert len(ratios) > 12
    # Before a point knows its own bone, what was felt elsewhere is expected at a discount.
    assert all(0.95 < ratio < 1.3 for ratio in ratios[:4])
    assert all(0.95 < ratio < 1.05 for ratio in ratios[4:])


def test_one_bite_past_the_inner_surface_droops_by_a_quarter() -> None:
    bites = [0.013] * 25
    through = 2 * sqrt(0.013 * (1 - 0.013))
    last = passes(meter(), sprung(bites, 0.6), bites, gone=through)[-1]
    assert last is not None
    assert 0.7 < last < 0.82


@pytest.mark.parametrize(("paused", "silent"), [(1, 2), (3, 5)])
def test_a_pause_is_not_a_breakthrough(paused: int, silent: int) -> None:
    """A long one hides what the next two passes mean, a short one only what the first does."""
    bites = [0.013] * 14 + [0.0] * paused + [0.013] * 6
    for compliance in (0.3, 0.6, 0.8, 1.2):
        ratios = passes(meter(), sprung(bites, compliance), bites)
        assert ratios[14 : 14 + silent] == [None] * silent
        assert all(ratio is not None and ratio > 0.85 for ratio in ratios[14 + silent :])


def contact_mm(path: CubicSpline, ball_mm: float) -> float:
    """Where a ball, its lowest point following ``path``, touches what all its other places leave standing."""
    x = ball_mm + np.linspace(-0.2, 0.2, 2001)
    centres = np.linspace(-0.8, 0.8, 3201)
    heights = path(centres)[None, :] - np.sqrt(np.maximum(0.25 - (x[:, None] - centres) ** 2, 0.0))
    floor = np.where(np.abs(x[:, None] - centres) < 0.5, heights, np.inf).min(axis=1)
    own = path(ball_mm) - np.sqrt(0.25 - (x - ball_mm) ** 2)
    return float(x[np.argmin(own - floor)])


@pytest.mark.parametrize("dip_mm", [-0.04, -0.02, 0.02, 0.05])
def test_dips_and_humps_of_the_path_are_expected(dip_mm: float) -> None:
    """While a ball crosses a dip its contact covers more than its way: so much more load is that of bone."""
    depths = [0.2, 0.2, 0.2 + dip_mm, 0.2, 0.2]
    path = CubicSpline(np.array([-2, -1, 0, 1, 2]) * PITCH_MM, -np.array(depths))
    covered = contact_mm(path, PITCH_MM / 2) - contact_mm(path, -PITCH_MM / 2)
    ring = LoadMeter([0.0] * 5, IDLE, pitch_mm=PITCH_MM, ball_radius_mm=0.5, sound_depth_mm=0.25)
    assert (covered > PITCH_MM) is (dip_mm > 0)
    assert ring._bend(2, depths) == pytest.approx(covered / PITCH_MM, rel=0.15)


def test_a_slow_ball_is_not_a_breakthrough() -> None:
    slow, bites = meter(), [0.013] * 14
    passes(slow, sprung(bites, 0.6), bites)
    again = passes(slow, [0.013], [0.013], speed=0.6)
    assert again[0] is None or again[0] > 0.5
    crawling = meter()
    assert passes(crawling, [0.013] * 12, [0.013] * 12, speed=0.3) == [None] * 12


def test_too_few_reports_say_nothing() -> None:
    quiet = meter()
    quiet.report(0, 0.2, offset=0.0, speed=1.0)
    assert quiet.leave(0, bite_mm=[0.01] * 3, depth_mm=[0.1] * 3) is None


def test_no_bite_no_feeling() -> None:
    still = meter()
    for _ in range(9):
        still.report(0, 0.2, offset=0.0, speed=1.0)
    assert still.leave(0, bite_mm=[0.0] * 3, depth_mm=[0.1] * 3) is None


def test_idle_needs_a_baseline_and_judges_means() -> None:
    with pytest.raises(ValueError, match="baseline"):
        Idle.of([0.1])
    idle = Idle.of([0.08, 0.09, 0.07, 0.08])
    assert not idle.above([], 4.0)
    assert not idle.above([0.082] * 4, 4.0)
    assert idle.above([0.12] * 4, 4.0)
