"""`mill runs`: the records of past runs."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.options import json_option
from cli.output import columns, write_json
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from milling.record import Run

RUNS = Path("runs")
folder_option = click.option(
    "--runs",
    "folder",
    type=click.Path(path_type=Path, file_okay=False),
    default=RUNS,
    show_default=True,
    metavar="DIR",
    help="Folder of the records.",
)


@click.group(no_args_is_help=False)
def runs() -> None:
    """List, show, report, replay and export recorded runs."""


@runs.command("list")
@folder_option
@json_option
def list_runs(folder: Path, json_file: Path | None) -> None:
    """List the runs in the folder, the newest last."""
    from milling.record import read_run

    rows: list[dict[str, str | float | None]] = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if not (path / "header.json").is_file():
            continue
        try:
            run = read_run(path)
        except ConfigError as error:
            rows.append({"run": path.name, "outcome": "damaged", "reason": str(error)})
        else:
            rows.append({"run": path.name, **summary(run)})
    if json_file:
        write_json(json_file, "runs list", seed=None, runs=rows)
        if str(json_file) == "-":
            return
    if not rows:
        click.echo(f"{folder}: no runs yet; `mill run --emulate` makes one")
        return
    table = [(str(row["run"]), str(row["outcome"]), _seconds(row), str(row["reason"])) for row in rows]
    for line in columns(("run", "outcome", "milling", "reason"), table):
        click.echo(line)


@runs.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@folder_option
@json_option
def show(run_folder: Path, folder: Path, json_file: Path | None) -> None:
    """Show one run: what it was, how it ended, and every point of its ring."""
    from milling.record import read_run

    run = read_run(located(run_folder, folder))
    facts = summary(run)
    points = [] if run.result is None else run.result["points"]
    if json_file:
        write_json(json_file, "runs show", seed=None, header=run.header, **facts, points=points, damage=run.damage)
        if str(json_file) == "-":
            return
    lines = {
        "rig": facts["rig"],
        "date": run.header.get("date"),
        "outcome": facts["outcome"],
        "reason": facts["reason"],
        "milling": _seconds(facts),
        "damage": run.damage or "none",
    }
    for name, value in lines.items():
        if value:
            click.echo(f"{name:>8}  {value}")
    if not points:
        return
    click.echo()
    table = []
    for number, point in enumerate(points, start=1):
        contact = point.get("contact_mm")
        table.append(
            (
                str(number),
                "" if contact is None else f"{contact:.3f}",
                f"{point['depth_mm']:.3f}",
                f"{point['completion']:.2f}",
                point.get("state", ""),
                point.get("why", ""),
            )
        )
    for line in columns(("point", "contact, mm", "depth, mm", "completion", "state", "why"), table):
        click.echo(line)


@runs.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@folder_option
def report(run_folder: Path, folder: Path) -> None:
    """Write a run's report anew from its record, and print its path."""
    from cli.reports.run_report import write_report

    click.echo(write_report(located(run_folder, folder)))


@runs.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--weights",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Completion weights in place of those that ran.",
)
@click.option(
    "--policy", type=click.Choice(["default", "paper", "previous"]), help="Policy in place of the one that ran."
)
@folder_option
@json_option
def replay(run_folder: Path, weights: Path | None, policy: str | None, folder: Path, json_file: Path | None) -> None:
    """Decide a recorded run again, and show where the decisions part.

    With neither weights nor policy: by this version of mill. Other weights read the pictures that the record kept; a
    run with `--picture-every 0` keeps all of them. Nothing moves.
    """
    from cli.redecide import decide_again

    decide_again(located(run_folder, folder), weights, policy, json_file)


@runs.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--mcap",
    "mcap_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="MCAP, for Foxglove. Needs micromill[foxglove].",
)
@click.option(
    "--rerun",
    "rerun_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="A Rerun recording, FILE.rrd. Needs micromill[rerun].",
)
@folder_option
def export(run_folder: Path, mcap_file: Path | None, rerun_file: Path | None, folder: Path) -> None:
    """Write a run for other programs: pictures, path, surface, figures and reasons on one clock."""
    from cli import record_export

    record_export.export(located(run_folder, folder), mcap_file, rerun_file)


@runs.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@click.option("--in", "viewer", type=click.Choice(["foxglove", "rerun"]), required=True, help="Which viewer looks.")
@folder_option
def follow(run_folder: Path, viewer: str, folder: Path) -> None:
    """Show a run that goes on in Foxglove or Rerun, from its growing record.

    It reads files and listens to nobody: the run does not know of it. Viewers on this computer can connect.
    """
    from cli import record_export

    record_export.follow(located(run_folder, folder), viewer)


def located(run_folder: Path, folder: Path) -> Path:
    """A run by its path, or by its name in the folder of runs.

    Raises:
        ConfigError: there is none of this name.
    """
    for path in (run_folder, folder / run_folder):
        if (path / "header.json").is_file():
            return path
    raise ConfigError(f"{run_folder}: no such run, here or in {folder}; `mill runs list` lists them")


def summary(run: "Run") -> dict[str, str | float | None]:
    """The line a person looks for. A run without a result was cut off: its events are whole up to then."""
    result = run.result or {}
    return {
        "rig": str(run.header.get("rig", "")),
        "outcome": str(result.get("outcome", "cut off")),
        "reason": str(result.get("reason", "the process ended before the run did; its events are kept")),
        "milling_time_s": result.get("milling_time_s"),
    }


def _seconds(facts: Mapping[str, str | float | None]) -> str:
    """The milling time; nothing where a run did not live to tell it."""
    time_s = facts.get("milling_time_s")
    return "" if time_s is None else f"{float(time_s):.0f} s"
