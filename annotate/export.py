"""The labels of an album as the tables that `mill dataset import` reads."""

import csv
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from annotate.compare import differences, summary, told_along
from annotate.labels import FOLDER, Label, Labels, Place, Ring, annotators_of, read_labels, replace_text, write_whole
from drivers.errors import ConfigError
from vision.album import EXPORTED, KEYPOINTS, POINTS, RING_COLUMNS, RINGS, UNTOLD, pictures_in
from vision.keypoints import SPAN_MM

APART_MM = 1.0
"""Landmarks of two annotators farther apart than this are not the same thing seen by two people."""
APART_PX = 12.0
"""The same for the drill's tip, which has no scale of its own."""
_OPEN = [UNTOLD, UNTOLD]


@dataclass(frozen=True)
class Exported:
    """What went into the tables."""

    rows: dict[str, int]
    """Pictures by task."""
    unsettled: tuple[str, ...]
    """What was left out because the annotators contradict each other, in words."""


def all_labels(album: Path, chosen: Sequence[str] = ()) -> dict[str, Labels]:
    """The labels of the annotators ``chosen``, of all if none are.

    Raises:
        ConfigError: nobody has labelled anything, or not one who was chosen.
    """
    known = annotators_of(album)
    if not known:
        raise ConfigError(f"{album / FOLDER}: nobody has labelled anything; begin with `mill annotate {album}`")
    for name in chosen:
        if name not in known:
            raise ConfigError(f"{album / FOLDER}: nobody called {name}; there are {', '.join(known)}")
    return {name: read_labels(album / FOLDER / f"{name}.json") for name in chosen or known}


def export(album: Path, chosen: Sequence[str] = ()) -> Exported:
    """Write ``keypoints.csv`` and ``rings.csv``, as far as there is something for them.

    Where several annotators placed a point it is the mean of theirs. What they contradict each other about is left out.

    Raises:
        ConfigError: there are no labels, or a table is there that this did not write.
    """
    labels = all_labels(album, chosen)
    pictures = pictures_in(album)
    unsettled: list[str] = []
    by_task = {task: _keypoints(labels, pictures, names, unsettled) for task, names in POINTS.items()}
    rings = _rings(labels, pictures, unsettled)
    rows = {task: len(told) for task, told in by_task.items() if told} | ({"completion": len(rings)} if rings else {})
    if not rows:
        raise ConfigError(f"{album / FOLDER}: no picture is labelled whole; go on with `mill annotate {album}`")
    tables = {}
    told = {task: told for task, told in by_task.items() if told}
    if told:
        tables[KEYPOINTS] = _keypoint_table(told, pictures), {task: _about(labels, task) for task in told}
    if rings:
        tables[RINGS] = _written([list(RING_COLUMNS), *rings]), {"completion": _about(labels, "completion")}
    _replace(album, tables)
    return Exported(rows, tuple(unsettled))


def _keypoints(
    labels: dict[str, Labels], pictures: Sequence[str], names: Sequence[str], unsettled: list[str]
) -> dict[str, dict[str, list[str]]]:
    """By picture, the cells of each point; only pictures about which all points are told."""
    told = {}
    for picture in pictures:
        here = [each[picture] for each in labels.values() if picture in each]
        cells = {name: _agreed(picture, name, here, unsettled) for name in names}
        if _OPEN not in cells.values():
            told[picture] = cells
    return told


def _agreed(picture: str, name: str, here: Sequence[Label], unsettled: list[str]) -> list[str]:
    said = [label.points[name] for label in here if name in label.points]
    places = np.array([[place.x_px, place.y_px] for place in said if isinstance(place, Place)])
    if not said:
        return _OPEN
    if len(places) == 0:
        return ["", ""]
    if len(places) < len(said):
        unsettled.append(f"{picture}: {name} is seen by {len(places)} of {len(said)}")
        return _OPEN
    middle = places.mean(axis=0)
    apart = float(np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)).max())
    scale = _scale(here)
    far, unit, most = (apart * scale, "mm", APART_MM) if scale else (apart, "px", APART_PX)
    if far > most:
        unsettled.append(f"{picture}: {name} lies {far:.2g} {unit} apart, more than {most:g}")
        return _OPEN
    return [_number(value) for value in middle]


def _scale(here: Sequence[Label]) -> float | None:
    """Mm per px, by the mean distance from bregma to lambda."""
    spans = []
    for label in here:
        bregma, lambda_ = label.points.get("bregma"), label.points.get("lambda")
        if isinstance(bregma, Place) and isinstance(lambda_, Place):
            spans.append(float(np.hypot(bregma.x_px - lambda_.x_px, bregma.y_px - lambda_.y_px)))
    return SPAN_MM / float(np.mean(spans)) if spans and np.mean(spans) > 0 else None


def _keypoint_table(told: dict[str, dict[str, dict[str, list[str]]]], pictures: Sequence[str]) -> str:
    names = [(task, name) for task in told for name in POINTS[task]]
    rows = [["image", *(f"{name}_{axis}_px" for _, name in names for axis in "xy")]]
    for picture in pictures:
        if any(picture in cells for cells in told.values()):
            cells = [told[task][picture][name] if picture in told[task] else _OPEN for task, name in names]
            rows.append([picture, *(cell for pair in cells for cell in pair)])
    return _written(rows)


def _rings(labels: dict[str, Labels], pictures: Sequence[str], unsettled: list[str]) -> list[list[str]]:
    rows = []
    for picture in pictures:
        said = [each[picture].ring for each in labels.values() if picture in each and each[picture].ring is not None]
        rings = [ring for ring in said if isinstance(ring, Ring)]
        if not rings:
            continue
        first = rings[0]
        away = max(np.hypot(r.center_x_px - first.center_x_px, r.center_y_px - first.center_y_px) for r in rings)
        if len(rings) < len(said) or away > first.ball_px:
            unsettled.append(f"{picture}: its ring is another for each of {', '.join(labels)}")
            continue
        # What one of them could not tell is not told.
        completion = np.mean([told_along(ring, len(first.completion)) for ring in rings], axis=0)
        if np.isfinite(completion).any():
            place = [first.center_x_px, first.center_y_px, first.radius_px, first.ball_px]
            shares = " ".join(UNTOLD if np.isnan(value) else _number(value) for value in completion)
            rows.append([picture, *map(_number, place), first.reference or "", shares])
    return rows


def _about(labels: dict[str, Labels], task: str) -> dict[str, Any]:
    """Whose labels they are, how many came from a network, and how far the annotators differ."""
    names = POINTS.get(task, ("ring",))
    origins: dict[str, int] = {}
    for each in labels.values():
        for label in each.values():
            for said in [label.ring] if task == "completion" else [label.points.get(name) for name in names]:  # type: ignore[call-overload]
                if isinstance(said, Place | Ring):
                    origins[said.origin] = origins.get(said.origin, 0) + 1
    rows = [row for row in summary(differences(labels)) if row["what"] in names]
    kept = ("between", "what", "n", "one_alone", "mean_px", "median_px", "mean_mm", "median_mm", "completion_mean")
    apart = [{key: row[key] for key in kept if row[key] is not None} for row in rows]
    return {"annotators": sorted(labels), "origins": dict(sorted(origins.items())), "apart": apart}


def _replace(album: Path, tables: dict[str, tuple[str, dict[str, Any]]]) -> None:
    """Put the tables into the album, unless somebody else's are there."""
    file = album / EXPORTED
    try:
        before = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = {}
    about = {}
    for name, (text, labels) in tables.items():
        found = _digest_of(album / name)
        mine = before.get(name, {})
        if found is not None and found not in (mine.get("sha256"), mine.get("before")):
            raise ConfigError(
                f"{album / name}: is there already, and not as `mill annotate` wrote it; move it away, then export "
                "again"
            )
        about[name] = {"sha256": hashlib.sha256(text.encode()).hexdigest(), "before": found, "labels": labels}
    for name in (KEYPOINTS, RINGS):
        # A table of labels that are gone would be taken for one that still holds.
        if name not in tables and name in before and _digest_of(album / name) == before[name]["sha256"]:
            (album / name).unlink()
    write_whole(file, about)
    for name, (text, _) in tables.items():
        replace_text(album / name, text)


def _digest_of(file: Path) -> str | None:
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None


def _written(rows: Sequence[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _number(value: float) -> str:
    return f"{value:.3f}".rstrip("0").rstrip(".")
