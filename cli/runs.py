"""`mill runs`: the records of past runs."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.options import json_option
from cli.output import write_json
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


@click.group()
def runs() -> None:
    """List, show and report recorded runs."""


@runs.command("list")
@folder_option
@json_option
def list_runs(folder: Path, json_file: Path | None) -> None:
    """List the runs in the folder, the newest last."""
    from rich.console import Console

    from milling.record import read_run

    rows: list[dict[str, str | float]] = []
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
    console = Console()
    for row in rows:
        line = f"{row['run']}  {row['outcome']:<9} {float(row.get('milling_time_s', 0.0)):5.0f} s  {row['reason']}"
        console.print(line, highlight=False, no_wrap=True, overflow="ellipsis")


@runs.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@folder_option
@json_option
def show(run_folder: Path, folder: Path, json_file: Path | None) -> None:
    """Show one run: what it was, how it ended, and every point of its ring."""
    from rich.console import Console
    from rich.table import Table

    from milling.record import read_run

    run = read_run(located(run_folder, folder))
    facts = summary(run)
    points = [] if run.result is None else run.result["points"]
    if json_file:
        write_json(json_file, "runs show", seed=None, header=run.header, **facts, points=points, damage=run.damage)
        if str(json_file) == "-":
            return
    console = Console()
    for name, value in {**facts, "date": run.header.get("date"), "damage": run.damage or "none"}.items():
        console.print(f"{name:>16}  {value}", highlight=False, soft_wrap=True)
    if not points:
        return
    table = Table("point", "contact, mm", "depth, mm", "completion", "state", "why")
    for number, point in enumerate(points, start=1):
        contact = point.get("contact_mm")
        table.add_row(
            str(number),
            "" if contact is None else f"{contact:.3f}",
            f"{point['depth_mm']:.3f}",
            f"{point['completion']:.2f}",
            point.get("state", ""),
            point.get("why", ""),
        )
    console.print(table)


@runs.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@folder_option
def report(run_folder: Path, folder: Path) -> None:
    """Write a run's report anew from its record, and print its path."""
    from cli.reports.run_report import write_report

    click.echo(write_report(located(run_folder, folder)))


def located(run_folder: Path, folder: Path) -> Path:
    """A run by its path, or by its name in the folder of runs.

    Raises:
        ConfigError: there is none of this name.
    """
    for path in (run_folder, folder / run_folder):
        if (path / "header.json").is_file():
            return path
    raise ConfigError(f"{run_folder}: no such run, here or in {folder}; `mill runs list` lists them")


def summary(run: "Run") -> dict[str, str | float]:
    """The line a person looks for. A run without a result was cut off: its events are whole up to then."""
    result = run.result or {}
    return {
        "rig": str(run.header.get("rig", "")),
        "outcome": str(result.get("outcome", "cut off")),
        "reason": str(result.get("reason", "the process ended before the run did; its events are kept")),
        "milling_time_s": float(result.get("milling_time_s", 0.0)),
    }
