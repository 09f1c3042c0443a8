"""`mill runs`: the records of past runs."""

from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cli.options import json_option
from cli.output import columns, write_json
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from milling.labels import Label
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
    """List, show, report, label, compare, export, verify and replay recorded runs."""


@runs.command("list")
@folder_option
@json_option
def list_runs(folder: Path, json_file: Path | None) -> None:
    """List the runs in the folder, the newest last."""
    from milling.labels import newest, read_labels
    from milling.record import read_run

    rows: list[dict[str, Any]] = []
    for path in recorded(folder):
        try:
            run, labels = read_run(path), newest(read_labels(path))
        except ConfigError as error:
            rows.append({"run": path.name, "outcome": "damaged", "reason": str(error)})
        else:
            found = {name: label.value for name, label in labels.items()}
            rows.append({"run": path.name, **summary(run), "labels": found})
    if json_file:
        write_json(json_file, "runs list", seed=None, runs=rows)
        if str(json_file) == "-":
            return
    if not rows:
        click.echo(f"{folder}: no runs yet; `mill run --emulate` makes one")
        return
    titles = ("run", "specimen", "protocol", "operator", "outcome", "milling", "labels", "reason")
    for line in columns(titles, [_listed(row) for row in rows]):
        click.echo(line)


def _listed(row: Mapping[str, Any]) -> tuple[str, ...]:
    study = [str(row.get(name) or "") for name in ("specimen_id", "protocol", "operator")]
    labels = ", ".join(f"{name}={value}" for name, value in row.get("labels", {}).items())
    return (str(row["run"]), *study, str(row["outcome"]), _seconds(row), labels, str(row["reason"]))


@runs.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@folder_option
@json_option
def show(run_folder: Path, folder: Path, json_file: Path | None) -> None:
    """Show one run: what it was, how it ended, and every point of its ring."""
    from milling.labels import newest, read_labels
    from milling.record import read_run

    run = read_run(located(run_folder, folder))
    labels = read_labels(run.folder)
    facts = summary(run)
    points = [] if run.result is None else run.result["points"]
    chain = None if run.chain is None else asdict(run.chain)
    if json_file:
        told = {"points": points, "damage": run.damage, "chain": chain, "labels": [asdict(label) for label in labels]}
        write_json(json_file, "runs show", seed=None, header=run.header, **facts, **told)
        if str(json_file) == "-":
            return
    lines = {
        "specimen": facts["specimen_id"],
        "protocol": facts["protocol"],
        "operator": facts["operator"],
        "rig": facts["rig"],
        "date": run.header.get("date"),
        "outcome": facts["outcome"],
        "reason": facts["reason"],
        "milling": _seconds(facts),
        "damage": run.damage or "none",
        "events": None if run.chain is None else f"{run.chain.lines}, head {run.chain.head}",
        "labels": "; ".join(_labelled(label) for label in newest(labels).values()),
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
@click.argument("labels", nargs=-1, required=True, metavar="NAME=VALUE...")
@click.option("--by", metavar="ID", help="Who found it. [default: login name]")
@folder_option
def label(run_folder: Path, labels: tuple[str, ...], by: str | None, folder: Path) -> None:
    """Add what was found out afterwards: membrane=intact|torn, flap=free|attached, histology="...".

    Other names are yours. A label is dated and signed and never changed; the newest of a name counts, and NAME= takes
    it back. The record itself stays as it is.
    """
    from getpass import getuser

    from cli.config import study_word
    from milling.labels import add_labels, newest, read_labels

    path = located(run_folder, folder)
    found = {}
    for words in labels:
        name, equals, value = words.partition("=")
        if not equals:
            raise click.UsageError(f"found {words!r}, NAME=VALUE is needed, such as membrane=intact")
        found[name] = value
    try:
        signed = study_word(getuser() if by is None else by)
    except ValueError as error:
        raise click.UsageError(f"--by: found {by!r}, {error}") from error
    add_labels(path, found, by=signed, date=datetime.now(UTC).isoformat(timespec="seconds"))
    for each in newest(read_labels(path)).values():
        click.echo(f"{path.name}: {_labelled(each)}")


@runs.command()
@click.argument("run_folders", metavar="[RUN]...", nargs=-1, type=click.Path(path_type=Path))
@folder_option
@json_option
def verify(run_folders: tuple[Path, ...], folder: Path, json_file: Path | None) -> None:
    """Tell whether records are what was written: events, header, result, pictures, labels.

    Without RUN, all of the folder. Exit code 1 unless every one is whole. docs/records.md says what this can and
    cannot tell.
    """
    from milling.verification import WHOLE, verify

    verdicts = {path: verify(path) for path in _chosen(run_folders, folder)}
    if json_file:
        write_json(
            json_file,
            "runs verify",
            seed=None,
            runs=[{"run": path.name, **asdict(each)} for path, each in verdicts.items()],
        )
    if str(json_file) != "-":
        rows = []
        for path, verdict in verdicts.items():
            lines, head = ("", "") if verdict.chain is None else (str(verdict.chain.lines), verdict.chain.head)
            rows.append((path.name, verdict.state, lines, str(verdict.files), head, "; ".join(verdict.reasons)))
        for line in columns(("run", "record", "events", "files", "head", "why"), rows):
            click.echo(line)
    if any(verdict.state != WHOLE for verdict in verdicts.values()):
        raise SystemExit(1)


@runs.command()
@click.argument("run_folders", metavar="[RUN]...", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--csv", "csv_file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="One row a run, for statistics; - for stdout. Without RUN, of all runs in the folder.",
)  # fmt: skip
@click.option("--points", is_flag=True, help="With --csv: one row a point of the ring in place of one a run.")
@click.option(
    "--mcap", "mcap_file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="One run for Foxglove. Needs micromill[foxglove].",
)  # fmt: skip
@click.option(
    "--rerun", "rerun_file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="One run as a Rerun recording, FILE.rrd. Needs micromill[rerun].",
)  # fmt: skip
@folder_option
def export(
    run_folders: tuple[Path, ...],
    csv_file: Path | None,
    points: bool,
    mcap_file: Path | None,
    rerun_file: Path | None,
    folder: Path,
) -> None:
    """Write runs for other programs.

    --csv writes ids, outcome, times, labels, versions, weights and job (docs/records.md); --mcap and --rerun write
    pictures, path, surface, figures and reasons on one clock (docs/viewers.md).
    """
    if csv_file is None and mcap_file is None and rerun_file is None:
        raise ConfigError("nothing to write: give --csv FILE, --mcap FILE or --rerun FILE")
    if points and csv_file is None:
        raise ConfigError("--points belongs to --csv FILE")
    if csv_file is not None:
        from cli.export import export_runs

        export_runs(_chosen(run_folders, folder), csv_file, points=points)
    if mcap_file is None and rerun_file is None:
        return
    if len(run_folders) != 1:
        raise ConfigError(f"{len(run_folders)} runs for --mcap or --rerun, which take one; name it: mill runs list")
    from cli import record_export

    record_export.export(located(run_folders[0], folder), mcap_file, rerun_file)


@runs.command()
@click.argument("run_a", metavar="A", type=click.Path(path_type=Path))
@click.argument("run_b", metavar="B", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="HTML file to write. [default: compare-A-B.html]",
)
@folder_option
@json_option
def compare(run_a: Path, run_b: Path, out: Path | None, folder: Path, json_file: Path | None) -> None:
    """Lay two runs beside each other: what differs, how each point went, what was decided."""
    from cli.compare import compare_runs

    compare_runs(located(run_a, folder), located(run_b, folder), out, json_file)


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


def recorded(folder: Path) -> list[Path]:
    """The folders of all runs in the folder, the newest last."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if (path / "header.json").is_file())


def _chosen(run_folders: tuple[Path, ...], folder: Path) -> list[Path]:
    """Those that were named, or all.

    Raises:
        ConfigError: there are none.
    """
    found = [located(each, folder) for each in run_folders] or recorded(folder)
    if not found:
        raise ConfigError(f"{folder}: no runs there; name one, or another --runs folder")
    return found


def summary(run: "Run") -> dict[str, str | float | None]:
    """The line a person looks for. A run without a result was cut off: its events are whole up to then."""
    from cli.study import IDS, study_told

    result, study = run.result or {}, study_told(run)
    return {
        **{name: study.get(name) for name in IDS},
        "rig": str(run.header.get("rig", "")),
        "outcome": str(result.get("outcome", "cut off")),
        "reason": str(result.get("reason", "the process ended before the run did; its events are kept")),
        "milling_time_s": result.get("milling_time_s"),
    }


def _seconds(facts: Mapping[str, str | float | None]) -> str:
    """The milling time; nothing where a run did not live to tell it."""
    time_s = facts.get("milling_time_s")
    return "" if time_s is None else f"{float(time_s):.0f} s"


def _labelled(label: "Label") -> str:
    return f"{label.name}={label.value} ({label.by}, {label.date[:10]})"
