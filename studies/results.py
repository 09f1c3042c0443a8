"""Write docs/results.md from what was measured: the weights' held-out figures and the JSON of whole runs.

    python -m studies.results --out docs/results.md run-0.json run-1.json ...

where each JSON comes from ``mill run --emulate --seed N --json run-N.json``, from ``python -m studies.virtual_runs``
or from ``mill experiment``.
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


def page(manifest: dict[str, dict[str, Any]], results: Sequence[dict[str, Any]]) -> str:
    """The page, as Markdown."""
    experiments = [result for result in results if result["command"].startswith("experiment")]
    runs = [result for result in results if result not in experiments]
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
    for experiment in experiments:
        lines += _experiment(experiment)
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


def _experiment(result: dict[str, Any]) -> list[str]:
    """Recipes side by side; RMSE with their 95 % bootstrap interval over trials."""
    recipes: dict[str, dict[str, Any]] = result["recipes"]
    count = next(iter(recipes.values()))["trials"]
    what = result["command"].removeprefix("experiment ")
    option = {"calibration": "rigs", "surface": "specimens"}[what]
    lines = [
        f"## Experiment: {what}",
        "",
        f"`mill {result['command']} --{option} {count} --seed {result['seed']} --out DIR --json FILE`;",
        "every recipe on the same virtual rigs, which no network has seen; RMSE over the trials that succeeded,",
        "with its 95 % interval (bootstrap).",
        "",
        f"| figure | {' | '.join(recipes)} |",
        "|---" * (len(recipes) + 1) + "|",
    ]
    names = dict.fromkeys(name for figures in recipes.values() for name in figures)
    for name in names:
        if not name.endswith(("_low", "_high")):
            lines.append(f"| {name} | {' | '.join(_cell(figures, name) for figures in recipes.values())} |")
    return [*lines, ""]


def _cell(figures: dict[str, Any], name: str) -> str:
    if name not in figures:
        return ""
    value = f"{figures[name]:.4g}"
    return (
        f"{value} ({figures[name + '_low']:.3g}-{figures[name + '_high']:.3g})" if name + "_low" in figures else value
    )


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
    parser.add_argument("results", type=Path, nargs="*")
    given = parser.parse_args()
    results = [json.loads(path.read_text(encoding="utf-8")) for path in given.results]
    given.out.write_text(page(read_manifest(WEIGHTS), results), encoding="utf-8")


if __name__ == "__main__":
    main()
