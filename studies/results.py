"""Write docs/results.md from what was measured: the weights' held-out figures and the JSON of whole runs.

    python -m studies.results --out docs/results.md run-0.json run-1.json ...

where each JSON comes from ``mill run --emulate --seed N --json run-N.json``, from ``python -m studies.virtual_runs``,
from ``mill experiment``, from ``python -m benchmarks.stop_latency``, or from ``studies.fault_table``, ``killed_runs``,
``killed_processes`` and ``doctor_trials``. A section of which no JSON is given stays as it is in the file: some take
hours.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from studies.safety_results import SECTIONS
from studies.tables import tables
from studies.trials import wilson
from vision.runtime import WEIGHTS, read_manifest

_HEAD = """# Results

Measured on the virtual bench. This is simulation: none of it says anything about tissue.

The figures of `milling/limits.py` and `milling/thickness.py` were chosen on seeds 6, 10, 16 to 57 and 100 to 119, and
on mice 0 to 23, 3000 to 3011, 4100 to 4123 and 6000 to 6059 of the milling experiment: only others are a fair test.

Windows of seeds 600 and 4200 on were milled with a load sigma of 0.1; it is 0.11 now (docs/decisions/0070)."""
_REAL_TIME = [
    "## Whole runs in real time",
    "",
    "`mill run --emulate --seed N --json run-N.json`, default job, one run after the other on two cores.",
    "",
]
_VIRTUAL = [
    "## Whole runs on the virtual clock",
    "",
    "`python -m studies.virtual_runs --seeds 0-9 --out DIR`, default job: the same drivers, networks and loop over",
    "in-process wires.",
    "",
]


def page(manifest: dict[str, dict[str, Any]], results: Sequence[dict[str, Any]], before: str = "") -> str:
    """The page, as Markdown; ``before`` is the page as it was."""
    made = [_networks(manifest)]
    for result in results:
        if result["command"].startswith("experiment"):
            made.append(_experiment(result))
        elif result["command"] == "stop latency":
            made.append(_latency(result))
        elif result["command"] in SECTIONS:
            made.append(SECTIONS[result["command"]](result))
    for command, heading in (("run", _REAL_TIME), ("virtual run", _VIRTUAL)):
        if runs := [result for result in results if result["command"] == command]:
            made.append([*heading, *_table(runs), ""])
    sections = _sections(before) | {lines[0]: "\n".join(lines[1:]).strip("\n") for lines in made}
    return "\n\n".join([_HEAD, *(f"{title}\n\n{text}" for title, text in sections.items())]) + "\n"


def _sections(text: str) -> dict[str, str]:
    """What stands under each heading, in order."""
    sections: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in text.splitlines():
        if line.startswith("## "):
            lines = sections.setdefault(line, [])
        else:
            lines.append(line)
    return {title: "\n".join(lines).strip("\n") for title, lines in sections.items()}


def _networks(manifest: dict[str, dict[str, Any]]) -> list[str]:
    """Held-out figures of the weights."""
    lines = [
        "## Networks, on specimens and rigs that training never saw",
        "",
        "Made by `make weights`, which runs `mill train tip|landmarks|completion`, measured by `mill evaluate`;",
        "the figures are those in `vision/weights/manifest.json`.",
        "",
    ]
    for name, entry in manifest.items():
        lines += [f"### {name}", "", "| figure | value |", "|---|---|"]
        lines += [f"| {figure} | {value:.4g} |" for figure, value in entry["held_out"].items()]
        lines.append("")
    return lines


def _experiment(result: dict[str, Any]) -> list[str]:
    """Recipes side by side, and shifts; RMSE and shares with their 95 % interval over specimens."""
    recipes = {name: result[name] for name in result["recipes"]}
    count = len({trial["seed"] for trial in result["trials"]})
    what = result["command"].removeprefix("experiment ")
    option = {"calibration": "rigs", "milling": "trials"}.get(what, "specimens-count")
    others = " --paper-weights FILE" if what == "completion" and "paper" in recipes else ""
    others += "".join(f" --policy {policy}" for policy in recipes) if what == "milling" else ""
    asked = "".join(f" {words}" for words in result.get("asked", ()))
    others += asked
    title = f"## Experiment: {what}" + (f", {', '.join(recipes)}{asked}" if what == "milling" else "")
    lines = [
        title,
        "",
        f"`mill {result['command']} --{option} {count} --seed {result['seed']}{others} --out DIR --json FILE`;",
        "every recipe on the same virtual specimens and rigs, which no network has seen; figures of all trials that",
        "could be measured, with their 95 % interval over specimens. The last column is no simulation.",
        "",
    ]
    if what == "milling":
        lines += [
            "Success is the paper's criterion: the flap can be lifted, and the membrane was never touched; a run that",
            "holds is a failure. Times are of the windows that succeeded. Full pixels unless `--statistical` is said.",
            "",
        ]
    if what == "completion":
        lines += [
            "Ours runs in ONNX Runtime, fp32; the network of the paper's kind (ResNet-101, boxes and heat map of the",
            "whole picture) in torch as it comes, fp32, in the same run; each on one thread.",
            "",
        ]
    for table in tables(what, recipes, result["published"]):
        lines += [f"**{table.title}**", "", f"| {' | '.join(table.headings)} |", "|---" * len(table.headings) + "|"]
        lines += [*(f"| {' | '.join(row)} |" for row in table.rows), ""]
    return lines


def _latency(figures: dict[str, Any]) -> list[str]:
    """From an alarm to the stop on the wire, beside a thread that shares its interpreter."""
    alarms, hogs = int(figures["alarms"]), int(figures["hogs"])
    lines = [
        "## From an alarm to the stop bytes on the wire",
        "",
        f"`python -m benchmarks.stop_latency --alarms {alarms} --hogs {hogs} --json FILE`; {hogs} busy processes; ms.",
        "",
        "| | median | 99 % | worst |",
        "|---|---|---|---|",
    ]
    for name, words in (
        ("supervisor", "supervisor process, from a drive's EMCY frame on the wire"),
        ("told", "supervisor process, told by its pipe"),
        ("shared_interpreter", "thread beside a busy one, told by a pipe"),
    ):
        values = (f"{figures[f'{name}_{label}_ms']:.1f}" for label in ("p50", "p99", "max"))
        lines.append(f"| {words} | {' | '.join(values)} |")
    return [*lines, ""]


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
    before = given.out.read_text(encoding="utf-8") if given.out.is_file() else ""
    given.out.write_text(page(read_manifest(WEIGHTS), results, before), encoding="utf-8")


if __name__ == "__main__":
    main()
