"""`mill calibrate`."""

import re
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import click

from cli.live import live_option, page_for, shown_in_the_air, stoppable
from cli.options import BenchChoice, json_option, on_a_bench
from cli.output import console_beside, write_json
from cli.rig import Rig, rig_for, traced
from drivers.errors import ConfigError
from drivers.recorder import NullRecorder

if TYPE_CHECKING:
    from calib.calibration_file import Calibration, Provenance
    from drivers.camera.interface import StereoCamera
    from drivers.motion.interface import MotionController
    from drivers.recorder import Recorder
    from vision.keypoints import TipFinder


def calibration_path(rig_name: str) -> Path:
    """Where the calibration of a rig lies unless told otherwise."""
    return Path("calibrations") / f"{re.sub('[^a-z0-9]+', '-', rig_name.lower()).strip('-')}.toml"


@click.command()
@on_a_bench
@json_option
@live_option
@click.option("--recipe", type=click.Choice(["default", "paper"]), default="default", show_default=True)
@click.option("--verify", "only_verify", is_flag=True, help="Check an existing calibration at one setpoint instead.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Calibration file. [default: calibrations/RIG.toml]",
)
def calibrate(
    chosen: BenchChoice,
    json_file: Path | None,
    live: bool,
    recipe: str,
    only_verify: bool,
    out: Path | None,
) -> None:
    """Calibrate the stereo microscope against the robot.

    Homes, drives the drill through setpoints in free air, finds its ball in both pictures, and writes a calibration
    file that holds for this rig only. The spindle stays off.
    """
    from calib.calibration_file import Calibration
    from cli.reports.calibration_report import write_calibration_report
    from studies.calibration_error import errors_in_box
    from vision.keypoints import TipFinder

    console = console_beside(json_file)
    with page_for(live, console) as page, rig_for(chosen) as bench:
        find_tip = TipFinder.load(bench.config.weights.tip)
        path = out or calibration_path(bench.config.name)
        if path.suffix == ".html":
            raise ConfigError(
                f"--out {path}: that is the name of its report; give the file another ending, such as .toml"
            )
        if only_verify:
            Calibration.load(path, None)  # an unusable file is refused before anything moves
        started_s = bench.clock.now_s()
        with (
            bench.open_spindle() as spindle,
            bench.open_camera() as camera,
            bench.open_motion() as controller,
            shown_in_the_air(traced(NullRecorder(), bench), page, bench.config.name, "calibrate", bench.clock) as told,
            stoppable(controller, page, bench.clock) as motion,
        ):
            known = (
                Calibration.load(path, rig_identity(bench, motion, camera, spindle.identity)) if only_verify else None
            )
            console.print("homing")
            told.event("stage", stage="homing")
            motion.home()
            if known is not None:
                told.event("stage", stage="verifying")
                _verify(known, path, bench, motion, camera, find_tip, told, console, json_file)
                return
            calibration = calibrate_rig(bench, motion, camera, spindle.identity, find_tip, told, console, recipe=recipe)
            calibration.save(path)
            told.event("outcome", outcome="complete", reason=f"held-out error {calibration.rmse_mm:.3f} mm; {path}")
            duration_s = bench.clock.now_s() - started_s
            report = path.with_suffix(".html")
            write_calibration_report(report, calibration, path, duration_s)
            _show(console, calibration, path, duration_s)
            console.print(f"  report: {report}", highlight=False, soft_wrap=True)
            if json_file is None:
                return
            figures = _figures(calibration, path, duration_s)
            if chosen.emulate:
                figures["truth"] = errors_in_box(
                    motion, camera, bench.clock, find_tip.find, calibration, lambda: bench.truth() or {}, chosen.seed
                )
            write_json(json_file, "calibrate", seed=chosen.drawn_from, **figures)


def calibrate_rig(
    bench: Rig,
    motion: "MotionController",
    camera: "StereoCamera",
    spindle_identity: str,
    find_tip: "TipFinder",
    recorder: "Recorder",
    console: Any,
    *,
    recipe: str = "default",
) -> "Calibration":
    """The automatic procedure with a progress bar; the machine is homed and the drill at rest."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from calib import procedure

    columns = (
        TextColumn("calibrating"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=None)

        def show(done: int, total: int, words: str) -> None:
            recorder.event("stage", stage="calibrating", detail=f"setpoint {done} of {total}")
            progress.update(bar, completed=done, total=total, description=words)

        return procedure.calibrate(
            motion,
            camera,
            find_tip.find,
            clock=bench.clock,
            recipe=cast(Literal["default", "paper"], recipe),
            tool_offset_mm=bench.config.tool.center_from_tip_mm,
            spindle_identity=spindle_identity,
            camera_settings=bench.config.camera_settings,
            provenance=provenance(find_tip),
            recorder=recorder,
            progress=show,
        )


def provenance(find_tip: "TipFinder") -> "Provenance":
    """Date, software and weights of a calibration made now."""
    from calib.calibration_file import Provenance

    return Provenance(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"micromill {version('micromill')}",
        weights={"tip": find_tip.sha256},
    )


def _verify(
    calibration: "Calibration",
    path: Path,
    bench: Rig,
    motion: "MotionController",
    camera: "StereoCamera",
    find_tip: "TipFinder",
    recorder: "Recorder",
    console: Any,
    json_file: Path | None,
) -> None:
    from calib import procedure

    seen = procedure.verify(calibration, motion, camera, find_tip.find, clock=bench.clock, recorder=recorder)
    recorder.event("outcome", outcome="complete", reason=f"verified: off by {seen.error_px:.2f} px")
    console.print(
        f"[bold green]verified[/] {path}: off by {seen.error_mm.round(3).tolist()} mm, {seen.error_px:.2f} px, "
        f"{seen.distance_sigmas:.1f} sigmas"
    )
    if json_file:
        write_json(
            json_file,
            "calibrate",
            seed=None,
            file=str(path),
            error_mm=seen.error_mm.tolist(),
            sigma_mm=seen.sigma_mm.tolist(),
            error_px=seen.error_px,
            distance_sigmas=seen.distance_sigmas,
        )


def rig_identity(bench: Rig, motion: "MotionController", camera: "StereoCamera", spindle_identity: str) -> Any:
    """Who these devices say they are, and the tool of the rig file."""
    from calib.calibration_file import RigIdentity

    return RigIdentity(
        motion=motion.identity,
        camera=camera.identity,
        spindle=spindle_identity,
        center_from_tip_mm=bench.config.tool.center_from_tip_mm,
        camera_settings=bench.config.camera_settings,
    )


def _figures(calibration: "Calibration", path: Path, duration_s: float) -> dict[str, Any]:
    return {
        "file": str(path),
        "report": str(path.with_suffix(".html")),
        "recipe": calibration.recipe,
        "model": calibration.model,
        "candidates_mm": calibration.candidates_mm,
        "handedness": calibration.handedness,
        "not_for_milling": calibration.not_for_milling,
        "rmse_mm": calibration.rmse_mm,
        "predicted_rmse_mm": calibration.predicted_rmse_mm,
        "residuals_mm": [list(setpoint.residual_mm) for setpoint in calibration.setpoints],
        "setpoints": [list(setpoint.point_mm) for setpoint in calibration.setpoints],
        "duration_s": duration_s,
    }


def _show(console: Any, calibration: "Calibration", path: Path, duration_s: float) -> None:
    console.print(
        f"[bold green]calibrated[/] in {duration_s:.0f} s: {calibration.model} model, "
        f"held-out error {calibration.rmse_mm:.3f} mm at {len(calibration.setpoints)} setpoints, "
        f"predicted {calibration.predicted_rmse_mm:.3f} mm over the box, {calibration.handedness}"
    )
    for outlier in calibration.outliers:
        console.print(f"  left out: {list(outlier.point_mm)} mm, off by {outlier.leave_one_out_mm:.3f} mm")
    if calibration.not_for_milling:
        console.print("  [yellow]not for milling[/]: its setpoints leave height and handedness untested")
    console.print(f"  {path}")
