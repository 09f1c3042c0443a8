"""Write docs/results.md from what was measured: the weights' held-out figures and the JSON of whole runs.

    python -m studies.results --out docs/results.md run-0.json run-1.json ...

where each JSON comes from ``mill run --emulate --seed N --json run-N.json`` or from ``python -m studies.virtual_runs``.
"""

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vision.runtime import WEIGHTS, read_manifest

Z_95 = 1.959964
CHOSEN_ON = "6, 10, 16 to 57 and 100 to 119"


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (Wilson 1927)."""
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    center = share + Z_95**2 / (2 * trials)
    half = Z_95 * math.sqrt(share * (1 - share) / trials + Z_95**2 / (4 * trials**2))
    scale = 1 + Z_95**2 / trials
    return max(0.0, (center - half) / scale), min(1.0, (center + half) / scale)


def page(manifest: dict[str, dict[str, Any]], runs: Sequence[dict[str, Any]]) -> str:
    """The page, as Markdown."""
    lines = [
        "# Results",
        "",
        "Measured on the virtual bench. This is simulation: none of it says anything about tissue.",
        "",
        "## Networks, on specimens and rigs that training never saw",
        "",
        "Made by `mill train tip|landmarks|completion --out vision/weights/NAME.onnx`, measured by `mill evaluate`;",
        "the figures are those in `vision/weights/manifest.json`.",
        "",
    ]
    for name, entry in manifest.items():
        lines += [f"### {name}", "", "| figure | value |", "|---|---|"]
        lines += [f"| {figure} | {value:.4g} |" for figure, value in entry["held_out"].items()]
        lines.append("")
    lines += [
        f"The figures of `milling/limits.py` and `milling/thickness.py` were chosen on seeds {CHOSEN_ON}:",
        "only others are a fair test.",
        "",
    ]
    in_real_time = [run for run in runs if run["command"] == "run"]
    virtual = [run for run in runs if run["command"] != "run"]
    lines += ["## Whole runs in real time", ""]
    lines += ["`mill run --emulate --seed N --json run-N.json`, default job, one run after the other on two cores.", ""]
    lines += [*_table(in_real_time), "", "## Whole runs on the virtual clock", ""]
    how = "the same drivers, networks and loop over in-process wires"
    lines += [f"`python -m studies.virtual_runs --seeds 0-9 --out DIR`, default job: {how}.", ""]
    lines += _table(virtual)
    return "\n".join(lines) + "\n"


def _table(runs: Sequence[dict[str, Any]]) -> list[str]:
    if not runs:
        return ["None were given."]
    successes = sum(bool(run["truth"]["success"]) and run["outcome"] == "complete" for run in runs)
    low, high = wilson(successes, len(runs))
    touched = sum(bool(run["truth"]["membrane_touched"]) for run in runs)
    lines = [
        f"Complete with a free flap and an untouched membrane: {successes} of {len(runs)} "
        f"(95 % Wilson interval {100 * low:.0f}-{100 * high:.0f} %). Membranes touched: {touched}.",
        "",
        "| seed | outcome | flap free | membrane touched | milling time, s | heat rise, K |",
        "|---|---|---|---|---|---|",
    ]
    for run in sorted(runs, key=lambda run: int(run["seed"])):
        truth = run["truth"]
        free, harm = ("yes" if truth[key] else "no" for key in ("flap_free", "membrane_touched"))
        lines.append(
            f"| {run['seed']} | {run['outcome']} | {free} | {harm} | {run['milling_time_s']:.0f} "
            f"| {truth['heat_rise_c']:.1f} |"
        )
    return lines


def main() -> None:
    """Read the files named on the command line and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("runs", type=Path, nargs="*")
    given = parser.parse_args()
    runs = [json.loads(path.read_text(encoding="utf-8")) for path in given.runs]
    given.out.write_text(page(read_manifest(WEIGHTS), runs), encoding="utf-8")


if __name__ == "__main__":
    main()
