"""Whole runs on the virtual clock: the real drivers, networks and loop over in-process wires, several seeds at once.

    python -m studies.virtual_runs --seeds 0-9 --out DIR

writes ``DIR/run-N.json``, in the form of ``mill run --json``, and the record of each run beside it. What is there
already is kept, so that a study that was stopped goes on.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

from calib import procedure
from calib.calibration_file import Calibration
from drivers.camera.stereo import StereoPair
from drivers.device import closed_in_the_end
from drivers.motion.bcap.driver import BcapController
from drivers.motion.grbl.driver import GrblController
from drivers.motion.interface import MotionController, Travel
from drivers.motion.tinyg.driver import TinyGController
from drivers.motion.transport import SerialLine
from drivers.spindle.cia402 import Cia402Spindle
from firmware_sim.bench import (
    ORIGIN_MM,
    ROBOT_ORIENTATION_DEG,
    ROBOT_ORIGIN_MM,
    ROBOT_TRAVEL_HIGH_MM,
    ROBOT_TRAVEL_LOW_MM,
    Bench,
    MotionMake,
    open_in_process,
)
from firmware_sim.clock import SimClock
from firmware_sim.faults import Fault
from firmware_sim.faulty_disk import FaultyDisk
from firmware_sim.microscope import Image
from firmware_sim.specimen import draw_specimen
from milling import loop
from milling.job import Job
from milling.record import RunRecorder
from vision.completion import CompletionReader
from vision.disparity import match
from vision.keypoints import LandmarkFinder, TipFinder

FPS = 20.0
PARK_MM = (23.0, -10.0, 12.0)
MAX_FEED_MM_S = 20.0
MAX_SPEED_RPM = 60_000
SIZE_PX = (960, 540)
MAX_SKEW_S = 0.02


@dataclass(frozen=True)
class Ended:
    """A run that is over: what the loop says, and what the bench knows."""

    result: loop.RunResult
    truth: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """As ``mill run --json`` tells it."""
        truth = {key: value for key, value in self.truth.items() if key not in {"ball_px", "ring"}}
        return {**self.result.to_json(), "truth": truth}


def mill(
    bench: Bench,
    recorder: Callable[[SimClock], RunRecorder],
    *,
    job: Job,
    finders: Callable[[SimClock], loop.Finders],
    render: Callable[[float], tuple[Image, Image]] | None = None,
    disk: Sequence[Fault] = (),
) -> Ended:
    """Calibrate and mill what lies on ``bench``, which was just switched on.

    Args:
        bench: with its specimen and its faults.
        recorder: made on the run's clock; closed here.
        job: what to mill.
        finders: made on the run's clock.
        render: stands where the microscope stands.
        disk: faults of the record's disk.
    """
    clock = SimClock()
    eyes = finders(clock)
    with recorder(clock) as record, opened(bench, clock, render=render) as rig:
        calibration = calibrated(rig, eyes)
        result = loop.run(rig, calibration, eyes, job, FaultyDisk(record, disk, clock) if disk else record)
        record.close(result.to_json())
    return Ended(result, bench.truth())


@contextmanager
def opened(
    bench: Bench, clock: SimClock, *, render: Callable[[float], tuple[Image, Image]] | None = None
) -> Iterator[loop.Rig]:
    """Its devices, on in-process wires."""
    line, bus, left, right = open_in_process(bench, clock, fps=FPS, render=render)
    x, y, z = (bench.specimen.tool.ball_radius_mm * along for along in bench.specimen.tool.axis)
    closed = partial(closed_in_the_end, told=lambda _: None)
    with (
        closed(open_motion(bench, line, clock)) as motion,
        closed(Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=MAX_SPEED_RPM)) as spindle,
        closed(StereoPair(left, right, clock, size_px=SIZE_PX, max_skew_s=MAX_SKEW_S)) as camera,
    ):
        yield loop.Rig(motion, spindle, camera, clock, (x, y, z), PARK_MM)


def open_motion(bench: Bench, line: SerialLine, clock: SimClock) -> MotionController:
    """Its motion controller, at the end of an in-process wire."""
    if bench.motion != "bcap":
        make = TinyGController if bench.motion == "tinyg" else GrblController
        return make(
            line,
            clock,
            origin_mm=ORIGIN_MM,
            max_feed_mm_per_s=MAX_FEED_MM_S,
            expected_settings=bench.motion_settings,
            expected_firmware=bench.motion_firmware,
        )
    robot = BcapController(
        line,
        clock,
        origin_mm=ROBOT_ORIGIN_MM,
        orientation_deg=ROBOT_ORIENTATION_DEG,
        travel=Travel(ROBOT_TRAVEL_LOW_MM, ROBOT_TRAVEL_HIGH_MM),
        max_feed_mm_per_s=MAX_FEED_MM_S,
    )
    # Whatever the loop waits for, the robot wants a set-point every 8 ms.
    clock.attach(lambda _time_s: robot.feed())
    return robot


def calibrated(rig: loop.Rig, eyes: loop.Finders) -> Calibration:
    """Home it, and calibrate it as `mill calibrate` does."""
    rig.motion.home()
    return procedure.calibrate(
        rig.motion, rig.camera, eyes.find_tip, clock=rig.clock, tool_offset_mm=rig.center_from_tip_mm
    )


def networks(_clock: SimClock) -> loop.Finders:
    """The shipped ones."""
    return loop.Finders(TipFinder.load().find, LandmarkFinder.load().find, CompletionReader.load(), match)


def mill_one(seed: int, folder: Path, motion: MotionMake = "grbl") -> dict[str, Any]:
    """Calibrate and mill the specimen of ``seed``; figures as ``mill run --json`` gives them, truth included."""

    def recorder(clock: SimClock) -> RunRecorder:
        return RunRecorder(folder / f"run-{seed}", {"seed": seed, "clock": "virtual"}, clock)

    ended = mill(Bench(draw_specimen(seed), motion=motion), recorder, job=Job(), finders=networks)
    return {"schema": 1, "command": "virtual run", "seed": seed, "motion": motion, **ended.to_json()}


def seeds_of(text: str) -> list[int]:
    """``0-3,7`` is 0, 1, 2, 3 and 7."""
    seeds: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        seeds += range(int(first), int(last or first) + 1)
    return seeds


def main(words: Sequence[str] | None = None) -> None:
    """Run what is missing, and tell each seed's end as it comes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seeds_of, required=True, help="such as 0-9 or 0,3,7")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--motion", choices=get_args(MotionMake), default="grbl", help="make of the motion controller")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args(words)
    given.out.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in given.seeds if not (given.out / f"run-{seed}.json").exists()]
    with ProcessPoolExecutor(given.workers, max_tasks_per_child=1) as pool:
        runs = {pool.submit(mill_one, seed, given.out, given.motion): seed for seed in missing}
        for done, run in enumerate(as_completed(runs), start=1):
            figures, file = run.result(), given.out / f"run-{runs[run]}.json"
            file.write_text(json.dumps(figures), encoding="utf-8")
            truth = figures["truth"]
            flap = "free" if truth["flap_free"] else "not free"
            harm = "TOUCHED" if truth["membrane_touched"] else "untouched"
            milled = f"{figures['milling_time_s']:.0f} s milling"
            print(
                f"{done}/{len(missing)} seed {runs[run]}: {figures['outcome']}, flap {flap}, membrane {harm}, {milled}"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
