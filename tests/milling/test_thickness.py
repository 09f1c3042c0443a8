"""The estimate of the thickness: what each cue may say, and that none may shout the others down."""

import numpy as np
import pytest
from ledgers import PITCH_MM

from milling.limits import Limits
from milling.thickness import LOAD, LOAD_AT, Thickness

N = 8


def fresh() -> Thickness:
    return Thickness(N, Limits(), pitch_mm=PITCH_MM)


def weigh(estimate: Thickness, index: int, thickness_mm: float, to_mm: float, *, level: float = 1.0) -> None:
    """Noiseless passes of 13 um down to ``to_mm``."""
    for depth_mm in np.arange(0.065, to_mm + 1e-9, 0.013):
        ratio = level * float(np.interp(depth_mm / thickness_mm, LOAD_AT, LOAD))
        estimate.weighed(index, float(depth_mm), ratio, beside_mm=float(depth_mm))


def middle_mm(estimate: Thickness, index: int) -> float:
    """Median of T."""
    depths_mm = np.arange(0.05, 0.7, 0.001)
    return float(np.interp(0.5, [estimate.through(index, float(depth)) for depth in depths_mm], depths_mm))


def test_without_evidence_the_prior_stands() -> None:
    estimate = fresh()
    assert middle_mm(estimate, 3) == pytest.approx(0.425, abs=0.01)
    assert estimate.through(3, 0.15) < 0.06
    assert estimate.through(3, 0.7) > 0.95


def test_probability_only_grows_with_depth() -> None:
    estimate = fresh()
    weigh(estimate, 2, 0.35, 0.4)
    estimate.pictured(4, 0.3, 0.9)
    for index in range(N):
        steps = np.diff([estimate.through(index, float(depth)) for depth in np.arange(0.0, 0.9, 0.01)])
        assert steps.min() >= -1e-12


@pytest.mark.parametrize("thickness_mm", [0.28, 0.35, 0.42, 0.5])
def test_load_alone_finds_the_thickness(thickness_mm: float) -> None:
    estimate = fresh()
    weigh(estimate, 0, thickness_mm, thickness_mm + 0.06)
    assert middle_mm(estimate, 0) == pytest.approx(thickness_mm, abs=0.015)


def test_load_of_bone_excludes_a_hole_above() -> None:
    estimate = fresh()
    weigh(estimate, 0, 0.9, 0.4)
    assert estimate.through(0, 0.34) < 0.02


@pytest.mark.parametrize(("completion", "share"), [(0.75, 0.75), (0.87, 0.884), (0.942, 0.967)])
@pytest.mark.parametrize("depth_mm", [0.28, 0.4])
def test_pictures_of_one_point_tell_the_share_that_is_cut(depth_mm: float, completion: float, share: float) -> None:
    estimate = fresh()
    for _ in range(5):
        estimate.pictured(0, depth_mm, completion)
    assert middle_mm(estimate, 0) == pytest.approx(depth_mm / share, abs=0.015)


def test_a_picture_that_no_longer_follows_the_depth_tells_nothing() -> None:
    """The failure of the published system: bone where there is none, however deep the ball goes."""
    stuck, alone, follows = fresh(), fresh(), fresh()
    for depth_mm in np.arange(0.2, 0.36, 0.013):
        for _ in range(5):
            stuck.pictured(0, float(depth_mm), 0.7)
            follows.pictured(0, float(depth_mm), float(depth_mm) / 0.43)
    assert middle_mm(stuck, 0) == pytest.approx(middle_mm(alone, 0), abs=1e-6)
    assert middle_mm(follows, 0) == pytest.approx(0.43, abs=0.02)


def test_one_bad_picture_changes_next_to_nothing() -> None:
    estimate = fresh()
    for completion in (0.8, 0.8, 1.0, 0.8, 0.8):
        estimate.pictured(0, 0.4, completion)
    alike = fresh()
    for _ in range(5):
        alike.pictured(0, 0.4, 0.8)
    assert middle_mm(estimate, 0) == pytest.approx(middle_mm(alike, 0), abs=1e-6)


def test_what_was_seen_before_a_hole_says_how_deep_it_is_at_most() -> None:
    known, unknown = fresh(), fresh()
    for depth_mm, completion in ((0.38, 0.93), (0.41, 1.0)):
        for _ in range(5):
            known.pictured(0, depth_mm, completion)
    for _ in range(5):
        unknown.pictured(0, 0.41, 1.0)
    assert known.through(0, 0.34) < 0.25 * unknown.through(0, 0.34)
    known.forget_pictures(0)
    assert known.through(0, 0.34) == pytest.approx(fresh().through(0, 0.34))


def test_a_point_learns_from_its_neighbours_and_less_from_afar() -> None:
    estimate = fresh()
    for index in (3, 5):
        weigh(estimate, index, 0.3, 0.36)
    between, away = middle_mm(estimate, 4), middle_mm(estimate, 0)
    assert between == pytest.approx(0.3, abs=0.02)
    assert abs(away - 0.3) > abs(between - 0.3)


def test_the_ring_is_closed() -> None:
    estimate = fresh()
    weigh(estimate, 0, 0.3, 0.36)
    assert middle_mm(estimate, N - 1) == pytest.approx(middle_mm(estimate, 1), abs=2e-3)


def test_cues_that_contradict_each_other_are_no_certainty() -> None:
    """The picture has long said "through", the load has long said "bone", or the other way round."""
    for shown, thickness_mm, depth_mm in ((1.0, 0.9, 0.4), (0.6, 0.3, 0.4)):
        estimate = fresh()
        weigh(estimate, 0, thickness_mm, depth_mm)
        for _ in range(5):
            estimate.pictured(0, depth_mm, shown)
        alone = fresh()
        weigh(alone, 0, thickness_mm, depth_mm)
        doubt, sure = (min(p, 1 - p) for p in (e.through(0, depth_mm - 0.05) for e in (estimate, alone)))
        assert doubt > 2 * sure


def test_a_drifting_zero_is_no_breakthrough() -> None:
    """All passes over certain bone lose a twentieth: that is the drive, not the bone."""
    drifted, steady = fresh(), fresh()
    for index in range(N):
        for estimate, level in ((drifted, 0.93), (steady, 1.0)):
            weigh(estimate, index, 0.45, 0.25, level=level)
    for index in range(N):
        for depth_mm in (0.26, 0.273, 0.286, 0.3):
            drifted.weighed(index, depth_mm, 0.93, beside_mm=depth_mm)
            steady.weighed(index, depth_mm, 1.0, beside_mm=depth_mm)
    assert drifted.through(2, 0.3) < 2 * steady.through(2, 0.3) + 0.02


def test_what_a_stuck_picture_said_before_a_hole_does_not_count_either() -> None:
    stuck, alone = fresh(), fresh()
    for depth_mm in np.arange(0.15, 0.31, 0.013):
        for _ in range(5):
            stuck.pictured(0, float(depth_mm), 0.5)
    for estimate in (stuck, alone):
        for _ in range(5):
            estimate.pictured(0, 0.32, 1.0)
    assert stuck.through(0, 0.3) == pytest.approx(alone.through(0, 0.3))


def test_more_load_than_bone_takes_is_bone_and_much_more_is_nothing() -> None:
    loud, plain, rubs, none = fresh(), fresh(), fresh(), fresh()
    loud.weighed(0, 0.4, 1.1, beside_mm=0.4)
    plain.weighed(0, 0.4, 1.0, beside_mm=0.4)
    rubs.weighed(0, 0.4, 1.4, beside_mm=0.4)
    assert loud.through(0, 0.4) < plain.through(0, 0.4)
    assert rubs.through(0, 0.4) == pytest.approx(none.through(0, 0.4))


def test_in_a_pit_the_flanks_are_cut_so_that_load_is_no_evidence_of_bone_but_its_absence_is_of_a_hole() -> None:
    level, whole, droops, none = fresh(), fresh(), fresh(), fresh()
    level.weighed(0, 0.4, 1.0, beside_mm=0.39)
    whole.weighed(0, 0.4, 1.0, beside_mm=0.38)
    droops.weighed(0, 0.4, 0.7, beside_mm=0.38)
    assert level.through(0, 0.38) < 0.9 * none.through(0, 0.38)
    assert whole.through(0, 0.38) == pytest.approx(none.through(0, 0.38), rel=0.01)
    assert droops.through(0, 0.38) > 1.5 * none.through(0, 0.38)


def test_passes_that_are_all_wrong_alike_are_no_more_certain_than_some_of_them() -> None:
    """A point whose reference is wrong by 5 % says so at each of its passes."""
    estimate = fresh()
    for depth_mm in np.arange(0.25, 0.35, 0.002):
        estimate.weighed(0, float(depth_mm), 0.95, beside_mm=float(depth_mm))
    assert estimate.through(0, 0.3) < 0.5


def test_the_droop_of_all_holes_under_stuck_pictures_is_no_drift_of_the_torque() -> None:
    """Every picture says "bone" for ever; were the level of bone learned from such passes, no hole would be felt."""
    estimate, n, thickness_mm = Thickness(32, Limits(), pitch_mm=PITCH_MM), 32, 0.35
    for depth_mm in np.arange(0.06, thickness_mm + 0.05, 0.012):
        ratio = float(np.interp(depth_mm / thickness_mm, LOAD_AT, LOAD))
        for index in range(n):
            for _ in range(3):
                estimate.pictured(index, float(depth_mm), min(0.73, float(depth_mm) / thickness_mm))
            estimate.weighed(index, float(depth_mm), ratio, beside_mm=float(depth_mm))
    assert estimate._level == pytest.approx(1.0, abs=0.03)
    assert middle_mm(estimate, 3) == pytest.approx(thickness_mm, abs=0.02)
