"""`mill experiment`: the paper's experiments on virtual rigs, recipes side by side."""

import os
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click

from cli.bars import counter, progress_bars
from cli.options import json_option
from cli.output import console_beside, write_json

out_option = click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="Receives a file per trial. A study that was stopped goes on from there.",
)
seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="The first of them.")
workers_option = click.option(
    "--workers", type=click.IntRange(1), default=os.cpu_count() or 1, show_default=True, help="Processes."
)


@click.group()
def experiment() -> None:
    """Repeat the paper's experiments on virtual rigs that no network has seen. This is simulation, not tissue."""


@experiment.command()
@click.option("--rigs", type=click.IntRange(1), default=20, show_default=True, help="How many.")
@seed_option
@workers_option
@out_option
@json_option
def calibration(rigs: int, seed: int, workers: int, out: Path, json_file: Path | None) -> None:
    """Experiment 1: the landmark calibration's error over the paper's box, by recipe, on the same rigs."""
    from studies.calibration_trials import calibrate_one, summary, trials_of

    _study("calibration", calibrate_one, trials_of(rigs, seed), summary, seed, workers, out, json_file)


@experiment.command()
@click.option("--specimens", type=click.IntRange(1), default=20, show_default=True, help="How many.")
@seed_option
@workers_option
@out_option
@json_option
def surface(specimens: int, seed: int, workers: int, out: Path, json_file: Path | None) -> None:
    """Experiment 2: height and normals of the reconstructed bone at the ring, by recipe, on the same specimens."""
    from studies.surface_trials import reconstruct_one, summary, trials_of

    _study("surface", reconstruct_one, trials_of(specimens, seed), summary, seed, workers, out, json_file)


def _study(
    name: str,
    trial: Callable[..., dict[str, Any]],
    arguments: Mapping[str, tuple[Any, ...]],
    summary: Callable[[Mapping[str, dict[str, Any]]], dict[str, dict[str, Any]]],
    seed: int,
    workers: int,
    out: Path,
    json_file: Path | None,
) -> None:
    from rich.table import Table

    from studies.trials import run_trials
    from vision.runtime import WEIGHTS, read_manifest

    stamp = {"micromill": version("micromill"), "tip.onnx": read_manifest(WEIGHTS)["tip.onnx"]["sha256"]}
    with progress_bars() as bars:
        counted = counter(bars, name)
        trials = run_trials(trial, arguments, out, workers=workers, progress=counted, stamp=stamp)
    recipes = summary(trials)
    table = Table(title=f"{name}, on the virtual bench; RMSE over the trials that succeeded")
    for heading in ("figure", *recipes):
        table.add_column(heading, overflow="fold")
    for figure in dict.fromkeys(figure for figures in recipes.values() for figure in figures):
        if not figure.endswith(("_low", "_high")):
            table.add_row(figure, *(_with_interval(figures, figure) for figures in recipes.values()))
    console_beside(json_file).print(table)
    if json_file:
        write_json(json_file, f"experiment {name}", seed=seed, recipes=recipes, trials=list(trials.values()))


def _with_interval(figures: Mapping[str, Any], name: str) -> str:
    if name not in figures:
        return "-"
    value = f"{figures[name]:.4g}"
    return (
        f"{value} ({figures[f'{name}_low']:.4g} to {figures[f'{name}_high']:.4g})"
        if f"{name}_low" in figures
        else value
    )
