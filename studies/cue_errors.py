"""What load and pictures said, against how deep the ball was in truth: the error model of ``milling.thickness``.

    python -m studies.virtual_runs --seeds 100-109 --out DIR
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

Floats = npt.NDArray[np.float64]

EDGES_MM = (-0.3, -0.15, -0.1, -0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.065, 0.1)


@dataclass(frozen=True, eq=False)
class Cues:
    """Excess in mm against load ratio, and against completion."""

    load: Floats
    """(n, 2)"""
    completion: Floats
    """(m, 2)"""


def cues_of(run: Run) -> Cues:
    """What one run's record holds; nothing for a run that ended before all contacts were found."""
    specimen = draw_specimen(int(run.header["seed"]))
    contact_mm = np.array([event["z_mm"] for event in run.of_kind("contact")])
    ball_mm = np.array([event["ball_mm"] for event in run.of_kind("trajectory")]).reshape(-1, 3)
    if len(contact_mm) == 0 or len(contact_mm) < len(ball_mm):
        return Cues(np.empty((0, 2)), np.empty((0, 2)))
    offset_z_mm = specimen.tool.ball_radius_mm * specimen.tool.axis[2]
    through = contact_mm + offset_z_mm - through_z_mm(specimen, Skull(specimen), ball_mm[:, :2])
    load: list[tuple[float, float]] = []
    completion: list[tuple[float, float]] = []
    before: list[float | None] = [None] * len(through)
    for lap in run.of_kind("lap"):
        for index, (depth, ratio, seen) in enumerate(
            zip(lap["depth_mm"], lap["load_ratio"], lap["completion"], strict=True)
        ):
            if depth <= 0:
                continue
            excess = depth - through[index]
            completion.append((excess, seen))
            if ratio is not None and ratio != before[index]:
                load.append((excess, ratio))
            before[index] = ratio
    return Cues(np.array(load).reshape(-1, 2), np.array(completion).reshape(-1, 2))


def table(name: str, pairs: Floats) -> list[str]:
    """Lines of median, spread and tails by excess."""
    lines = [f"{name} by excess", "  excess, um      n  median     sd     5 %    95 %"]
    for low, high in pairwise(EDGES_MM):
        values = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high), 1]
        if len(values):
            few, many = np.percentile(values, [5, 95])
            lines.append(
                f"  {1e3 * low:4.0f} to {1e3 * high:4.0f} {len(values):6d}  {np.median(values):6.3f}  "
                f"{values.std():5.3f}  {few:6.3f}  {many:6.3f}"
            )
    return lines


def main(words: Sequence[str] | None = None) -> None:
    """Read a folder of virtual runs and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what studies.virtual_runs wrote")
    given = parser.parse_args(words)
    cues = [cues_of(read_run(folder)) for folder in sorted(given.folder.glob("run-*")) if folder.is_dir()]
    if not any(len(cue.completion) for cue in cues):
        raise SystemExit(f"{given.folder}: no run-N folder with laps; make some with studies.virtual_runs")
    print("\n".join(table("load ratio", np.concatenate([cue.load for cue in cues]))))
    print("\n".join(table("completion", np.concatenate([cue.completion for cue in cues]))))


if __name__ == "__main__":
    main()
