"""Does `mill doctor` find what is planted, by name, and nothing on a rig that is well? On the virtual clock.

    python -m studies.doctor_trials --seeds 0-19 --fault-seeds 0-2 --out DIR --json FILE

Every rig is examined twice while it is well: without a certificate, and against that of the first time. Then, on
some of them, once for each planted fault, against the same certificate.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from calib.calibration_file import Calibration
from doctor.certificate import Certificate, certify
from doctor.check import Check, Patient
from doctor.examination import attendance, examine
from drivers.camera.stereo import StereoPair
from drivers.motion.grbl.driver import GrblController
from drivers.motion.serial_line import open_serial
from drivers.spindle.cia402 import Cia402Spindle
from firmware_sim.bench import (
    FIRMWARE,
    MAX_FEED_MM_S,
    MAX_SPEED_RPM,
    MECHANICAL_SETTINGS,
    NODE_ID,
    ORIGIN_MM,
    PARK_MM,
    Bench,
)
from firmware_sim.clock import SimClock
from firmware_sim.faults import parse_faults
from firmware_sim.lines import InProcessBus, InProcessLine, in_process_sources
from firmware_sim.ptys import SerialPty
from firmware_sim.specimen import draw_specimen
from studies.trials import Figures
from studies.virtual_runs import FPS, MAX_SKEW_S, SIZE_PX, seeds_of
from vision.keypoints import TipFinder

_HOLDER: Final = "import fcntl, sys; f = open(sys.argv[1]); fcntl.flock(f, 2); print(flush=True); sys.stdin.read()"
SPEED_RPM: Final = 45_000.0
NEXT_TO_NOTHING_MB: Final = 12.0
BUSY: Final = ("computer: wakes up late", "computer: write to disk")
"""What other programs on the computer do to it."""
NAMED: Final = {
    "camera.swapped": r"eyes: left, right and mirrored.*(swapped|exchanged)",
    "camera.mirrored": r"eyes: left, right and mirrored.*mirror",
    "camera.stuck": r"camera: answers.*frozen",
    "camera.skew=40ms": r"camera: skew of left and right",
    "camera.exposure=2x": r"camera: (left|right) exposure as certified",
    "motion.backlash=0.05mm": r"stage: backlash of [XY]",
    "motion.scale_x=1.01": r"stage: scale of X as certified",
    "serial.latency=16ms": r"motion: serial round trip",
    "motion.no_soft_limits": r"motion: answers.*soft limits",
    "motion.firmware=1.1f": r"motion: answers.*firmware version",
    "motion.settings_changed": r"motion: answers.*\$110",
    "spindle.slow=10%": r"spindle: (steady speed|answers.*rpm)",
    "spindle.no_consumer": r"spindle: (speed after host silence|answers.*(heartbeat|1016h))",
    "can.drop=0.02": r"spindle: answers lost",
    "port.held": r"motion: answers.*in use by pid \d+",
    "disk.full": r"computer: free disk",
}
"""What is planted, and the finding that names it."""


def patient(bench: Bench, clock: SimClock, *, free_disk_mb: float = 1e6) -> Patient:
    """A bench of this process, opened device by device."""
    clock.attach(bench.advance_to)
    x, y, z = (bench.specimen.tool.ball_radius_mm * along for along in bench.specimen.tool.axis)
    name = str(bench.serial_number)

    def motion() -> GrblController:
        if bench.port_held:
            with _held_port() as path:
                open_serial(path, 115_200).close()
        return GrblController(
            InProcessLine(bench, clock), clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=MAX_FEED_MM_S,
            expected_settings=MECHANICAL_SETTINGS, expected_firmware=FIRMWARE[bench.dialect],
        )  # fmt: skip

    def camera() -> StereoPair:
        left, right = in_process_sources(bench.shoot, clock, fps=FPS, name=name)
        return StereoPair(left, right, clock, size_px=SIZE_PX, max_skew_s=MAX_SKEW_S)

    return Patient(
        clock=clock,
        open_motion=motion,
        open_spindle=lambda: Cia402Spindle(
            InProcessBus(bench.can, clock), clock, node_id=NODE_ID, max_speed_rpm=MAX_SPEED_RPM
        ),
        open_camera=camera,
        find_tip=TipFinder.load().find,
        park_mm=PARK_MM,
        center_from_tip_mm=(x, y, z),
        speed_rpm=SPEED_RPM,
        free_disk_mb=lambda: free_disk_mb,
    )


@contextmanager
def _held_port() -> Iterator[str]:
    """A port that another process has: the board's own wire is in this one."""
    with closing(SerialPty()) as port:
        words = [sys.executable, "-c", _HOLDER, port.path]
        with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
            assert holder.stdout is not None
            holder.stdout.readline()
            yield port.path
            holder.communicate()


def examined(seed: int, faults: Sequence[str], earlier: Certificate | None) -> tuple[list[Check], Certificate]:
    """All findings, and the certificate that they would give."""
    planted = parse_faults(faults)
    bench = Bench(draw_specimen(seed), faults=[each for each in planted if each.kind.place == "bench"])
    full = any(each.name == "disk.full" for each in planted)
    found = patient(bench, SimClock(), free_disk_mb=NEXT_TO_NOTHING_MB if full else 1e6)
    there = attendance(found)
    seen: list[Calibration] = []
    checks = list(examine(replace(found, earlier=earlier), seen.append, lambda error: " ".join(str(error).split())))
    calibration = seen[0] if seen else None
    return checks, certify("virtual", there.devices, there.settings, checks, calibration,
                           now=datetime.now(UTC), software="")  # fmt: skip


def named(check: Check) -> str:
    """A finding on one line."""
    return f"{check.name}: {check.shown}, {check.limit}. {check.advice}".strip()


def examine_one(seed: int, faults: Sequence[str], out: Path) -> None:
    """One rig while it is well, twice, and with each fault; what was done already is not done again."""
    file = out / f"rig-{seed}.json"
    rows: list[Figures] = json.loads(file.read_text()) if file.exists() else []
    done = {row["fault"] for row in rows}
    wanted = [fault for fault in ("", "again", *faults) if fault not in done]
    if not wanted:
        return
    well, certificate = examined(seed, (), None)
    for fault in wanted:
        checks = well if fault == "" else examined(seed, [fault] if fault in NAMED else (), certificate)[0]
        failed = [named(check) for check in checks if not check.passed]
        rows.append({"seed": seed, "fault": fault, "failed": failed, "checks": len(checks)})
        file.write_text(json.dumps(rows, indent=1))
        told = any(re.search(NAMED[fault], finding) for finding in failed) if fault in NAMED else not failed
        print(f"rig {seed} {fault or 'well'}: {'as it should' if told else 'WRONG'}; {failed}", flush=True)


def summary(rows: Sequence[Figures]) -> Figures:
    """Rigs that were well and called ill; and of each fault, how often it was found by name.

    The computer is the one that makes the study: that it was found busy is told, and no false alarm.
    """
    well = [row for row in rows if row["fault"] not in NAMED]
    alarms = [[each for each in row["failed"] if not each.startswith(BUSY)] for row in well]
    found = {}
    for fault, finding in NAMED.items():
        mine = [row for row in rows if row["fault"] == fault]
        if mine:
            hits = sum(any(re.search(finding, each) for each in row["failed"]) for row in mine)
            found[fault] = {"examinations": len(mine), "found": hits}
    return {
        "well": {
            "examinations": len(well),
            "false_alarms": sum(map(bool, alarms)),
            "computer_busy": sum(any(each.startswith(BUSY) for each in row["failed"]) for row in well),
        },
        "false_alarms_told": sorted({each for told in alarms for each in told}),
        "faults": found,
    }


def main(words: Sequence[str] | None = None) -> None:
    """Examine what was not examined yet; tell the whole."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, required=True, help="rigs, such as 0-19")
    parser.add_argument("--fault-seeds", type=seeds_of, default=[], help="those that are given faults as well")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args(words)
    given.out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(given.workers, max_tasks_per_child=1) as pool:
        jobs = [
            pool.submit(examine_one, seed, list(NAMED) if seed in given.fault_seeds else [], given.out)
            for seed in given.seeds
        ]
        for job in as_completed(jobs):
            job.result()
    rows = [row for seed in given.seeds for row in json.loads((given.out / f"rig-{seed}.json").read_text())]
    figures = summary(rows)
    print(json.dumps(figures, indent=1))
    if given.json:
        given.json.write_text(json.dumps({"command": "doctor trials", "seeds": given.seeds, **figures}))


if __name__ == "__main__":
    main()
