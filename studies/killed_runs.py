"""The program that mills and its supervisor are killed together, at any instant: what stands when, and what goes on.

    python -m studies.killed_runs --seeds 0-2 --kills 20 --out DIR --json FILE

One run per mouse, with full pixels and the shipped networks, branched at ``--kills`` instants between the first contact
and its end. In a branch nothing of the host moves any more: the motion board runs out of what is queued, the drive
misses the host. Every other record is torn in its last line, as a kill within a write leaves it. Then a second run
resumes the window from the record, or says why not. With ``--statistical``, pictures of numbers in place of light, no
skull is recognized, and whether the window could be resumed is all that is told of it. A kill that leaves one of the
two alive takes real processes: ``tests/cli/test_real_processes.py`` and ``studies.killed_processes.py``.
"""

import argparse
import json
import shutil
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from calib.calibration_file import Calibration
from drivers.errors import ConfigError
from firmware_sim.bench import Bench
from firmware_sim.cia402_drive import State
from firmware_sim.clock import SimClock
from firmware_sim.microscope import Image
from firmware_sim.specimen import draw_specimen
from milling import loop
from milling.job import Job
from milling.record import RunRecorder, read_run
from milling.standing import Standing, standing_of
from studies.branches import BranchingRecorder, Figures, branch, one_thread
from studies.overrun import Overrun
from studies.perception import donors
from studies.statistical import NumberEyes
from studies.trials import share_of
from studies.virtual_runs import calibrated, networks, opened, seeds_of

WITHIN_S: Final = 125.0
"""Kills fall evenly into so much time from the first contact on; a run that ends sooner has fewer."""
WATCHED_S: Final = 2.0
MOVES_MM: Final = 0.001
"""Within one millisecond."""
STANDS_RPM: Final = 100.0


@dataclass
class _Trunk:
    """The run that is killed again and again."""

    seed: int
    out: Path
    kills: int
    statistical: bool = False
    job: Job = field(default_factory=Job)
    clock: SimClock = field(default_factory=SimClock)
    grown: int = 0
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        self.bench = Bench(draw_specimen(self.seed))
        self.numbers = NumberEyes(self.bench, donors(), seed=self.seed) if self.statistical else None
        self.eyes = networks(self.clock) if self.numbers is None else self.numbers.finders()
        shutil.rmtree(self.out / f"trunk-{self.seed}", ignore_errors=True)
        header = {"seed": self.seed, "clock": "virtual"}
        self.recorder = BranchingRecorder(self.out / f"trunk-{self.seed}", header, self.clock)
        self.overrun = Overrun()
        self.rng = np.random.default_rng([self.seed, 9])
        self.after_s = sorted(self.rng.uniform(0.0, WITHIN_S, self.kills).tolist())
        self._bone_at_s: float | None = None
        self._stage = ""
        self._next = 0

    def event(self, kind: str, **fields: Any) -> None:
        """Record it."""
        self.recorder.event(kind, **fields)
        self.overrun.event(kind, fields)
        if kind == "stage":
            self._stage = fields["stage"]
        if kind == "contact" and self._bone_at_s is None:
            self._bone_at_s = self.clock.now_s()
        elif kind == "outcome":
            self._next = self.kills

    def frame(self, name: str, image: Image) -> None:
        """Record it."""
        self.recorder.frame(name, image)

    def tick(self, time_s: float) -> None:
        """Kill a copy of everything, where one is due."""
        while self._bone_at_s is not None and self._next < self.kills:
            number, after_s = self._next, self.after_s[self._next]
            if time_s - self._bone_at_s < after_s:
                return
            self._next += 1
            file = self.out / f"kill-{self.seed}-{number}.json"
            if not file.exists():
                self.grown += 1
                branch(file, partial(self._killed, number, after_s))

    def _killed(self, number: int, after_s: float) -> Figures:
        folder = self.out / f"kill-{self.seed}-{number}"
        self.recorder.branch_to(folder)
        torn = number % 2 == 1
        if torn:
            _tear(folder / "events.jsonl", float(np.random.default_rng([self.seed, number]).random()))
        found = {
            "seed": self.seed,
            "after_s": after_s,
            "stage": self._stage,
            "torn": torn,
            **_alone(self.bench, self.overrun),
        }
        run = read_run(folder)
        found["events_lost"] = self.recorder.told - len(run.events)
        try:
            standing = standing_of(run, self.job)
        except ConfigError as error:
            found |= {"resumed": False, "outcome": "refused", "reason": str(error).removeprefix(f"{folder}: ")}
        else:
            found |= self._gone_on(standing, folder.with_name(f"{folder.name}-resumed"))
        truth = self.bench.machine.truth()
        return {**found, "membrane_touched": truth.membrane_touched, "flap_free": truth.flap_free}

    def _gone_on(self, standing: Standing, folder: Path) -> Figures:
        """How the window ends that goes on."""
        if self.statistical:
            return {"resumed": False, "outcome": "resumable", "reason": ""}
        clock = SimClock(self.bench.now_s)
        shutil.rmtree(folder, ignore_errors=True)
        assert self.calibration is not None
        with RunRecorder(folder, {}, clock, frame_period_s=1e9) as recorder, opened(self.bench, clock) as rig:
            result = loop.run(rig, self.calibration, self.eyes, self.job, recorder, standing=standing)
        return {"resumed": True, "outcome": result.outcome, "reason": result.reason}


def _alone(bench: Bench, overrun: Overrun) -> Figures:
    """The bench without a host: when the tip stands and the drill is off, how far the tip went, and how deep."""
    killed_s, start = bench.now_s, bench.machine.tip_mm.copy()
    before, moved_s, off_s, stands_s, lower_mm = start, 0.0, None, None, 0.0
    for tick in range(1, round(1e3 * WATCHED_S) + 1):
        bench.advance_to(killed_s + 1e-3 * tick)
        tip = bench.machine.tip_mm.copy()
        if float(np.linalg.norm(tip - before)) > MOVES_MM:
            moved_s = 1e-3 * tick
        before, lower_mm = tip, max(lower_mm, float(start[2] - tip[2]))
        overrun.at(tip)
        if off_s is None and bench.drive.state is not State.OPERATION_ENABLED:
            off_s = 1e-3 * tick
        if stands_s is None and abs(bench.machine.spindle_rpm) < STANDS_RPM:
            stands_s = 1e-3 * tick
    return {
        "standstill_s": moved_s,
        "moved_mm": float(np.linalg.norm(before - start)),
        "lower_mm": lower_mm,
        "overrun_mm": overrun.greatest_mm,
        "spindle_off_s": off_s,
        "spindle_stands_s": stands_s,
    }


def _tear(file: Path, share: float) -> None:
    """Leave so much of the last line."""
    data = file.read_bytes()
    start = data.rstrip(b"\n").rfind(b"\n") + 1
    file.write_bytes(data[: start + max(1, int(share * (len(data) - start - 1)))])


def grow_mouse(seed: int, out: Path, kills: int, statistical: bool = False) -> int:
    """Run one mouse, and all of its branches that are missing; how many were grown."""
    one_thread()
    trunk = _Trunk(seed, out, kills, statistical)
    render = None if trunk.numbers is None else trunk.numbers.render
    with trunk.recorder, opened(trunk.bench, trunk.clock, render=render) as rig:
        trunk.clock.attach(trunk.tick)
        trunk.calibration = calibrated(rig, trunk.eyes)
        loop.run(rig, trunk.calibration, trunk.eyes, trunk.job, trunk)
    return trunk.grown


def summary(kills: Sequence[Figures]) -> Figures:
    """Of all kills: the worst times, what the records lost, and how the windows ended that went on."""
    resumed = [kill for kill in kills if kill["resumed"]]
    whole = sum(kill["outcome"] == "complete" and kill["flap_free"] for kill in resumed)
    return {
        "kills": len(kills),
        "standstill_s_worst": max(kill["standstill_s"] for kill in kills),
        "lower_um_worst": 1e3 * max(kill["lower_mm"] for kill in kills),
        "overrun_um_worst": 1e3 * max(kill["overrun_mm"] for kill in kills),
        "spindle_off_s_worst": max(kill["spindle_off_s"] or WATCHED_S for kill in kills),
        "spindle_stands_s_worst": max(kill["spindle_stands_s"] or WATCHED_S for kill in kills),
        "events_lost_most": max(kill["events_lost"] for kill in kills),
        "resumed": len(resumed),
        "resumable": sum(kill["outcome"] == "resumable" for kill in kills),
        "refused": sum(kill["outcome"] == "refused" for kill in kills),
        **share_of("complete_and_free_of_resumed", whole, len(resumed)),
        "ended_otherwise": sorted({kill["reason"] for kill in resumed if kill["outcome"] != "complete"}),
        "membranes_touched": sum(kill["membrane_touched"] for kill in kills),
    }


def main(words: Sequence[str] | None = None) -> None:
    """Grow what is missing, and tell the whole."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, required=True, help="such as 0-2")
    parser.add_argument("--kills", type=int, default=20, help="instants for each mouse")
    parser.add_argument("--statistical", action="store_true", help="pictures of numbers; nothing is resumed")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args(words)
    given.out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(given.workers, max_tasks_per_child=1) as pool:
        for running in as_completed(
            [pool.submit(grow_mouse, seed, given.out, given.kills, given.statistical) for seed in given.seeds]
        ):
            print(f"{running.result()} branches grown", flush=True)
    files = [file for seed in given.seeds for file in sorted(given.out.glob(f"kill-{seed}-*.json"))]
    figures = summary([json.loads(file.read_text(encoding="utf-8")) for file in files])
    for name, value in figures.items():
        print(f"{name}: {value}")
    for file in sorted(given.out.glob("*.error")):
        print(f"{file}: {file.read_text().splitlines()[-1]}")
    if given.json:
        command = {"command": "killed runs", "seeds": given.seeds, "asked_kills": given.kills}
        given.json.write_text(json.dumps({**command, **figures}), encoding="utf-8")


if __name__ == "__main__":
    main()
