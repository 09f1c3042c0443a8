"""`mill doctor`: examines a rig, and certifies one that is well."""

import gc
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cli.emulate import sorted_faults
from cli.live import live_option, page_for, shown_in_the_air, stoppable
from cli.options import BenchChoice, json_option, on_a_bench
from cli.output import console_beside, for_people, write_json
from cli.rig import Rig, rig_for, traced
from drivers.errors import MillError
from drivers.recorder import NullRecorder

if TYPE_CHECKING:
    from calib.calibration_file import Calibration
    from doctor.certificate import Certificate
    from doctor.check import Check, Patient
    from drivers.motion.interface import MotionController

CERTIFICATES = Path("certificates")
ALMOST_FULL_MB = 12.0
"""What `disk.full` leaves."""


@click.command()
@on_a_bench
@json_option
@live_option
@click.option(
    "--no-motion", is_flag=True, help="Leave the axes and the spindle still; measure only what needs neither."
)
@click.option(
    "--recertify", is_flag=True, help="Compare with no earlier certificate: what has changed since was meant to."
)
def doctor(chosen: BenchChoice, json_file: Path | None, live: bool, no_motion: bool, recertify: bool) -> None:
    """Measure a rig: computer, motion, spindle, cameras, and all of them together.

    The axes home, move in the air and visit the setpoints of a calibration; the spindle turns for some seconds. It
    takes about two minutes. When every check passes it writes a certificate, bound to these very devices, which
    `mill run` asks for; with one from before, it tells what has changed since. Exits 0 only if every check passes.
    """
    from cli.reports.doctor_report import write_doctor_report
    from doctor.certificate import certify
    from doctor.examination import attendance, examine

    console = console_beside(json_file)
    checks: list[Check] = []
    seen: list[Calibration] = []
    with (
        page_for(live, console) as page,
        rig_for(chosen, plants=("disk",)) as bench,
        shown_in_the_air(traced(NullRecorder(), bench), page, bench.config.name, "doctor", bench.clock) as told,
    ):

        @contextmanager
        def open_motion() -> "Iterator[MotionController]":
            with bench.open_motion() as controller, stoppable(controller, page, bench.clock) as motion:
                yield motion

        # A full garbage collection takes about as long as a drive waits for its host, and would be told as its silence.
        gc.collect()
        gc.freeze()
        working = console.status("who is there")
        known = _patient(bench, chosen, moving=not no_motion, doing=working.update)
        patient = replace(known, open_motion=open_motion, recorder=told)
        with working:
            there = attendance(patient)
            earlier = None if recertify else _earlier(there.devices)
            if earlier is not None:
                console.print(f"compared with the certificate of {earlier.date}", style="dim")
            for check in examine(replace(patient, earlier=earlier), seen.append, _words):
                checks.append(check)
                told.event("stage", stage="examining", detail=check.name)
                told.event("check", **check.to_json())
                _show(console, check)
        failed = [check for check in checks if not check.passed]
        if failed:
            told.event("outcome", outcome="failed", reason=f"{len(failed)} of {len(checks)} checks failed")
        else:
            told.event("outcome", outcome="complete", reason="every check passed")
    gc.unfreeze()
    passed = not failed
    now = datetime.now(UTC)
    path = CERTIFICATES / f"{re.sub('[^a-z0-9]+', '-', bench.config.name.lower()).strip('-')}.json"
    certified = passed and not no_motion
    if certified:
        found = certify(bench.config.name, there.devices, there.settings, checks, seen[0] if seen else None,
                        now=now, software=software())  # fmt: skip
        found.save(path)
    # The page beside a certificate is that of the examination it came from.
    report = path.with_suffix(".html") if certified else path.with_name(f"{path.stem}-examined.html")
    write_doctor_report(report, bench.config.name, checks, there.devices, earlier, now, certified=certified)
    if json_file:
        findings = [check.to_json() for check in checks]
        paths = {"report": str(report), "certificate": str(path) if certified else None}
        write_json(json_file, "doctor", seed=chosen.drawn_from, passed=passed, checks=findings, **paths)
    console.print(f"report: {report}", highlight=False, soft_wrap=True)
    if failed:
        console.print(f"[bold red]{len(failed)} of {len(checks)} checks failed[/]")
        raise SystemExit(1)
    console.print(f"[bold green]every check passed[/]{f', certificate: {path}' if certified else ''}", soft_wrap=True)


def software() -> str:
    """What a certificate says of this version."""
    return f"micromill {version('micromill')}"


def _patient(bench: Rig, chosen: BenchChoice, *, moving: bool, doing: Callable[[str], None]) -> "Patient":
    from doctor.check import Limits, Patient
    from vision.keypoints import TipFinder

    config = bench.config
    spindle, motion = config.spindle.model_dump(), config.motion.model_dump()
    limits = config.certificate.model_dump(exclude={"required", "max_age_h"})
    full = any(fault.name == "disk.full" for fault in sorted_faults(chosen.faults)[1])

    def free_disk_mb() -> float:
        return ALMOST_FULL_MB if full else shutil.disk_usage(Path.cwd()).free / 1e6

    return Patient(
        clock=bench.clock,
        open_motion=bench.open_motion,
        open_spindle=bench.open_spindle,
        open_camera=bench.open_camera,
        find_tip=TipFinder.load(config.weights.tip).find,
        park_mm=config.bench.park_mm,
        center_from_tip_mm=config.tool.center_from_tip_mm,
        speed_rpm=float(spindle.get("speed_rpm", 20_000.0)),
        limits=Limits(**limits),
        motion_port=str(motion.get("port", "")),
        spindle_port=str(spindle.get("channel", "")),
        moving=moving,
        free_disk_mb=free_disk_mb,
        doing=doing,
    )


def _earlier(devices: tuple[str, str, str]) -> "Certificate | None":
    """The newest certificate of these devices, of which one may have changed."""
    from doctor.certificate import certificates_in

    return next((each for _, each in certificates_in(CERTIFICATES) if each.is_of(*devices)), None)


def _words(error: Exception) -> str:
    return for_people(error) if isinstance(error, MillError) else str(error)


def _show(console: Any, check: "Check") -> None:
    mark = "[green]pass[/]" if check.passed else "[bold red]FAIL[/]"
    line = f"{mark}  {check.name:<40} {check.shown}  [dim]{check.limit}[/]"
    console.print(line, highlight=False, soft_wrap=True)
    if check.advice and not check.passed:
        console.print(f"      {check.advice}", highlight=False, soft_wrap=True, style="yellow")
