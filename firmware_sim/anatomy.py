"""Lines of the head, in the skull's frame: sutures, and the vessels under the bone."""

from dataclasses import dataclass

import numpy as np

from firmware_sim.skull import Array


@dataclass(frozen=True)
class Stroke:
    """A curve (n, 2) of (s, t) in mm with its width at every point."""

    st_mm: Array
    width_mm: Array


def sutures(rng: np.random.Generator, half_length_mm: float) -> list[Stroke]:
    """Sagittal, frontal, both sides of the coronal and of the lambdoid suture, meeting at bregma and lambda."""
    bregma, lambda_ = half_length_mm, -half_length_mm
    width = rng.uniform(0.05, 0.11)
    strokes = [
        _jagged(rng, np.array([[0.0, bregma], [0.0, lambda_]]), 0.05, width),
        _jagged(rng, np.array([[0.0, bregma], [rng.normal(0, 0.1), bregma + 6.0]]), 0.03, 0.8 * width),
    ]
    rise, bulge = rng.uniform(0.15, 0.5), rng.uniform(0.5, 1.3)
    side = np.linspace(0.0, 1.0, 14)
    for hand in (-1.0, 1.0):
        reach = rng.uniform(4.5, 5.5)
        coronal_t = bregma + rise * reach * side**1.6 + rng.normal(0, 0.12) * side
        strokes.append(_jagged(rng, np.column_stack([hand * reach * side, coronal_t]), 0.09, width))
        lambdoid_t = lambda_ - bulge * np.sin(np.pi * np.minimum(side * 0.8, 1.0)) - 0.4 * side
        strokes.append(_jagged(rng, np.column_stack([hand * reach * side, lambdoid_t]), 0.08, 1.1 * width))
    return strokes


def vessels(rng: np.random.Generator, half_length_mm: float) -> list[Stroke]:
    """The sagittal and transverse sinus, pial veins that drain into them, and a mesh of small ones."""
    strokes = []
    line = np.linspace(-half_length_mm - 0.3, half_length_mm + 4.0, 30)
    sinus = np.column_stack([0.06 * np.sin(line + rng.uniform(0, 6)), line])
    strokes.append(Stroke(sinus, np.full(30, rng.uniform(0.22, 0.42))))
    side = np.linspace(0.0, 1.0, 16)
    for hand in (-1.0, 1.0):
        transverse = np.column_stack([hand * 5.2 * side, -half_length_mm - 0.3 - 0.9 * np.sin(2.2 * side)])
        strokes.append(Stroke(transverse, np.full(16, rng.uniform(0.25, 0.45))))
        for _ in range(rng.integers(5, 9)):
            start = np.array([0.1 * hand, rng.uniform(-half_length_mm, half_length_mm + 3)])
            strokes += _tree(rng, start, 0.0 if hand > 0 else np.pi, rng.uniform(0.08, 0.20), rng.uniform(2.5, 5.0))
    for _ in range(70):
        start = np.array([rng.uniform(-5, 5), rng.uniform(-6, 6.5)])
        strokes += _tree(rng, start, rng.uniform(0, 2 * np.pi), rng.uniform(0.03, 0.08), rng.uniform(0.7, 2.5))
    return strokes


def _jagged(rng: np.random.Generator, course: Array, tooth_mm: float, width_mm: float) -> Stroke:
    """A course with interlocking teeth, which leave its ends in place."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(course, axis=0).T))])
    n = max(8, int(length[-1] / 0.04))
    at = np.linspace(0.0, length[-1], n)
    points = np.column_stack([np.interp(at, length, course[:, k]) for k in range(2)])
    along = np.gradient(points, axis=0)
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
    wander = np.interp(at, np.linspace(0, at[-1], 7), rng.normal(0, 1.2, 7))
    teeth = np.interp(at, np.linspace(0, at[-1], max(4, n // 5)), rng.normal(0, 1, max(4, n // 5)))
    ends = np.minimum(1.0, np.minimum(at, at[-1] - at) / 0.3)
    points += normal * (tooth_mm * (wander + teeth) * ends)[:, None]
    width = width_mm * np.exp(0.35 * np.interp(at, np.linspace(0, at[-1], n // 4 + 2), rng.normal(0, 1, n // 4 + 2)))
    return Stroke(points, width)


def _tree(rng: np.random.Generator, start: Array, heading: float, width_mm: float, length_mm: float) -> list[Stroke]:
    """A vessel that wanders, thins out and branches."""
    n = max(6, int(length_mm / 0.12))
    turns = np.cumsum(rng.normal(0.0, 0.22, n)) + heading
    points = start + np.cumsum(0.12 * np.column_stack([np.cos(turns), np.sin(turns)]), axis=0)
    widths = width_mm * np.linspace(1.0, 0.45, n)
    strokes = [Stroke(points, widths)]
    if width_mm > 0.045:
        for _ in range(rng.integers(1, 4)):
            k = int(rng.integers(n // 5, n))
            bend = turns[k] + rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.1)
            strokes += _tree(rng, points[k], bend, 0.62 * widths[k], rng.uniform(0.35, 0.65) * length_mm)
    return strokes
