"""An album of photographs with tables of labels, made into a data set that `mill train` and `mill evaluate` read."""

import csv
import json
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from studies.datasets import read_card, store, write_card
from studies.painted_rings import read_rings
from vision.album import EXPORTED, IMAGES, KEYPOINTS, POINTS, RINGS, UNTOLD, natural, read_picture
from vision.keypoints import letterboxed
from vision.runtime import sha256_of

FEWEST = 10
"""A smaller set cannot be split."""
SHARES = {"validation": 0.1, "test": 0.1}
"""Taken from the end, in blocks: neighbours in number often show the same animal."""


class Member(Protocol):
    """One labelled picture."""

    @property
    def row(self) -> str:
        """Where it stands in its table, for people."""

    @property
    def file(self) -> Path:
        """The picture."""

    def sample(self) -> dict[str, npt.NDArray[np.generic]]:
        """As its task takes it."""


@dataclass(frozen=True)
class Photograph:
    """A picture file and where its points are; NaN where a point is not to be seen."""

    row: str
    file: Path
    points_px: npt.NDArray[np.float64]

    def sample(self) -> dict[str, npt.NDArray[np.generic]]:
        """As a ``KeypointTask`` takes it.

        Raises:
            ConfigError: the picture cannot be read, or a point lies outside it.
        """
        picture = read_picture(self.file)
        height, width = picture.shape[:2]
        with np.errstate(invalid="ignore"):
            outside = (self.points_px < 0) | (self.points_px > [width - 1, height - 1])
        if outside.any():
            place = ",".join(f"{value:g}" for value in self.points_px[outside.any(axis=1)][0])
            raise ConfigError(f"{self.file}: a point at {place} lies outside its {width}x{height} px; correct its row")
        boxed, scale, corner = letterboxed(picture)
        points = self.points_px * scale + corner
        return {"pictures": boxed, "points": points, "visible": np.asarray(np.isfinite(points).all(axis=1))}


def holds_photographs(folder: Path) -> bool:
    """Whether ``folder`` is an album with labels, and not a data set."""
    return any((folder / table).is_file() for table in (KEYPOINTS, RINGS))


def read_album(folder: Path, wanted: str | None = None) -> tuple[str, list[Member]]:
    """The task that the tables serve, and its labelled pictures in the order of their numbers.

    Args:
        folder: has ``images/``, and ``keypoints.csv`` or ``rings.csv``.
        wanted: the task that the photographs are for; the first that the tables serve if None.

    Raises:
        ConfigError: names the file, the row and what is wrong with it.
    """
    if wanted is None and not (folder / KEYPOINTS).is_file() and (folder / RINGS).is_file():
        wanted = "completion"
    task, members = ("completion", read_rings(folder)) if wanted == "completion" else read_table(folder, wanted)
    if not members:
        raise ConfigError(f"{table_of(folder, task)}: found no rows of {task}; one per picture is needed")
    seen: set[Path] = set()
    for member in members:
        if member.file.resolve() in seen:
            raise ConfigError(f"{member.row}: {_name(folder, member)} stands twice; remove one of the rows")
        seen.add(member.file.resolve())
    return task, sorted(members, key=lambda member: natural(_name(folder, member)))


def read_table(folder: Path, wanted: str | None = None) -> tuple[str, Sequence[Photograph]]:
    """The task that the columns of ``keypoints.csv`` serve, and its rows but those that say nothing of it.

    Args:
        folder: has ``keypoints.csv`` and ``images/``.
        wanted: the first task that the columns serve if None.

    Raises:
        ConfigError: names the file, the row and what is wrong with it.
    """
    table = folder / KEYPOINTS
    try:
        text = table.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{table}: cannot be read: {error}; a table of keypoints is needed there") from None
    rows = csv.DictReader(text.splitlines())
    columns = set(rows.fieldnames or ())
    tasks = {task: {f"{name}_{axis}_px" for name in names for axis in "xy"} for task, names in POINTS.items()}
    fitting = [task for task, needed in tasks.items() if {"image", *needed} <= columns]
    if not fitting:
        allowed = " or ".join(",".join(["image", *sorted(needed)]) for needed in tasks.values())
        raise ConfigError(f"{table}: found columns {','.join(sorted(columns)) or 'none'}; allowed: {allowed}")
    if wanted and wanted not in fitting:
        raise ConfigError(f"{table}: has the points of {fitting[0]}; those of {wanted} are needed")
    task = wanted or fitting[0]
    photographs = [_photograph(folder, table, number, row, POINTS[task]) for number, row in enumerate(rows, start=2)]
    return task, [photograph for photograph in photographs if photograph is not None]


def bring_in(
    folder: Path,
    out: Path,
    wanted: str | None = None,
    *,
    only: str | None = None,
    progress: Callable[[int, int], None],
) -> tuple[str, dict[str, int]]:
    """Make the photographs of ``folder`` into the data set ``out``, whole or not at all.

    Args:
        folder: the album.
        out: must not be there yet, or be empty.
        wanted: the task that the photographs are for; any if None.
        only: put every photograph into this split.
        progress: called with the photographs done and their number.

    Returns:
        The task, and how many photographs went where.

    Raises:
        ConfigError: the first thing that is wrong; ``out`` stays as it was.
    """
    task, members = read_album(folder, wanted)
    parts = {only: members} if only else _blocks(folder, task, members)
    if out.is_dir() and any(out.iterdir()):
        raise ConfigError(f"{out}: is there already; name another folder, or remove it")
    out.parent.mkdir(parents=True, exist_ok=True)
    done = 0
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as scratch:
        draft = Path(scratch) / "set"
        for split, chosen in parts.items():
            (draft / split).mkdir(parents=True)
            for index, member in enumerate(chosen):
                for name, value in member.sample().items():
                    store(draft / split / f"{name}.npy", value[None], index, len(chosen))
                done += 1
                progress(done, len(members))
            about = {"source": "photographs", "table_sha256": digest(folder, task), "samples": len(chosen)}
            ends = {"first": _name(folder, chosen[0]), "last": _name(folder, chosen[-1])}
            write_card(draft, task, split, **about, **ends, **labels_of(folder, task))
        draft.rename(out)
    return task, {split: len(chosen) for split, chosen in parts.items()}


def ensure_in(folder: Path, out: Path, task: str, *, progress: Callable[[int, int], None]) -> None:
    """Bring in the photographs of ``folder`` for ``task`` unless they are in ``out`` already.

    Raises:
        ConfigError: as ``bring_in``; or ``out`` holds something else.
    """
    if out.is_dir() and any(out.iterdir()):
        card = read_card(out)
        known = {split: about.get("table_sha256") for split, about in card.get("splits", {}).items()}
        if card.get("task") != task or known != dict.fromkeys(("train", *SHARES), digest(folder, task)):
            raise ConfigError(f"{out}: holds another data set than {folder}; remove it, or name another --out")
        return
    bring_in(folder, out, task, progress=progress)


def table_of(folder: Path, task: str) -> Path:
    """The table that holds the labels for a task."""
    return folder / (RINGS if task == "completion" else KEYPOINTS)


def digest(folder: Path, task: str) -> str:
    """Of the table: tells whether two sets are of the same photographs."""
    return sha256_of(table_of(folder, task))


def labels_of(folder: Path, task: str) -> dict[str, Any]:
    """``labels``: whose they are and how far those differ, where `mill annotate` wrote the table as it is."""
    try:
        told = json.loads((folder / EXPORTED).read_text(encoding="utf-8"))[table_of(folder, task).name]
        return {"labels": told["labels"][task]} if told["sha256"] == digest(folder, task) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _name(folder: Path, member: Member) -> str:
    return member.file.relative_to(folder / IMAGES).as_posix()


def _photograph(
    folder: Path, table: Path, number: int, row: dict[str, str | None], names: tuple[str, ...]
) -> Photograph | None:
    """One row; None where it says nothing of a point."""
    image = (row["image"] or "").strip()
    file = folder / IMAGES / image
    if not image or not file.is_file():
        raise ConfigError(f"{table}, line {number}: no picture {file}; add it, or remove the row")
    points = []
    for name in names:
        texts = [(row[f"{name}_{axis}_px"] or "").strip() for axis in "xy"]
        if texts == [UNTOLD, UNTOLD]:
            return None
        try:
            place = [float(text) if text else math.nan for text in texts]
        except ValueError:
            raise ConfigError(
                f"{table}, line {number}: {name} is at {','.join(texts)}; "
                f"allowed: two numbers in px, nothing where it is not to be seen, or {UNTOLD},{UNTOLD}"
            ) from None
        if math.isinf(place[0]) or math.isinf(place[1]) or math.isnan(place[0]) != math.isnan(place[1]):
            raise ConfigError(f"{table}, line {number}: {name} is at {','.join(texts)}; allowed: two numbers, or none")
        points.append(place)
    if len(points) == 2 and points[0] == points[1]:
        raise ConfigError(f"{table}, line {number}: {' and '.join(names)} are at the same place; correct the row")
    return Photograph(f"{table}, line {number}", file, np.array(points))


def _blocks(folder: Path, task: str, members: list[Member]) -> dict[str, list[Member]]:
    if len(members) < FEWEST:
        raise ConfigError(
            f"{table_of(folder, task)}: {len(members)} photographs; at least {FEWEST} are needed to train and to judge"
        )
    counts = {split: max(1, round(share * len(members))) for split, share in SHARES.items()}
    train = len(members) - sum(counts.values())
    middle = train + counts["validation"]
    return {"train": members[:train], "validation": members[train:middle], "test": members[middle:]}
