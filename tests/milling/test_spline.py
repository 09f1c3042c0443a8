"""Kruger's own example, exactly; SciPy's Pchip as an oracle; the closed form by its laws."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from milling.spline import constrained_slopes, constrained_spline, periodic_slopes, periodic_spline

X = np.array([0.0, 10, 30, 50, 70, 90, 100])
Y = np.array([30.0, 130, 150, 150, 170, 220, 320])


def test_krugers_example_slopes() -> None:
    expected = [Fraction(155, 11), Fraction(20, 11), 0, 0, Fraction(10, 7), 4, 13]
    np.testing.assert_allclose(constrained_slopes(X, Y), [float(value) for value in expected], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    ("x", "y"), [(5, 95.340909), (20, 144.545455), (40, 150), (60, 156.428571), (80, 188.571429), (95, 258.75)]
)
def test_krugers_example_midpoints(x: float, y: float) -> None:
    assert float(constrained_spline(X, Y)(x)) == pytest.approx(y, abs=5e-7)


def test_second_derivatives_are_krugers() -> None:
    slopes = constrained_slopes(X, Y)
    spline = constrained_spline(X, Y)
    for i in range(1, len(X)):
        h, rise = X[i] - X[i - 1], Y[i] - Y[i - 1]
        left = -2 * (slopes[i] + 2 * slopes[i - 1]) / h + 6 * rise / h**2
        right = 2 * (2 * slopes[i] + slopes[i - 1]) / h - 6 * rise / h**2
        assert float(spline(X[i - 1], 2)) == pytest.approx(left, abs=1e-12)
        before_the_knot = spline.c[1, i - 1] * 2 + 6 * spline.c[0, i - 1] * h
        assert before_the_knot == pytest.approx(right, abs=1e-12)


def test_interior_slopes_are_pchips_on_equal_spacing() -> None:
    y = np.random.default_rng(3).normal(size=40).cumsum()
    x = np.arange(40.0)
    np.testing.assert_allclose(
        constrained_slopes(x, y)[1:-1], PchipInterpolator(x, y).derivative()(x)[1:-1], atol=1e-12
    )


def test_closed_spline_meets_itself_in_value_and_slope() -> None:
    x = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    y = np.stack([np.cos(x), np.sin(x)], axis=1)
    spline = periodic_spline(x, y, 2 * np.pi)
    np.testing.assert_allclose(spline(0.0), spline(2 * np.pi), atol=1e-12)
    np.testing.assert_allclose(spline(-1e-9, 1), spline(1e-9, 1), atol=1e-6)
    fine = np.linspace(0, 2 * np.pi, 3000)
    assert np.abs(np.linalg.norm(spline(fine), axis=1) - 1).max() < 0.01


def test_closed_slopes_do_not_depend_on_where_the_lap_starts() -> None:
    x = np.arange(12.0)
    y = np.random.default_rng(1).normal(size=12)
    turned = periodic_slopes(x, np.roll(y, 5), 12.0)
    np.testing.assert_allclose(np.roll(turned, -5), periodic_slopes(x, y, 12.0), atol=1e-12)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=16))
def test_closed_spline_never_leaves_the_range_of_two_neighbours(values: list[float]) -> None:
    y = np.array(values)
    n = len(y)
    spline = periodic_spline(np.arange(float(n)), y, float(n))
    for i in range(n):
        inside = spline(np.linspace(i, i + 1, 21))
        low, high = sorted((y[i], y[(i + 1) % n]))
        assert np.all(inside >= low - 1e-9)
        assert np.all(inside <= high + 1e-9)


@pytest.mark.parametrize("bad", [np.array([0.0, 1, np.nan]), np.array([0.0, 1, np.inf])])
def test_nan_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="NaN"):
        periodic_spline(np.arange(3.0), bad, 3.0)


def test_knots_must_increase_and_fit_the_period() -> None:
    with pytest.raises(ValueError, match="increase"):
        constrained_slopes(np.array([0.0, 2, 1]), np.zeros(3))
    with pytest.raises(ValueError, match="period"):
        periodic_slopes(np.array([0.0, 1, 2]), np.zeros(3), 2.0)
