"""`mill annotate`: a lab's own pictures labelled in the browser, compared, and exported for `mill dataset import`."""

import contextlib
from functools import partial
from pathlib import Path
from typing import Any

import click

from cli.options import json_option
from cli.output import columns, write_json
from cli.train import TASKS
from drivers.errors import ConfigError

WORST = 10
"""Differences that are listed one by one."""


@click.command()
@click.argument("album", metavar="DIR", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--annotator", "annotators", multiple=True, metavar="NAME", help="Who labels. [default: first]")
@click.option(
    "--task",
    "tasks",
    type=click.Choice(TASKS),
    multiple=True,
    help="What to ask of every picture, several times for several. [default: everything]",
)
@click.option(
    "--weights",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    multiple=True,
    metavar="FILE",
    help="Networks to suggest labels, in place of mill's own.",
)
@click.option("--compare", is_flag=True, help="Tell how far the annotators differ, and end.")
@click.option("--export", "exporting", is_flag=True, help="Write the tables for `mill dataset import`, and end.")
@json_option
def annotate(
    album: Path,
    annotators: tuple[str, ...],
    tasks: tuple[str, ...],
    weights: tuple[Path, ...],
    compare: bool,
    exporting: bool,
    json_file: Path | None,
) -> None:
    """Label the pictures in DIR/images in the browser: bregma, lambda, drill tip, completion along a ring.

    Prints a link for a browser on this computer; Ctrl-C ends it, and the next time goes on where it stopped. Every
    annotator has a file of their own, DIR/annotations/NAME.json. --export takes the labels of all of them, or of those
    named by --annotator.
    """
    if compare and exporting:
        raise click.UsageError("--compare and --export exclude each other; give one after the other")
    if json_file and not (compare or exporting):
        raise click.UsageError("--json goes with --compare or --export")
    if compare:
        _compare(album, annotators, json_file)
    elif exporting:
        _export(album, annotators, json_file)
    else:
        _serve(album, annotators, tasks or TASKS, weights)


def _serve(album: Path, annotators: tuple[str, ...], tasks: tuple[str, ...], weights: tuple[Path, ...]) -> None:
    from live.page import require_installed

    require_installed()
    if len(annotators) > 1:
        raise ConfigError(f"--annotator: {len(annotators)} given; one at a time labels")
    from annotate.desk import Desk
    from annotate.labels import Notebook
    from annotate.serve import serve
    from annotate.suggest import Suggester
    from vision.album import pictures_in

    pictures_in(album)
    suggester = Suggester(weights)
    with Notebook(album, annotators[0] if annotators else "first") as notebook:
        desk = Desk(album, notebook, tasks, suggester)
        done, total = desk.progress()
        click.echo(f"{album}: {done} of {total} pictures done by {notebook.annotator}")
        # Ctrl-C is how it is meant to end.
        with contextlib.suppress(KeyboardInterrupt):
            serve(desk, lambda address: click.echo(f"open {address}\nCtrl-C ends it; every label is saved at once."))
        done, total = desk.progress()
        click.echo(f"{notebook.file}: {done} of {total} pictures done; next: mill annotate {album} --export")


def _compare(album: Path, annotators: tuple[str, ...], json_file: Path | None) -> None:
    from annotate.compare import as_json, differences, summary
    from annotate.export import all_labels

    labels = all_labels(album, annotators)
    if len(labels) < 2:
        raise ConfigError(
            f"{album}: only {next(iter(labels))} has labelled; let another do so: mill annotate {album} "
            "--annotator NAME"
        )
    found = differences(labels)
    rows = summary(found)
    if not rows:
        raise ConfigError(f"{album}: {', '.join(labels)} have labelled no picture in common; go on with the same ones")
    # Where the results go to stdout, that is for machines alone.
    say = partial(click.echo, err=str(json_file) == "-")
    for line in columns(
        ["", "between", "n", "mean px", "worst", "mean mm", "worst", "along", "across", "one alone"],
        [_row(row) for row in rows],
    ):
        say(line)
    ranked = sorted((each for each in found if each.px is not None), key=lambda each: -(each.mm or each.px or 0.0))
    say("\nfarthest apart:")
    for each in ranked[:WORST]:
        mm = "" if each.mm is None else f" = {each.mm:.3f} mm"
        say(f"  {each.picture}: {each.what} {each.px:.1f} px{mm} ({' and '.join(each.between)})")
    if json_file:
        write_json(json_file, "annotate compare", seed=None, summary=rows, differences=as_json(found))


def _row(row: dict[str, Any]) -> list[str]:
    figures = [(row["mean_px"], 1), (row["worst_px"], 1), (row["mean_mm"], 3), (row["worst_mm"], 3)]
    figures += [(row["along_mean_mm"], 3), (row["across_mean_mm"], 3)]
    told = ["" if value is None else f"{value:.{places}f}" for value, places in figures]
    what = row["what"] if row["completion_mean"] is None else f"{row['what']}, completion {row['completion_mean']:.3f}"
    return [what, " and ".join(row["between"]), str(row["n"]), *told, str(row["one_alone"] or "")]


def _export(album: Path, annotators: tuple[str, ...], json_file: Path | None) -> None:
    from annotate.export import export

    done = export(album, annotators)
    for task, count in done.rows.items():
        click.echo(
            f"{task}: {count} pictures; next: mill dataset import {album} --task {task} --out SET",
            err=str(json_file) == "-",
        )
    for words in done.unsettled:
        click.echo(f"left out: {words}", err=True)
    if json_file:
        write_json(json_file, "annotate export", seed=None, rows=done.rows, unsettled=list(done.unsettled))
