"""`mill resume`: go on with a window whose run ended too early."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.live import live_option
from cli.options import BenchChoice, json_option, log_option, rig_option, trace_option
from cli.output import columns, console_beside
from cli.runs import folder_option, located
from cli.study import study_options
from cli.window import Window, mill_window
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from milling.job import Job
    from milling.standing import Standing


@click.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@rig_option
@folder_option
@click.option(
    "--record", type=click.Path(path_type=Path), metavar="DIR", help="Folder of the new record. [default: runs/DATE]"
)
@trace_option
@json_option
@live_option
@log_option
@study_options
def resume(
    run_folder: Path,
    rig: Path | None,
    folder: Path,
    record: Path | None,
    trace_file: Path | None,
    json_file: Path | None,
    live: bool,
    log_file: Path | None,
    study: dict[str, str],
) -> None:
    """Go on with a window whose run was stopped, held, or ended by a crash.

    Homes, verifies the drill tip in both cameras, and looks whether the skull lies where it lay. Then the kerf's floor
    is touched at a few points; only where it is felt where the journal says, milling goes on from there. The record
    is a new one; the old one stays as it is.
    """
    from milling.job import Job
    from milling.record import read_run
    from milling.standing import standing_of

    run = read_run(located(run_folder, folder))
    if rig is None:
        raise click.UsageError("give --rig FILE: the rig on which the window lies")
    if run.header.get("seed") is not None:
        raise ConfigError(
            f"{run.folder}: cannot be resumed: its virtual bench ended with it; one with --rig on `mill emulate` can be"
        )
    job = Job.of_record(run.header, run.folder)
    standing = standing_of(run, job)
    _show(standing, job, console_beside(json_file))
    calibration = run.folder / "calibration.toml"
    chosen = BenchChoice(rig, trace_file=trace_file)
    mill_window(
        Window(
            "resume",
            chosen,
            lambda _: job,
            calibration,
            record,
            json_file,
            standing,
            run,
            study=study,
            live=live,
            log_file=log_file,
        )
    )


def _show(standing: "Standing", job: "Job", console: "Console") -> None:
    """Where every point stands, before anything moves."""
    ledger = standing.ledger(job)
    rows = [
        (str(index + 1), f"{ledger.cut_mm(index):.3f}", f"{point.completion:.2f}", point.state.value, point.why)
        for index, point in enumerate(ledger.points)
    ]
    for line in columns(("point", "depth, mm", "completion", "state", "why"), rows):
        console.print(line, highlight=False, soft_wrap=True)
