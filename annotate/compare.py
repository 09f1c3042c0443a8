"""How far annotators differ over the same pictures: what no network that learns from them can be better than."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from annotate.labels import Label, Labels, Place, Ring
from vision.album import POINTS
from vision.keypoints import SPAN_MM

NAMES = tuple(name for names in POINTS.values() for name in names)
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Difference:
    """Two annotators over one thing in one picture; None where a figure cannot be told."""

    picture: str
    what: str
    """A point, or "ring"."""
    between: tuple[str, str]
    px: float | None
    """Apart; of rings, their middles. None where only one of the two sees it."""
    mm: float | None = None
    """Apart, by the distance from bregma to lambda in the same picture."""
    along_mm: float | None = None
    """Its part along the line from bregma to lambda, and across it."""
    across_mm: float | None = None
    completion: float | None = None
    """Mean difference along a ring where both could tell it."""


def differences(labels: dict[str, Labels]) -> list[Difference]:
    """Of every two annotators, over the pictures that both labelled."""
    found: list[Difference] = []
    for one, two in itertools.combinations(sorted(labels), 2):
        for picture in labels[one].keys() & labels[two].keys():
            found += _in_picture(picture, (one, two), labels[one][picture], labels[two][picture])
    return sorted(found, key=lambda each: (each.picture, each.what, each.between))


def summary(found: Sequence[Difference]) -> list[dict[str, Any]]:
    """A row for each pair of annotators and each thing: how many, how far apart, and how often one alone saw it."""
    rows = []
    for between, what in sorted({(each.between, each.what) for each in found}):
        mine = [each for each in found if (each.between, each.what) == (between, what)]
        rows.append(
            {
                "between": list(between),
                "what": what,
                "n": sum(each.px is not None for each in mine),
                "one_alone": sum(each.px is None for each in mine),
                **_figures("px", (each.px for each in mine)),
                **_figures("mm", (each.mm for each in mine)),
                "along_mean_mm": _mean(each.along_mm for each in mine),
                "across_mean_mm": _mean(each.across_mm for each in mine),
                "completion_mean": _mean(each.completion for each in mine),
            }
        )
    return rows


def as_json(found: Iterable[Difference]) -> list[dict[str, Any]]:
    """Plain objects."""
    return [asdict(each) for each in found]


def _in_picture(picture: str, between: tuple[str, str], one: Label, two: Label) -> Iterable[Difference]:
    line = _line(one, two)
    for name in NAMES:
        if name in one.points and name in two.points:
            a, b = (label.points[name] for label in (one, two))
            if isinstance(a, Place) and isinstance(b, Place):
                yield _apart(picture, name, between, np.array([b.x_px - a.x_px, b.y_px - a.y_px]), line)
            elif isinstance(a, Place) or isinstance(b, Place):
                yield Difference(picture, name, between, None)
    if isinstance(one.ring, Ring) and isinstance(two.ring, Ring):
        px = float(np.hypot(one.ring.center_x_px - two.ring.center_x_px, one.ring.center_y_px - two.ring.center_y_px))
        yield Difference(picture, "ring", between, px, completion=_apart_in_completion(one.ring, two.ring))
    elif (isinstance(one.ring, Ring) and two.ring == "none") or (one.ring == "none" and isinstance(two.ring, Ring)):
        yield Difference(picture, "ring", between, None)


def _line(one: Label, two: Label) -> Floats | None:
    """From bregma to lambda in px, as the two have it on average."""
    lines = []
    for label in (one, two):
        bregma, lambda_ = label.points.get("bregma"), label.points.get("lambda")
        if isinstance(bregma, Place) and isinstance(lambda_, Place):
            lines.append([lambda_.x_px - bregma.x_px, lambda_.y_px - bregma.y_px])
    line = np.mean(lines, axis=0) if lines else np.zeros(2)
    return line if np.hypot(*line) > 0 else None


def _apart(picture: str, what: str, between: tuple[str, str], by_px: Floats, line: Floats | None) -> Difference:
    px = float(np.hypot(*by_px))
    if line is None:
        return Difference(picture, what, between, px)
    length = float(np.hypot(*line))
    along = abs(float(by_px @ line)) / length
    across = abs(float(by_px[0] * line[1] - by_px[1] * line[0])) / length
    scale = SPAN_MM / length
    return Difference(picture, what, between, px, px * scale, along * scale, across * scale)


def _apart_in_completion(one: Ring, two: Ring) -> float | None:
    n = max(len(one.completion), len(two.completion))
    apart = np.abs(told_along(one, n) - told_along(two, n))
    return float(np.nanmean(apart)) if np.isfinite(apart).any() else None


def told_along(ring: Ring, n: int) -> Floats:
    """(n,) completion at the nearest painted point; NaN where it was not told."""
    told = np.array([np.nan if value is None else value for value in ring.completion])
    return np.asarray(told[np.round(np.arange(n) * len(told) / n).astype(int) % len(told)])


def _figures(unit: str, values: Iterable[float | None]) -> dict[str, float | None]:
    told = np.array([value for value in values if value is not None])
    if not len(told):
        return dict.fromkeys((f"mean_{unit}", f"median_{unit}", f"worst_{unit}"))
    return {
        f"mean_{unit}": float(told.mean()),
        f"median_{unit}": float(np.median(told)),
        f"worst_{unit}": float(told.max()),
    }


def _mean(values: Iterable[float | None]) -> float | None:
    told = [value for value in values if value is not None]
    return float(np.mean(told)) if told else None
