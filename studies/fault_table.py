"""Every fault in every phase of a run, from one state: what happens, how soon it is declared, what is harmed.

    python -m studies.fault_table --seeds 0-2 --out DIR --json FILE

One run per mouse, with full pixels and the shipped networks. In each phase it is branched once for each fault of
``firmware_sim.faults``, which begins at that moment; the branch goes on to its end. Branches that are there already are
not grown again.
"""

import argparse
import json
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from firmware_sim.bench import Bench
from firmware_sim.clock import SimClock
from firmware_sim.faults import CATALOGUE, Fault, parse_fault
from firmware_sim.faulty_disk import FaultyDisk
from firmware_sim.faulty_reader import FaultyReader
from firmware_sim.microscope import Image
from firmware_sim.specimen import draw_specimen
from milling import loop
from milling.job import Job
from studies.branches import BranchingRecorder, Figures, branch, end, fall, one_thread
from studies.overrun import Overrun
from studies.virtual_runs import calibrated, networks, opened, seeds_of

PHASES: Final = ("contact", "entry", "late", "look")
ENTRY_LAP: Final = 4
LATE_POINTS: Final = 8
LATE_PROBABILITY: Final = 0.1
AT_FIRST: Final = ("spindle.no_consumer", "motion.no_soft_limits", "motion.settings_changed")
"""Faults that are looked for when a device is opened, and change nothing afterwards."""


def faults() -> list[str]:
    """The catalogue, each with its usual value; what is read from a picture low or high, at every reach."""
    named: list[str] = []
    for name, kind in CATALOGUE.items():
        if name not in AT_FIRST:
            named += [f"{name}={reach}" for reach in ("one", "arc", "all")] if kind.reach else [name]
    return named


@dataclass
class Phases:
    """Tells from a run's events which phase begins."""

    n_points: int
    seen: set[str] = field(default_factory=set)
    touched: int = 0

    def of(self, kind: str, fields: Mapping[str, Any]) -> str | None:
        """The phase that this event begins, if any."""
        phase = None
        self.touched += kind == "contact"
        if kind == "contact" and self.touched == self.n_points // 2:
            phase = "contact"
        elif kind == "lap":
            nearly = sum(probability < LATE_PROBABILITY for probability in fields["left_probability"])
            phase = "late" if nearly >= LATE_POINTS else "entry" if fields["lap"] >= ENTRY_LAP else None
        elif kind == "stage" and fields["stage"] == "look":
            phase = "look"
        if phase is None or phase in self.seen:
            return None
        self.seen.add(phase)
        return phase


class Witness:
    """What happens in a branch: when it was latched, where the tip went then, and how deep it ever was."""

    def __init__(self, bench: Bench, clock: SimClock, overrun: Overrun, command_overrun: Overrun) -> None:
        self._bench, self._clock = bench, clock
        self.overrun, self.command_overrun = overrun, command_overrun
        self.began_s = clock.now_s()
        self.latched_s: float | None = None
        self.reaction = ""
        self.safe_s: float | None = None
        """When the end state was declared: lifted and the spindle off, or both stopped where they stood."""
        self._latched_tip = np.zeros(3)
        self.lower_mm = 0.0
        """How far the tip went down after the latch."""
        self.beside_mm = 0.0
        """How far to the side after the latch, braking included, until the tip was 0.1 mm up."""
        clock.attach(self._tick)

    def event(self, kind: str, fields: Mapping[str, Any]) -> None:
        """What of an event says that it is over."""
        now_s = self._clock.now_s()
        if kind == "latched" and self.latched_s is None:
            self.latched_s, self.reaction = now_s, str(fields["reaction"])
            self._latched_tip = self._bench.machine.tip_mm.copy()
        elif kind == "outcome" and self.safe_s is None:
            self.safe_s = now_s

    def _tick(self, _time_s: float) -> None:
        machine = self._bench.machine
        self.overrun.at(machine.tip_mm)
        self.command_overrun.at(machine.command_mm)
        if self.latched_s is not None:
            moved = machine.tip_mm - self._latched_tip
            self.lower_mm = max(self.lower_mm, float(-moved[2]))
            if moved[2] < 0.1:
                self.beside_mm = max(self.beside_mm, float(np.hypot(moved[0], moved[1])))

    def figures(self, result: loop.RunResult) -> Figures:
        """Of the branch, ended."""
        self._clock.sleep_s(1.0)
        truth = self._bench.machine.truth()
        return {
            "outcome": result.outcome,
            "reason": result.reason,
            "reaction": self.reaction,
            "latched_after_s": None if self.latched_s is None else self.latched_s - self.began_s,
            "safe_after_s": None if self.latched_s is None or self.safe_s is None else self.safe_s - self.latched_s,
            "lower_after_latch_mm": self.lower_mm,
            "beside_after_latch_mm": self.beside_mm,
            "membrane_touched": truth.membrane_touched,
            "flap_free": truth.flap_free,
            "overrun_mm": self.overrun.greatest_mm,
            "command_overrun_mm": self.command_overrun.greatest_mm,
            "spindle_rpm": float(self._bench.machine.spindle_rpm),
        }


class _Trunk:
    """Where the loop of a mouse records: behind a disk that may fail, and watched for the phases to branch in."""

    def __init__(self, seed: int, out: Path, wanted: Sequence[str]) -> None:
        self.job, self.bench, self.clock = Job(), Bench(draw_specimen(seed)), SimClock()
        self.grown = 0
        self.witness: Witness | None = None
        """In a branch."""
        self.file = out
        self.what: Figures = {}
        self._seed, self._out, self._wanted = seed, out, wanted
        self._planted: list[Fault] = []
        self._phases = Phases(self.job.n_points)
        self._overruns = Overrun(), Overrun()
        shutil.rmtree(out / f"trunk-{seed}", ignore_errors=True)
        self.recorder = BranchingRecorder(out / f"trunk-{seed}", {"seed": seed, "clock": "virtual"}, self.clock)
        self._disk = FaultyDisk(self.recorder, (), self.clock)

    def eyes(self) -> loop.Finders:
        """The shipped networks, completion behind the faults that a branch plants."""
        found = networks(self.clock)
        reader = FaultyReader(found.completion, self._planted, self.clock, seed=self._seed)
        return loop.Finders(found.find_tip, found.find_landmarks, reader, found.match)

    def event(self, kind: str, **fields: Any) -> None:
        """Record it; in the trunk, branch where it begins a phase."""
        for overrun in self._overruns:
            overrun.event(kind, fields)
        if self.witness is not None:
            self.witness.event(kind, fields)
        self._disk.event(kind, **fields)
        phase = None if self.witness is not None else self._phases.of(kind, fields)
        for name in self._wanted if phase else ():
            self.file = self._out / f"mouse-{self._seed}-{phase}-{name.replace('=', '-')}.json"
            self.what = {"seed": self._seed, "phase": phase, "fault": name}
            if not self.file.exists():
                self.grown += 1
                if branch(self.file, partial(self._plant, parse_fault(name))):
                    return

    def frame(self, name: str, image: Image) -> None:
        """Record it."""
        self._disk.frame(name, image)

    def _plant(self, fault: Fault) -> None:
        self.recorder.branch_to(self.file.with_suffix(""))
        if fault.kind.place == "bench":
            self.bench.plant([fault])
        self._planted.append(fault)
        self._disk = FaultyDisk(self.recorder, [fault], self.clock)
        self.witness = Witness(self.bench, self.clock, *self._overruns)


def grow_mouse(seed: int, out: Path, wanted: Sequence[str]) -> int:
    """Run one mouse, and all of its branches that are missing; how many were grown."""
    one_thread()
    trunk = _Trunk(seed, out, wanted)
    try:
        # What is broken may not be closed in peace: a branch ends within.
        with trunk.recorder, opened(trunk.bench, trunk.clock) as rig:
            eyes = trunk.eyes()
            result = loop.run(rig, calibrated(rig, eyes), eyes, trunk.job, trunk)
            if trunk.witness is not None:
                end(trunk.file, {**trunk.what, **trunk.witness.figures(result)})
    except BaseException:
        if trunk.witness is not None:
            fall(trunk.file)
        raise
    return trunk.grown


def summary(branches: Sequence[Figures]) -> list[Figures]:
    """By fault: how its branches ended, how soon, and what was harmed."""
    rows: list[Figures] = []
    for fault in dict.fromkeys(row["fault"] for row in branches):
        mine = [row for row in branches if row["fault"] == fault]
        latched = [row["latched_after_s"] for row in mine if row["latched_after_s"] is not None]
        safe = [row["safe_after_s"] for row in mine if row["safe_after_s"] is not None]
        outcomes = [row["outcome"] for row in mine]
        rows.append(
            {
                "fault": fault,
                "branches": len(mine),
                **{outcome: outcomes.count(outcome) for outcome in ("complete", "held", "aborted")},
                "membranes_touched": sum(row["membrane_touched"] for row in mine),
                "false_completes": sum(row["outcome"] == "complete" and not row["flap_free"] for row in mine),
                "latched_after_s": [min(latched), max(latched)] if latched else None,
                "safe_after_latch_s": max(safe) if safe else None,
                "lower_after_latch_um": 1e3 * max(row["lower_after_latch_mm"] for row in mine),
                "overrun_um": 1e3 * max(row["overrun_mm"] for row in mine),
                "command_overrun_um": 1e3 * max(row["command_overrun_mm"] for row in mine),
            }
        )
    return rows


def main(words: Sequence[str] | None = None) -> None:
    """Grow what is missing; print a line for each fault, and write all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, required=True, help="such as 0-2")
    parser.add_argument("--fault", action="append", help="only this one; may be given more than once")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args(words)
    given.out.mkdir(parents=True, exist_ok=True)
    wanted = given.fault or faults()
    with ProcessPoolExecutor(given.workers, max_tasks_per_child=1) as pool:
        for running in as_completed([pool.submit(grow_mouse, seed, given.out, wanted) for seed in given.seeds]):
            print(f"{running.result()} branches grown", flush=True)
    files = sorted(given.out.glob("mouse-*.json"))
    branches = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    chosen = [row for row in branches if row["fault"] in wanted and row["seed"] in given.seeds]
    rows, phases = summary(chosen), dict(Counter(row["phase"] for row in chosen))
    for row in rows:
        print({key: value for key, value in row.items() if value})
    for file in sorted(given.out.glob("*.error")):
        print(f"{file}: {file.read_text().splitlines()[-1]}")
    if given.json:
        given.json.write_text(
            json.dumps({"command": "fault table", "seeds": given.seeds, "phases": phases, "rows": rows}),
            encoding="utf-8",
        )


if __name__ == "__main__":
    main()
