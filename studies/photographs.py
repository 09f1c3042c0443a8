"""Photographs with a table of keypoints, made into a data set that `mill train` and `mill evaluate` read."""

import csv
import math
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from studies.datasets import read_card, write_card
from vision.keypoints import PICTURE_PX, letterboxed
from vision.runtime import Image, sha256_of

TABLE = "keypoints.csv"
IMAGES = "images"
NAMES = {"landmarks": ("bregma", "lambda"), "tip": ("tip",)}
"""Points by task, as they are called in the table's columns."""
FEWEST = 10
"""A smaller set cannot be split."""
SMALLEST_PX = 64
SHARES = {"validation": 0.1, "test": 0.1}
"""Taken from the end, in blocks: neighbours in number often show the same animal."""


@dataclass(frozen=True)
class Photograph:
    """A picture file and where its points are; NaN where a point is not to be seen."""

    file: Path
    points_px: npt.NDArray[np.float64]


def holds_photographs(folder: Path) -> bool:
    """Whether ``folder`` is one of photographs, and not a data set."""
    return (folder / TABLE).is_file()


def read_table(folder: Path, wanted: str | None = None) -> tuple[str, list[Photograph]]:
    """The task that the table's columns serve, and its rows in the order of the picture's numbers.

    Args:
        folder: has ``keypoints.csv`` and ``images/``.
        wanted: the task that the photographs are for; the first that the columns serve if None.

    Raises:
        ConfigError: names the file, the row and what is wrong with it.
    """
    table = folder / TABLE
    try:
        text = table.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{table}: cannot be read: {error}; a table of keypoints is needed there") from None
    rows = csv.DictReader(text.splitlines())
    columns = set(rows.fieldnames or ())
    tasks = {task: {f"{name}_{axis}_px" for name in names for axis in "xy"} for task, names in NAMES.items()}
    fitting = [task for task, needed in tasks.items() if {"image", *needed} <= columns]
    if not fitting:
        allowed = " or ".join(",".join(["image", *sorted(needed)]) for needed in tasks.values())
        raise ConfigError(f"{table}: found columns {','.join(sorted(columns)) or 'none'}; allowed: {allowed}")
    if wanted and wanted not in fitting:
        raise ConfigError(f"{table}: has the points of {fitting[0]}; those of {wanted} are needed")
    task = wanted or fitting[0]
    photographs, seen = [], set()
    for number, row in enumerate(rows, start=2):
        photograph = _photograph(folder, table, number, row, NAMES[task])
        if photograph.file.resolve() in seen:
            raise ConfigError(f"{table}, line {number}: {row['image']} stands twice; remove one of the rows")
        seen.add(photograph.file.resolve())
        photographs.append(photograph)
    if not photographs:
        raise ConfigError(f"{table}: found no rows; one per picture is needed")
    return task, sorted(photographs, key=lambda photograph: _natural(_name(folder, photograph)))


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
        folder: has ``keypoints.csv`` and ``images/``.
        out: must not be there yet, or be empty.
        wanted: the task that the photographs are for; any if None.
        only: put every photograph into this split.
        progress: called with the photographs done and their number.

    Returns:
        The task, and how many photographs went where.

    Raises:
        ConfigError: the first thing that is wrong; ``out`` stays as it was.
    """
    task, photographs = read_table(folder, wanted)
    parts = {only: photographs} if only else _blocks(folder, photographs)
    if out.is_dir() and any(out.iterdir()):
        raise ConfigError(f"{out}: is there already; name another folder, or remove it")
    out.parent.mkdir(parents=True, exist_ok=True)
    done = 0
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as scratch:
        draft = Path(scratch) / "set"
        for split, members in parts.items():
            (draft / split).mkdir(parents=True)
            shape = (len(members), PICTURE_PX[1], PICTURE_PX[0], 3)
            pictures = np.lib.format.open_memmap(draft / split / "pictures.npy", "w+", np.uint8, shape)
            points = []
            for index, member in enumerate(members):
                pictures[index], scale, corner = letterboxed(_read(member))
                points.append(member.points_px * scale + corner)
                done += 1
                progress(done, len(photographs))
            pictures.flush()
            np.save(draft / split / "points.npy", np.stack(points))
            np.save(draft / split / "visible.npy", np.isfinite(points).all(axis=2))
            about = {"source": "photographs", "table_sha256": digest(folder), "samples": len(members)}
            ends = {"first": _name(folder, members[0]), "last": _name(folder, members[-1])}
            write_card(draft, task, split, **about, **ends)
        draft.rename(out)
    return task, {split: len(members) for split, members in parts.items()}


def ensure_in(folder: Path, out: Path, task: str, *, progress: Callable[[int, int], None]) -> None:
    """Bring in the photographs of ``folder`` for ``task`` unless they are in ``out`` already.

    Raises:
        ConfigError: as ``bring_in``; or ``out`` holds something else.
    """
    if out.is_dir() and any(out.iterdir()):
        card = read_card(out)
        known = {split: about.get("table_sha256") for split, about in card.get("splits", {}).items()}
        if card.get("task") != task or known != dict.fromkeys(("train", *SHARES), digest(folder)):
            raise ConfigError(f"{out}: holds another data set than {folder}; remove it, or name another --out")
        return
    bring_in(folder, out, task, progress=progress)


def digest(folder: Path) -> str:
    """Of the table: tells whether two sets are of the same photographs."""
    return sha256_of(folder / TABLE)


def _name(folder: Path, photograph: Photograph) -> str:
    return photograph.file.relative_to(folder / IMAGES).as_posix()


def _photograph(
    folder: Path, table: Path, number: int, row: dict[str, str | None], names: tuple[str, ...]
) -> Photograph:
    image = (row["image"] or "").strip()
    file = folder / IMAGES / image
    if not image or not file.is_file():
        raise ConfigError(f"{table}, line {number}: no picture {file}; add it, or remove the row")
    points = []
    for name in names:
        texts = [(row[f"{name}_{axis}_px"] or "").strip() for axis in "xy"]
        try:
            place = [float(text) if text else math.nan for text in texts]
        except ValueError:
            raise ConfigError(
                f"{table}, line {number}: {name} is at {','.join(texts)}; "
                "allowed: two numbers in px, or nothing where it is not to be seen"
            ) from None
        if math.isinf(place[0]) or math.isinf(place[1]) or math.isnan(place[0]) != math.isnan(place[1]):
            raise ConfigError(f"{table}, line {number}: {name} is at {','.join(texts)}; allowed: two numbers, or none")
        points.append(place)
    if len(points) == 2 and points[0] == points[1]:
        raise ConfigError(f"{table}, line {number}: {' and '.join(names)} are at the same place; correct the row")
    return Photograph(file, np.array(points))


def _read(photograph: Photograph) -> Image:
    picture = cv2.imread(str(photograph.file), cv2.IMREAD_COLOR)
    if picture is None:
        raise ConfigError(f"{photograph.file}: is no picture that OpenCV can read; replace it, or remove its row")
    height, width = picture.shape[:2]
    if min(height, width) < SMALLEST_PX:
        raise ConfigError(f"{photograph.file}: {width}x{height} px; allowed: at least {SMALLEST_PX} px a side")
    points = photograph.points_px
    with np.errstate(invalid="ignore"):
        outside = (points < 0) | (points > [width - 1, height - 1])
    if outside.any():
        place = ",".join(f"{value:g}" for value in points[outside.any(axis=1)][0])
        raise ConfigError(
            f"{photograph.file}: a point at {place} lies outside its {width}x{height} px; correct its row"
        )
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8)


def _blocks(folder: Path, photographs: list[Photograph]) -> dict[str, list[Photograph]]:
    if len(photographs) < FEWEST:
        raise ConfigError(
            f"{folder / TABLE}: {len(photographs)} photographs; at least {FEWEST} are needed to train and to judge"
        )
    counts = {split: max(1, round(share * len(photographs))) for split, share in SHARES.items()}
    train = len(photographs) - sum(counts.values())
    middle = train + counts["validation"]
    return {"train": photographs[:train], "validation": photographs[train:middle], "test": photographs[middle:]}


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts 9.jpg before 10.jpg."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
