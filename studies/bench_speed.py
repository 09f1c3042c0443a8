"""How fast the virtual bench is: seconds of its clock for one second of a core, stage by stage.

A mouse is calibrated and milled as `mill experiment milling` does it, with pictures of numbers (``statistical``) and
with full pixels and the shipped networks (``full``). The reference of the ratio is a yardstick measured in the same
run: a million turns of an empty Python loop. Processor time is told, for other programs take theirs; the first mouse of
each kind also loads libraries, or compiles, and is not told.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Literal

from firmware_sim.bench import Bench
from firmware_sim.clock import SimClock
from milling import loop
from milling.job import Job
from milling.record import RunRecorder
from studies.perception import donors
from studies.statistical import NumberEyes
from studies.trials import World
from studies.virtual_runs import calibrated, networks, opened

Kind = Literal["statistical", "full"]
KINDS: tuple[Kind, ...] = ("statistical", "full")
TURNS = 1_000_000
WARM_S = 60.0
"""By then a mouse is being milled."""


def measure(kind: Kind, *, seed: int = 0, until_s: float = float("inf")) -> dict[str, float]:
    """Virtual and processor seconds of calibration and run of one mouse, which a person stops at ``until_s``."""
    bench, clock = Bench(World(seed).specimen()), SimClock()
    eyes = NumberEyes(bench, donors(), seed=seed) if kind == "statistical" else None
    found = networks(clock) if eyes is None else loop.Finders(eyes.find_tip, eyes.find_landmarks, eyes, eyes.match)
    figures: dict[str, float] = {}
    with (
        TemporaryDirectory() as scratch,
        RunRecorder(Path(scratch) / "run", {}, clock, frame_period_s=1e9) as record,
        opened(bench, clock, render=None if eyes is None else eyes.render) as rig,
    ):
        cpu_s, virtual_s = process_time(), clock.now_s()
        calibration = calibrated(rig, found)
        figures |= _stage("calibration", clock.now_s() - virtual_s, process_time() - cpu_s)
        cpu_s, virtual_s = process_time(), clock.now_s()
        loop.run(rig, calibration, found, Job(), record, stop_requested=lambda: clock.now_s() >= until_s)
        figures |= _stage("run", clock.now_s() - virtual_s, process_time() - cpu_s)
    return figures


def yardstick_s() -> float:
    """Processor seconds of the reference, the best of five."""
    times = []
    for _ in range(5):
        began_s = process_time()
        for _ in range(TURNS):
            pass
        times.append(process_time() - began_s)
    return min(times)


def compare(kinds: tuple[Kind, ...], *, seed: int = 0, until_s: float = float("inf")) -> dict[str, dict[str, float]]:
    """The figures of each kind, and in yardsticks what a virtual second of its run takes."""
    result: dict[str, dict[str, float]] = {}
    for kind in kinds:
        measure(kind, seed=seed, until_s=min(until_s, WARM_S))
        figures, stick_s = measure(kind, seed=seed, until_s=until_s), yardstick_s()
        per_second = figures["run_cpu_s"] / figures["run_virtual_s"]
        result[kind] = figures | {"yardstick_ms": 1000.0 * stick_s, "yardsticks_per_virtual_s": per_second / stick_s}
    return result


def _stage(name: str, virtual_s: float, cpu_s: float) -> dict[str, float]:
    return {
        f"{name}_virtual_s": virtual_s,
        f"{name}_cpu_s": cpu_s,
        f"{name}_virtual_s_per_cpu_s": virtual_s / max(cpu_s, 1e-9),
    }


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=KINDS, action="append", help="default: both")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--until", type=float, default=float("inf"), metavar="S", help="end the runs at S virtual s")
    given = parser.parse_args()
    print(json.dumps(compare(tuple(given.kind or KINDS), seed=given.seed, until_s=given.until), indent=1))


if __name__ == "__main__":
    main()
