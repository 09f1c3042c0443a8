"""What load and pictures said, against how deep the ball was in truth: the error model of ``milling.thickness``.

    mill experiment milling --trials 24 --out DIR
    python -m studies.cue_errors DIR

For every point and lap of the recorded runs: the excess (depth less the depth at which the ball comes through, run-out
included), the load ratio of a new pass, the completion read last. Prints the median and the spread by excess. Beyond
some 40 um only passes are seen that the rules allowed, so the far end reads a little too high.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from firmware_sim.skull import Skull
from firmware_sim.specimen import draw_specimen
from milling.record import Run, read_run
from studies.ring_truth import through_z_mm
from studies.trials import World

Floats = npt.NDArray[np.float64]

EDGES_MM = (-0.3, -0.15, -0.1, -0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.065, 0.1)
READ = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.89, 0.93, 0.955, 0.975, 0.985, 0.992, 1.001)
"""Completions."""


@dataclass(frozen=True, eq=False)
class Cues:
    """Excess in mm against load ratio, and against completion."""

    load: Floats
    """(n, 2)"""
    completion: Floats
    """(m, 2)"""
    share: Floats
    """(m, 2) completion against the share of the way to T that is cut."""


def cues_of(run: Run) -> Cues:
    """What one run's record holds; nothing for a run that ended before all contacts were found."""
    seed = int(run.header["seed"])
    # Trials of an experiment count their mice from a place of their own.
    specimen = World(seed, _file(run)).specimen() if "statistical" in run.header else draw_specimen(seed)
    contact_mm = np.array([event["z_mm"] for event in run.of_kind("contact")])
    ball_mm = np.array([event["ball_mm"] for event in run.of_kind("trajectory")]).reshape(-1, 3)
    if len(contact_mm) == 0 or len(contact_mm) < len(ball_mm):
        return Cues(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)))
    offset_z_mm = specimen.tool.ball_radius_mm * specimen.tool.axis[2]
    through = contact_mm + offset_z_mm - through_z_mm(specimen, Skull(specimen), ball_mm[:, :2])
    load: list[tuple[float, float]] = []
    completion: list[tuple[float, float]] = []
    share: list[tuple[float, float]] = []
    before: list[float | None] = [None] * len(through)
    for lap in run.of_kind("lap"):
        for index, (depth, ratio, seen) in enumerate(
            zip(lap["depth_mm"], lap["load_ratio"], lap["completion"], strict=True)
        ):
            if depth <= 0:
                continue
            excess = depth - through[index]
            completion.append((excess, seen))
            share.append((seen, depth / through[index]))
            if ratio is not None and ratio != before[index]:
                load.append((excess, ratio))
            before[index] = ratio
    return Cues(np.array(load).reshape(-1, 2), np.array(completion).reshape(-1, 2), np.array(share).reshape(-1, 2))


def _file(run: Run) -> Path | None:
    """The specimen file of a trial, if it had one."""
    file = run.header.get("specimen")
    return None if file is None else Path(file)


def table(name: str, by: str, pairs: Floats, edges: Sequence[float], unit: float) -> list[str]:
    """Lines of median, spread and tails of the second column, by the first one in ``unit``."""
    lines = [f"{name} by {by}", f"  {by:>16}      n  median     sd     5 %    95 %"]
    for low, high in pairwise(edges):
        values = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high), 1]
        if len(values):
            few, many = np.percentile(values, [5, 95])
            lines.append(
                f"  {low / unit:6.1f} to {high / unit:6.1f} {len(values):6d}  {np.median(values):6.3f}  "
                f"{values.std():5.3f}  {few:6.3f}  {many:6.3f}"
            )
    return lines


def main(words: Sequence[str] | None = None) -> None:
    """Read a folder of virtual runs and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what `mill experiment milling --out` or studies.virtual_runs wrote")
    given = parser.parse_args(words)
    cues = [cues_of(read_run(folder)) for folder in sorted(given.folder.glob("*-*")) if folder.is_dir()]
    if not any(len(cue.completion) for cue in cues):
        raise SystemExit(f"{given.folder}: no record with laps; make some with `mill experiment milling --out`")
    for name, by, pairs, edges, unit in (
        ("load ratio", "excess, um", [cue.load for cue in cues], EDGES_MM, 1e-3),
        ("completion", "excess, um", [cue.completion for cue in cues], EDGES_MM, 1e-3),
        ("share cut", "completion, %", [cue.share for cue in cues], READ, 0.01),
    ):
        print("\n".join(table(name, by, np.concatenate(pairs), edges, unit)))


if __name__ == "__main__":
    main()
