"""`mill run`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cli.live import live_option
from cli.options import BenchChoice, json_option, log_option, on_a_bench
from cli.rig import Rig
from cli.study import study_options
from cli.window import Window, mill_window

if TYPE_CHECKING:
    from milling.job import Job


@click.command()
@on_a_bench
@json_option
@live_option
@log_option
@study_options
@click.option("--calibration", type=click.Path(path_type=Path), metavar="FILE", help="[default: calibrations/RIG.toml]")
@click.option("--policy", type=click.Choice(["default", "paper", "previous"]), help="How to go deeper.")
@click.option("--radius", "radius_mm", type=float, metavar="MM", help="Radius of the ring, 2 to 4 mm.")
@click.option("--feed", "feed_mm_s", type=float, metavar="MM/S", help="Speed along the ring, at most 5 mm/s.")
@click.option("--points", "n_points", type=int, metavar="N", help="Trajectory points.")
@click.option("--ratio", "landmark_ratio", type=float, metavar="L", help="Centre between bregma (0) and lambda (1).")
@click.option(
    "--center",
    "center_mm",
    type=(float, float, float),
    metavar="X Y Z",
    help="The ring's centre in mm, its height near the surface, in place of bregma and lambda.",
)
@click.option(
    "--record", type=click.Path(path_type=Path), metavar="DIR", help="Folder of this run's record. [default: runs/DATE]"
)
@click.option(
    "--picture-every",
    "picture_period_s",
    type=click.FloatRange(min=0.0),
    default=2.0,
    show_default=True,
    metavar="S",
    help="How often the record keeps a picture; 0 keeps all that are read.",
)
def run(
    chosen: BenchChoice,
    json_file: Path | None,
    live: bool,
    log_file: Path | None,
    calibration: Path | None,
    record: Path | None,
    picture_period_s: float,
    study: dict[str, str],
    **choices: Any,
) -> None:
    """Mill one window in a closed loop, and write its record and report.

    With --emulate and without --calibration, the virtual bench is calibrated first. Ctrl-C lifts the drill, stops the
    spindle and closes the record; a second one stops everything where it stands.
    """

    def job(bench: Rig) -> "Job":
        from milling.job import Job

        return Job.from_table(_job_table(bench, choices))

    mill_window(
        Window(
            "run",
            chosen,
            job,
            calibration,
            record,
            json_file,
            study=study,
            picture_period_s=picture_period_s,
            live=live,
            log_file=log_file,
        )
    )


def _job_table(bench: Rig, choices: dict[str, Any]) -> dict[str, Any]:
    """The rig file's job, with what the command line says instead."""
    tool = {"ball_radius_mm": bench.config.tool.ball_radius_mm}
    spindle_rpm = bench.config.spindle.model_dump().get("speed_rpm")
    speed = {} if spindle_rpm is None else {"spindle_rpm": spindle_rpm}
    return {**tool, **speed, **bench.config.job, **{key: value for key, value in choices.items() if value is not None}}
