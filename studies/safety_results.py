"""The sections of docs/results.md about faults, kills and the doctor."""

from collections.abc import Callable, Mapping
from typing import Any

Figures = Mapping[str, Any]


def fault_table(result: Figures) -> list[str]:
    """Of ``python -m studies.fault_table``."""
    rows = result["rows"]
    seeds = ",".join(map(str, result["seeds"]))
    phases = ", ".join(f"{name} {count}" for name, count in result["phases"].items())
    branches, touched = (sum(row[key] for row in rows) for key in ("branches", "membranes_touched"))
    lines = [
        "## Every fault in four phases of a run",
        "",
        f"`python -m studies.fault_table --seeds {seeds} --out DIR --json FILE`: each fault begins amidst the contacts",
        "in one branch, in others in the first laps, where points are nearly through, and at the look; full pixels.",
        f"Branches by phase: {phases}.",
        f"Membranes touched: {touched} in {branches} branches. Lower after latch is how far the tip went down once the",
        "failure was latched; overrun is depth below what was ever permitted there: of the axes as commanded, and of",
        "the tip with run-out and play.",
        "",
        "| fault | branches | complete | held | aborted | false completes | latched after, s | safe after latch, s "
        "| lower after latch, um | overrun, commanded, um | overrun, tip, um |",
        "|---" * 11 + "|",
    ]
    for row in rows:
        latched = row["latched_after_s"]
        cells = (
            row["fault"],
            *(str(row[key]) for key in ("branches", "complete", "held", "aborted", "false_completes")),
            "-" if latched is None else f"{latched[0]:.2f} to {latched[1]:.2f}",
            "-" if row["safe_after_latch_s"] is None else f"{row['safe_after_latch_s']:.2f}",
            *(f"{row[key]:.0f}" for key in ("lower_after_latch_um", "command_overrun_um", "overrun_um")),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def killed_runs(result: Figures) -> list[str]:
    """Of ``python -m studies.killed_runs``."""
    seeds = ",".join(map(str, result["seeds"]))
    low, high = (100 * result[f"complete_and_free_of_resumed_{end}"] for end in ("low", "high"))
    whole = result["complete_and_free_of_resumed"]
    return [
        "## Program and supervisor killed together, and the window resumed",
        "",
        f"`python -m studies.killed_runs --seeds {seeds} --kills {result['asked_kills']} --out DIR --json FILE`:",
        f"virtual clock, {result['kills']} random instants, half of the records torn in their last line.",
        "",
        "| figure | worst or share |",
        "|---|---|",
        f"| the tip stands after | {1e3 * result['standstill_s_worst']:.0f} ms |",
        f"| the tip goes lower meanwhile by | {result['lower_um_worst']:.0f} um |",
        f"| below what was permitted, commanded path between points included | {result['overrun_um_worst']:.0f} um |",
        f"| the drive is off after | {1e3 * result['spindle_off_s_worst']:.0f} ms |",
        f"| the drill stands after | {1e3 * result['spindle_stands_s_worst']:.0f} ms |",
        f"| events lost | {result['events_lost_most']} |",
        f"| resumed / refused with the reason | {result['resumed']} / {result['refused']} |",
        f"| of the resumed: complete with a free flap | {100 * whole:.0f} % ({low:.0f}-{high:.0f} %) |",
        f"| membranes touched | {result['membranes_touched']} |",
        "",
        "What ended otherwise said: " + ("; ".join(sorted(set(result["ended_otherwise"]))) or "nothing") + ".",
        "",
    ]


def killed_processes(result: Figures) -> list[str]:
    """Of ``python -m studies.killed_processes``."""
    lines = [
        "## One of the processes killed",
        "",
        f"`python -m studies.killed_processes --kills {result['kills']} --json FILE`: real processes, real time.",
        "",
        "| killed | kills | tip stands, worst, ms | goes lower, um | lifted, least, mm | drive off, worst, ms "
        "| drill stands, worst, ms |",
        "|---" * 7 + "|",
    ]
    for victim in ("program", "supervisor", "both"):
        if victim in result:
            found = result[victim]
            lines.append(
                f"| {victim} | {found['kills']} | {1e3 * found['standstill_s_worst']:.0f} "
                f"| {1e3 * found['lower_mm_worst']:.0f} | {found['lifted_mm_least']:.2f} "
                f"| {1e3 * found['spindle_off_s_worst']:.0f} | {1e3 * found['spindle_stands_s_worst']:.0f} |"
            )
    return [*lines, ""]


def doctor_trials(result: Figures) -> list[str]:
    """Of ``python -m studies.doctor_trials``."""
    well, first = result["well"], result["seeds"]
    lines = [
        "## What `mill doctor` finds",
        "",
        f"`python -m studies.doctor_trials --seeds {first[0]}-{first[-1]} --fault-seeds ... --out DIR --json FILE`:",
        f"virtual clock. Rigs that are well, each with and without a certificate: {well['examinations']} examinations,",
        f"{well['false_alarms']} false alarms; {well['computer_busy']} times the study's own computer was found busy.",
        "Planted, and found by name:",
        "",
        "| fault | examinations | found |",
        "|---|---|---|",
    ]
    lines += [f"| {fault} | {found['examinations']} | {found['found']} |" for fault, found in result["faults"].items()]
    return [*lines, ""]


SECTIONS: Mapping[str, Callable[[Figures], list[str]]] = {
    "fault table": fault_table,
    "killed runs": killed_runs,
    "killed processes": killed_processes,
    "doctor trials": doctor_trials,
}
"""By the command that their JSON names."""
