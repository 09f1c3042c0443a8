"""What pictures get wrong, measured: readings of whole runs with full pixels, kept to be drawn from.

    mill experiment milling --trials 16 --seed 5000 --out DIR
    python -m studies.perception DIR

condenses the readings that the full-pixel trials of policy ``default`` left in DIR into ``perception.npz`` beside this
file. A run of the statistical mode takes one of these runs as its donor: whatever the donor's network read at one
of its points at an excess (depth past the inner surface), the run reads at a point of its own at the same excess. So
what a specimen's light does to all of its points, and what thin bone does to an arc, stays together.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from studies.ring_truth import UNTOUCHED_MM, RingTruth

Floats = npt.NDArray[np.float64]

FILE: Final = Path(__file__).with_name("perception.npz")
BIN_MM: Final = 0.005
LOWEST_MM: Final = -0.4
KEPT: Final = 2
"""Readings of one point in one bin."""
NEAR_MM: Final = 0.004
BEYOND: Final = ((-0.02, 0.9), (0.0, 0.96), (0.015, 0.98), (0.04, 1.0))
"""Completion by excess where a donor was never cut so deep; ``milling.thickness`` has the same medians."""


@dataclass
class Readings:
    """What was read of each point of one ring, against the truth. Columns of ``rows``: point, excess, c, upper."""

    truth: RingTruth
    rows: list[Floats]

    def add(self, completion: Floats, upper: Floats, visible: npt.NDArray[np.bool_]) -> None:
        """One reading of the ring."""
        index = np.flatnonzero(visible & np.isfinite(completion))
        excess = self.truth.excess_mm()[index]
        self.rows.append(np.column_stack([index, excess, completion[index], upper[index]]))

    def condensed(self) -> npt.NDArray[np.float32]:
        """(m, 4): at most ``KEPT`` readings of each point in each bin of excess, spread over those there were."""
        rows = np.concatenate([np.zeros((0, 4)), *self.rows])
        rows = rows[rows[:, 1] > LOWEST_MM]
        cell = rows[:, 0] * 1000 + np.floor((rows[:, 1] - LOWEST_MM) / BIN_MM)
        kept = []
        for one in np.unique(cell):
            where = np.flatnonzero(cell == one)
            kept.append(where[np.linspace(0, len(where) - 1, min(KEPT, len(where))).astype(int)])
        return rows[np.sort(np.concatenate(kept))].astype(np.float32) if kept else np.zeros((0, 4), np.float32)


class Donor:
    """One recorded run that lends its readings."""

    def __init__(self, rows: npt.NDArray[np.float32]) -> None:
        self._points = []
        for index in range(int(rows[:, 0].max()) + 1):
            mine = rows[rows[:, 0] == index, 1:].astype(np.float64)
            self._points.append(mine[np.argsort(mine[:, 0], kind="stable")])
        self._points = [point for point in self._points if len(point)]

    def read(self, at: Floats, excess_mm: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Completion and upper bound (n,) of points at ``at`` (n,), shares of the way round, at ``excess_mm`` (n,)."""
        n = len(self._points)
        read = [self._one(self._points[int(place * n) % n], x, rng) for place, x in zip(at, excess_mm, strict=True)]
        completion, upper = np.array(read).T
        return completion, upper

    def _one(self, rows: Floats, excess_mm: float, rng: np.random.Generator) -> tuple[float, float]:
        if excess_mm <= -UNTOUCHED_MM:
            return 0.0, min(1.0, float(rows[0, 2] - rows[0, 1]))
        low, high = np.searchsorted(rows[:, 0], [excess_mm - NEAR_MM, excess_mm + NEAR_MM])
        nearest = min(int(low), len(rows) - 1)
        chosen = rows[rng.integers(low, high) if high > low else nearest]
        completion, upper = float(chosen[1]), float(chosen[2])
        beyond_mm = excess_mm - rows[-1, 0]
        if beyond_mm > NEAR_MM:
            # The donor was never cut so deep here: what it got wrong at its deepest stays, as far as it goes.
            at_mm = np.interp(completion, *np.array(BEYOND).T[::-1]) + beyond_mm
            completion = max(completion, float(np.interp(at_mm, *np.array(BEYOND).T)))
            upper = max(upper, completion)
        return completion, upper


def donors(file: Path = FILE) -> list[Donor]:
    """All runs of the file.

    Raises:
        ConfigError: there is no such file.
    """
    if not file.is_file():
        raise ConfigError(f"{file}: no measured readings; make them with `python -m studies.perception DIR`")
    with np.load(file) as stored:
        return [Donor(stored[name]) for name in stored.files]


def main(words: Sequence[str] | None = None) -> None:
    """Condense the readings of a folder of trials."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what `mill experiment milling --out` wrote")
    parser.add_argument("--out", type=Path, default=FILE)
    given = parser.parse_args(words)
    files = [file for file in sorted(given.folder.glob("*.readings.npy")) if len(np.load(file))]
    if not files:
        raise SystemExit(f"{given.folder}: no readings; make some with `mill experiment milling --out {given.folder}`")
    runs = {file.name.removesuffix(".readings.npy"): np.load(file) for file in files}
    np.savez_compressed(given.out, **runs)
    print(f"{given.out}: {len(runs)} runs, {sum(map(len, runs.values()))} readings, {given.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
