"""One window from open devices to the report: what `mill run` and `mill resume` share."""

import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cli.calibrate import calibrate_rig, calibration_path, rig_identity
from cli.doctor import CERTIFICATES, software
from cli.emulate import hogged, recorded, sorted_faults, spoiled
from cli.live import page_for, shown, shown_in_the_air, stoppable
from cli.log import Logged, logged
from cli.options import BenchChoice
from cli.output import console_beside, write_json
from cli.rig import Rig, rig_for, silence_s, traced
from cli.study import study_of
from drivers.device import closed_in_the_end
from drivers.errors import ConfigError
from drivers.recorder import NullRecorder

if TYPE_CHECKING:
    from rich.console import Console

    from calib.calibration_file import Calibration
    from drivers.camera.interface import StereoCamera
    from drivers.motion.interface import MotionController
    from drivers.spindle.interface import Spindle
    from live.page import Page
    from milling.guard import Guard
    from milling.job import Job
    from milling.record import Run
    from milling.standing import Standing
    from vision.keypoints import TipFinder


@dataclass(frozen=True)
class Window:
    """What is asked for."""

    command: str
    chosen: BenchChoice
    job: Callable[[Rig], "Job"]
    """What to mill on this rig."""
    calibration: Path | None = None
    record: Path | None = None
    json_file: Path | None = None
    standing: "Standing | None" = None
    """An earlier run's window, to go on with."""
    resumed: "Run | None" = None
    """Its record."""
    study: Mapping[str, str] = field(default_factory=dict)
    """Ids from the command line."""
    picture_period_s: float = 2.0
    """How often the record keeps a picture."""
    live: bool = False
    """Whether a browser shows it."""
    log_file: Path | None = None
    """Where what happens is added as JSON lines."""


def mill_window(asked: Window) -> None:
    """Open the devices, mill, write record and report, and tell how it ended; exit code 1 where not as asked.

    Raises:
        ConfigError: a file that cannot be used; nothing has moved.
    """
    chosen, json_file = asked.chosen, asked.json_file
    from calib.calibration_file import Calibration
    from cli.progress import watched
    from cli.score import Scorer
    from doctor.certificate import require
    from milling import loop
    from milling.load import require_load
    from milling.loop import Finders
    from milling.record import RunRecorder
    from vision.completion import CompletionReader
    from vision.disparity import match
    from vision.keypoints import LandmarkFinder, TipFinder

    console = console_beside(json_file)

    def while_closing(error: Exception) -> None:
        console.print(f"while closing: {error}", highlight=False, soft_wrap=True)

    folder = asked.record or Path("runs") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    if (folder / "events.jsonl").exists():
        raise ConfigError(f"{folder}: holds a run already, which is kept; name another --record folder")
    with (
        logged(asked.log_file, console.print, run=folder.name, command=asked.command),
        _stop_signals() as stop_requested,
        page_for(asked.live, console) as page,
        rig_for(chosen, plants=("vision", "host", "disk")) as bench,
    ):
        own = bench.config.weights
        tip, landmarks = TipFinder.load(own.tip), LandmarkFinder.load(own.landmarks)
        completion = CompletionReader.load(own.completion)
        weights = {"tip": tip.sha256, "landmarks": landmarks.sha256, "completion": completion.sha256}
        planted, own_faults = sorted_faults(chosen.faults)
        job = asked.job(bench)
        study = study_of(asked.study, bench.config.study, asked.resumed)
        path = asked.calibration or calibration_path(bench.config.name)
        age: dict[str, Any] = {"now": datetime.now(UTC), "max_age_h": bench.config.calibration.max_age_h}
        known = (
            None
            if chosen.emulate and asked.calibration is None
            else Calibration.load(path, None, for_milling=True, **age)
        )
        with (
            closed_in_the_end(bench.open_spindle(), while_closing) as spindle,
            closed_in_the_end(bench.open_camera(), while_closing) as camera,
            closed_in_the_end(bench.open_motion(), while_closing) as motion,
        ):
            require_load(spindle)
            identity = rig_identity(bench, motion, camera, spindle.identity)
            certified = bench.config.certificate
            if certified.required and not chosen.emulate:
                devices = (motion.identity, spindle.identity, camera.identity)
                require(CERTIFICATES, devices, motion.settings, software=software(),
                        max_age_h=certified.max_age_h, now=age["now"])  # fmt: skip
            if known is None:
                known = _calibrated(asked.command, bench, motion, camera, spindle.identity, tip, page, console)
                console.print(f"calibrated: held-out error {known.rmse_mm:.3f} mm ({known.model} model)")
            else:
                known = Calibration.load(path, identity, for_milling=True, **age)
            header = {
                "command": asked.command,
                "version": version("micromill"),
                "date": datetime.now(UTC).isoformat(timespec="seconds"),
                "rig": bench.config.name,
                "identity": identity.model_dump(),
                "seed": chosen.drawn_from,
                "specimen": str(chosen.specimen) if chosen.specimen else None,
                "faults": [str(fault) for fault in (*planted, *own_faults)],
                "job": asdict(job),
                "weights": weights,
                "calibration": _calibration_header(known),
                "study": study,
            }
            if asked.resumed is not None:
                chain = asked.resumed.chain
                header |= {"resumes": str(asked.resumed.folder), "resumes_head": None if chain is None else chain.head}
            with RunRecorder(
                folder, header, bench.clock, frame_period_s=asked.picture_period_s, on_loss=console.print
            ) as recorder:
                if bench.trace is not None:
                    bench.trace.event("record", folder=str(folder))
                known.save(folder / "calibration.toml")
                recorder.vouch("calibration.toml")
                reader = spoiled(completion, own_faults, bench.clock, seed=chosen.seed)
                finders = Finders(tip.find, landmarks.find, reader, match)
                rig_ = loop.Rig(
                    motion,
                    spindle,
                    camera,
                    bench.clock,
                    bench.config.tool.center_from_tip_mm,
                    bench.config.bench.park_mm,
                )
                scorer = Scorer(traced(recorded(recorder, own_faults, bench.clock), bench), bench)
                with watched(console) as tell, hogged(own_faults), _guarded(motion, spindle, bench) as guard:
                    told = shown(scorer, page, folder, asked.command, known, guard, bench.clock)
                    told = Logged(told) if asked.log_file else told
                    result = loop.run(
                        replace(rig_, guard=guard),
                        known,
                        finders,
                        job,
                        told,
                        progress=tell,
                        stop_requested=stop_requested,
                        standing=asked.standing,
                    )
                recorder.close(result.to_json())
        truth = scorer.truth(result)
    report = write_report(folder)
    color = "green" if result.outcome == "complete" else "bold red"
    console.print(f"outcome: [{color}]{result.outcome}[/]  {result.reason}", highlight=False, soft_wrap=True)
    console.print(f"milling time: {result.milling_time_s:.0f} s", highlight=False)
    if truth:
        console.print(
            f"the virtual bench says: membrane {'TOUCHED' if truth['membrane_touched'] else 'not touched'}, "
            f"flap {'free' if truth['flap_free'] else 'not free'}",
            highlight=False,
        )
    console.print(f"report: {report}", highlight=False, soft_wrap=True)
    if json_file:
        figures = {**result.to_json(), "record": str(folder), "report": str(report)}
        if truth is not None:
            figures["truth"] = truth
        write_json(json_file, asked.command, seed=chosen.drawn_from, **figures)
    if result.outcome != "complete":
        raise SystemExit(1)


def _calibrated(
    command: str,
    bench: Rig,
    motion: "MotionController",
    camera: "StereoCamera",
    spindle_identity: str,
    tip: "TipFinder",
    page: "Page | None",
    console: "Console",
) -> "Calibration":
    """Of a virtual bench that nobody has calibrated."""
    with (
        shown_in_the_air(traced(NullRecorder(), bench), page, bench.config.name, command, bench.clock) as told,
        stoppable(motion, page, bench.clock) as stopped,
    ):
        console.print("homing")
        told.event("stage", stage="homing")
        stopped.home()
        return calibrate_rig(bench, stopped, camera, spindle_identity, tip, told, console)


def _calibration_header(calibration: "Calibration") -> dict[str, Any]:
    return {
        "model": calibration.model,
        "rmse_mm": calibration.rmse_mm,
        "predicted_rmse_mm": calibration.predicted_rmse_mm,
        "date": calibration.provenance.date,
    }


def write_report(folder: Path) -> Path:
    """Write the run's report beside its record."""
    from cli.reports.run_report import write_report as write

    return write(folder)


def _guarded(
    motion: "MotionController", spindle: "Spindle", bench: Rig
) -> "contextlib.AbstractContextManager[Guard | None]":
    """A supervisor for the motion, where one can reach its wire; it hears the spindle's alarms, where it can."""
    from milling.guard import Guard

    path = motion.stop_path
    if path is None:
        return contextlib.nullcontext()
    return Guard(path, bench.clock, silence_s=silence_s(bench.config), alarm=spindle.alarm_path)


@contextlib.contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """The first SIGINT or SIGTERM asks the loop to stop; a second SIGINT interrupts whatever it does."""
    asked: list[int] = []

    def ask(number: int, _frame: object) -> None:
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.append(number)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
