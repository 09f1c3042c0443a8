"""Kruger's constrained cubic spline, open and closed: between two knots it never leaves their range.

Source: C. J. C. Kruger, "Constrained Cubic Spline Interpolation for Chemical Engineering Applications". The interior
slope is the harmonic mean of the neighbouring secants, or zero where these disagree in sign; a cubic Hermite spline on
those slopes is the whole method. A milling path is closed, so there every knot is an interior one.
"""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

Floats = npt.NDArray[np.float64]


def constrained_slopes(x: Floats, y: Floats) -> Floats:
    """Slopes at the knots of an open spline.

    Args:
        x: (n,) strictly increasing, n >= 3.
        y: (n,) or (n, k) values.
    """
    _check(x, y, least=3)
    secants = np.diff(y, axis=0) / _columns(np.diff(x), y)
    inner = _harmonic(secants[:-1], secants[1:])
    first = 1.5 * secants[:1] - inner[:1] / 2
    last = 1.5 * secants[-1:] - inner[-1:] / 2
    return np.concatenate([first, inner, last])


def periodic_slopes(x: Floats, y: Floats, period: float) -> Floats:
    """Slopes at the knots of a closed spline: the knot after the last is the first, one ``period`` on."""
    _check(x, y, least=3)
    if not x[-1] - x[0] < period:
        raise ValueError(f"the knots span {x[-1] - x[0]:g}, which must be less than the period {period:g}")
    secants = np.diff(y, axis=0, append=y[:1]) / _columns(np.diff(x, append=x[0] + period), y)
    return _harmonic(np.roll(secants, 1, axis=0), secants)


def constrained_spline(x: Floats, y: Floats) -> "CubicHermiteSpline":
    """The open spline through (x, y)."""
    from scipy.interpolate import CubicHermiteSpline

    return CubicHermiteSpline(x, y, constrained_slopes(x, y))


def periodic_spline(x: Floats, y: Floats, period: float) -> "CubicHermiteSpline":
    """The closed spline through (x, y): defined for every argument, with the given period."""
    from scipy.interpolate import CubicHermiteSpline

    slopes = periodic_slopes(x, y, period)
    return CubicHermiteSpline(
        np.append(x, x[0] + period),
        np.concatenate([y, y[:1]]),
        np.concatenate([slopes, slopes[:1]]),
        extrapolate="periodic",
    )


def _harmonic(before: Floats, after: Floats) -> Floats:
    agree = before * after > 0
    total = np.where(agree, before + after, 1.0)
    return np.where(agree, 2 * before * after / total, 0.0)


def _columns(step: Floats, y: Floats) -> Floats:
    return step.reshape((-1,) + (1,) * (y.ndim - 1))


def _check(x: Floats, y: Floats, *, least: int) -> None:
    if x.ndim != 1 or len(x) != len(y) or len(x) < least:
        raise ValueError(f"a spline needs at least {least} knots, one value each; found {len(x)} and {len(y)}")
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        raise ValueError("a spline through NaN or infinity was asked for")
    if not np.all(np.diff(x) > 0):
        raise ValueError("the knots of a spline must increase")
