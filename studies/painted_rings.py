"""Rings that somebody painted in photographs, made into what the completion network learns from.

What a person tells is how far the kerf's middle line is milled. Beside it the label says only what follows from that:
near the middle line the same, clearly outside the ball's width no kerf, and nothing of what lies between.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from vision.album import (
    FEWEST_RING_POINTS,
    IMAGES,
    MOST_RING_POINTS,
    RING_COLUMNS,
    RINGS,
    UNTOLD,
    read_picture,
    ring_points,
)
from vision.completion import MISSING
from vision.completion_training import HIDDEN, KERF_FROM, LEVELS, STORED_PX
from vision.runtime import Image
from vision.strip import BALL_PX, CELL_PX, CELLS, unroll

Array = npt.NDArray[np.float64]

SAME_DEPTH_BALLS = 0.25
"""So near to the middle line, in radii of the ball, its floor is as good as level."""
NO_KERF_BALLS = 1.2
"""From here on there is no kerf: the ball and what its run-out adds lie inside."""


@dataclass(frozen=True)
class PaintedRing:
    """A ring in a picture; NaN in ``completion`` where it could not be told."""

    row: str
    file: Path
    reference: Path | None
    """The same view before milling."""
    center_px: tuple[float, float]
    radius_px: float
    ball_px: float
    completion: Array

    def sample(self) -> dict[str, npt.NDArray[np.generic]]:
        """As ``CompletionTask`` takes it. The kerf's box is not known: nobody drew it.

        Raises:
            ConfigError: the picture cannot be read, or the ring does not lie in it.
        """
        now = read_picture(self.file)
        ring_px = ring_points(self.center_px, self.radius_px, CELLS[1])
        _require_inside(self.file, now, ring_px)
        strip = unroll(ring_px, self.ball_px, across_px=STORED_PX)
        before = np.full((*strip.x_px.shape, 3), MISSING, np.uint8)
        if self.reference is not None:
            reference = read_picture(self.reference)
            if reference.shape != now.shape:
                raise ConfigError(
                    f"{self.reference}: {_size(reference)} px, and {self.file} {_size(now)} px; a reference is the "
                    f"same view before milling: correct its row of {RINGS}, or leave it empty"
                )
            before = strip.cut(reference)
        along = along_ring(self.completion, CELLS[1])
        return {
            "strips": np.concatenate([strip.cut(now), before], axis=2),
            "maps": _map(along),
            "completions": np.nan_to_num(along),
            "hidden": np.isnan(along),
            "rings_px": ring_px,
            "balls_px": np.asarray(self.ball_px),
            "boxes_px": np.full(4, np.nan),
        }


def along_ring(completion: Array, n: int) -> Array:
    """(n,) completion at equal shares of the way round, from that at the painted points; NaN beside what is unknown."""
    place = np.arange(n) * len(completion) / n
    before = np.floor(place).astype(int)
    share = place - before
    after = np.where(share > 0, (before + 1) % len(completion), before)
    return np.asarray(completion[before] * (1 - share) + completion[after] * share, dtype=np.float64)


def _map(along: Array) -> npt.NDArray[np.uint8]:
    """(STORED_PX, ALONG_PX) in ``LEVELS``, ``HIDDEN`` where it is not known."""
    columns = np.repeat(along, CELL_PX[1])[None]
    away = np.abs(np.arange(STORED_PX) - (STORED_PX - 1) / 2)[:, None] / BALL_PX
    levels = np.round(LEVELS * np.nan_to_num(columns)) * (away < SAME_DEPTH_BALLS)
    unknown = (away >= SAME_DEPTH_BALLS) & (away < NO_KERF_BALLS) & (columns > KERF_FROM)
    return np.where(unknown | np.isnan(columns), HIDDEN, levels).astype(np.uint8)


def read_rings(folder: Path) -> list[PaintedRing]:
    """The rows of the table of an album.

    Raises:
        ConfigError: names the file, the row and what is wrong with it.
    """
    table = folder / RINGS
    try:
        rows = csv.DictReader(table.read_text(encoding="utf-8-sig").splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{table}: cannot be read: {error}; a table of painted rings is needed there") from None
    columns = list(rows.fieldnames or ())
    if set(columns) != set(RING_COLUMNS):
        found = ",".join(columns) or "none"
        raise ConfigError(f"{table}: found columns {found}; allowed: {','.join(RING_COLUMNS)}")
    return [_ring(folder, f"{table}, line {number}", row) for number, row in enumerate(rows, start=2)]


def _ring(folder: Path, where: str, row: dict[str, str | None]) -> PaintedRing:
    texts = {name: (row[name] or "").strip() for name in RING_COLUMNS}
    files = {name: folder / IMAGES / texts[name] for name in ("image", "reference")}
    for name, file in files.items():
        if (texts[name] or name == "image") and not file.is_file():
            raise ConfigError(f"{where}: no picture {file}; add it, or correct the row")
    values = [_number(where, name, texts[name]) for name in RING_COLUMNS[1:5]]
    if min(values[2:]) <= 0:
        raise ConfigError(f"{where}: radius_px {values[2]:g} and ball_px {values[3]:g}; allowed: above 0")
    told = [math.nan if text == UNTOLD else _number(where, "completion", text) for text in texts["completion"].split()]
    if not FEWEST_RING_POINTS <= len(told) <= MOST_RING_POINTS:
        allowed = f"{FEWEST_RING_POINTS} to {MOST_RING_POINTS}"
        raise ConfigError(f"{where}: completion at {len(told)} points; allowed: {allowed}, with spaces between")
    if any(value < 0 or value > 1 for value in told):
        raise ConfigError(f"{where}: completion {texts['completion']}; allowed: 0 to 1, or {UNTOLD} where unknown")
    reference = files["reference"] if texts["reference"] else None
    return PaintedRing(where, files["image"], reference, (values[0], values[1]), values[2], values[3], np.array(told))


def _number(where: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{where}: {name} is {text or 'empty'}; allowed: a number")
    return value


def _require_inside(file: Path, picture: Image, ring_px: Array) -> None:
    if (ring_px < 0).any() or (ring_px > [picture.shape[1] - 1, picture.shape[0] - 1]).any():
        raise ConfigError(f"{file}: its ring does not lie inside its {_size(picture)} px; correct its row of {RINGS}")


def _size(picture: Image) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"
