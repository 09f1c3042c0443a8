"""Setpoints: in free air, in view, not in one plane, and chosen for the error they leave."""

import numpy as np
import pytest
from synthetic_microscope import SIZE_PX, Microscope

from calib.landmark import spread_mm
from calib.setpoints import (
    FREE_AIR,
    PAPER_SETPOINTS,
    box_points,
    choose,
    default_setpoints,
    grid,
    nominal_pair,
    planned_pair,
    short_order,
    skull_points,
)
from drivers.motion.interface import Travel


def predicted_mm(setpoints, points, model="radial"):
    """RMS error of the transform alone."""
    return np.sqrt((planned_pair(setpoints, sigma_px=0.5, model=model).sigma_at(points, 1e-9) ** 2).sum(axis=1).mean())


def length_mm(setpoints):
    return np.linalg.norm(np.diff(np.array(setpoints), axis=0), axis=1).sum()


def test_the_papers_sequence_as_printed():
    assert PAPER_SETPOINTS == ((0, -20, 0), (10, -20, 0), (5, -10, 0), (10, 0, 0), (0, 0, 0))


def test_default_setpoints_are_different_in_free_air_and_fill_it():
    setpoints = default_setpoints()
    assert len(set(setpoints)) == len(setpoints) == 16
    assert all(FREE_AIR.contains(setpoint) for setpoint in setpoints)
    assert spread_mm(setpoints)[2] > 3.0


@pytest.mark.parametrize("tilt_about_deg", range(0, 360, 45))
def test_default_setpoints_are_in_both_pictures_whichever_way_the_microscope_leans(tilt_about_deg):
    for pixels in Microscope(tilt_about_deg=tilt_about_deg).project(default_setpoints()):
        assert (pixels > 20).all()
        assert (pixels < np.array(SIZE_PX) - 20).all()


def test_default_setpoints_keep_to_a_smaller_travel():
    travel = Travel((2.0, -15.0, 1.0), (9.0, 5.0, 8.0))
    assert all(travel.contains(setpoint) for setpoint in default_setpoints(14, travel))


def test_a_travel_without_free_air_is_refused():
    with pytest.raises(ValueError, match="does not meet the free air"):
        default_setpoints(16, Travel((20.0, 0.0, 0.0), (30.0, 10.0, 10.0)))


def test_the_error_is_predicted_before_moving_and_is_small():
    setpoints = default_setpoints()
    assert predicted_mm(setpoints, box_points()) < 0.07
    assert predicted_mm(setpoints, skull_points()) < 0.07
    assert predicted_mm(default_setpoints(20), box_points()) < predicted_mm(setpoints, box_points())


def test_the_choice_beats_random_ones_and_a_regular_grid():
    region = np.vstack([box_points(), skull_points()])
    chosen = predicted_mm(default_setpoints(), region)
    candidates = grid(FREE_AIR.low_mm, FREE_AIR.high_mm, (5, 5, 4))
    rng = np.random.default_rng(0)
    for _ in range(30):
        assert chosen < predicted_mm(candidates[rng.choice(len(candidates), 16, replace=False)], region)
    assert chosen < predicted_mm(grid(FREE_AIR.low_mm, FREE_AIR.high_mm, (2, 4, 2)), region)


def test_no_exchange_improves_the_choice():
    region = skull_points()
    candidates = grid(FREE_AIR.low_mm, FREE_AIR.high_mm, (3, 3, 3))
    chosen = choose(candidates, 8, region, model="affine")
    best = predicted_mm(candidates[chosen], region, "affine")
    for place in range(8):
        for other in set(range(len(candidates))) - set(chosen):
            exchanged = [*chosen[:place], other, *chosen[place + 1 :]]
            assert predicted_mm(candidates[exchanged], region, "affine") > best * (1 - 1e-6)


def test_impossible_choices_are_refused():
    with pytest.raises(ValueError, match="from 27 candidates"):
        choose(grid((0, 0, 0), (1, 1, 1), (3, 3, 3)), 28, skull_points())
    with pytest.raises(ValueError, match="needs 5 or more"):
        choose(grid((0, 0, 0), (1, 1, 1), (3, 3, 3)), 4, skull_points())


def test_the_order_is_short_and_the_same_each_time():
    setpoints = default_setpoints()
    rng = np.random.default_rng(1)
    shuffled = [setpoints[i] for i in rng.permutation(len(setpoints))]
    assert short_order(shuffled) == short_order(setpoints)
    assert length_mm(setpoints) < 0.6 * length_mm(shuffled)


def test_nominal_microscope_is_the_papers():
    left, right = nominal_pair().project([[5.0, -10.0, 0.0], [5.0, -9.0, 0.0], [6.0, -10.0, 0.0], [5.0, -10.0, 1.0]])
    assert left[0] == pytest.approx([480.0, 270.0], abs=0.3)
    assert (left[1] - left[0])[0] == pytest.approx(1 / 0.03947, rel=0.02)
    assert (left[2] - left[0])[1] == pytest.approx(1 / 0.03894, rel=0.02)
    assert (left - right)[3, 0] - (left - right)[0, 0] == pytest.approx(6.4, rel=0.02)
