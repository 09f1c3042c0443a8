"""`mill experiment`: the paper's experiments on virtual rigs, recipes side by side."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from cli.bars import counter, progress_bars
from cli.options import fault_option, json_option
from cli.output import console_beside, write_json
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from milling.job import PolicyName
    from studies.tables import Table
    from studies.trials import World

out_option = click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Receives a file per trial, and a report; a study that was stopped goes on from there. [default: none]",
)
seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="The first of them.")
specimens_option = click.option(
    "--specimens",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIR",
    help="Specimen files, taken in turn: each overrides what a seed draws. [default: as drawn]",
)
count_option = click.option(
    "--specimens-count", "count", type=click.IntRange(1), metavar="N", help="How many. [default: 20, or one per file]"
)
workers_option = click.option(
    "--workers", type=click.IntRange(1), default=os.cpu_count() or 1, show_default=True, help="Processes."
)


@click.group()
def experiment() -> None:
    """Repeat the paper's experiments on virtual rigs that no network has seen. This is simulation, not tissue."""


@experiment.command()
@click.option("--rigs", type=click.IntRange(1), metavar="N", help="How many. [default: 20, or one per file]")
@seed_option
@specimens_option
@workers_option
@out_option
@json_option
def calibration(
    rigs: int | None, seed: int, specimens: Path | None, workers: int, out: Path | None, json_file: Path | None
) -> None:
    """Experiment 1: the landmark calibration's error over the paper's box, by recipe, on the same rigs."""
    from studies import calibration_trials as study
    from studies.trials import worlds

    chosen = worlds(rigs, seed, specimens)
    _study("calibration", study.calibrate_one, study.trials_of(chosen), study, chosen, workers, out, json_file)


@experiment.command()
@count_option
@seed_option
@specimens_option
@workers_option
@out_option
@json_option
def surface(
    count: int | None, seed: int, specimens: Path | None, workers: int, out: Path | None, json_file: Path | None
) -> None:
    """Experiment 2: landmarks, and the bone's height and normals at the ring, by recipe, on the same specimens."""
    from studies import surface_trials as study
    from studies.trials import worlds

    chosen = worlds(count, seed, specimens)
    _study("surface", study.reconstruct_one, study.trials_of(chosen), study, chosen, workers, out, json_file)


@experiment.command()
@count_option
@seed_option
@specimens_option
@click.option(
    "--paper-weights",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="FILE",
    help="What `mill train completion --recipe paper` made; read beside mill's own.",
)
@workers_option
@out_option
@json_option
def completion(
    count: int | None,
    seed: int,
    specimens: Path | None,
    paper_weights: Path | None,
    workers: int,
    out: Path | None,
    json_file: Path | None,
) -> None:
    """Completion, holes and the kerf's box through whole runs, clean and under shifts; and how fast they are read.

    The speed is measured on one core beside a network of the paper's kind, in the same run.
    """
    from benchmarks.completion_speed import measure
    from studies import completion_trials as study
    from studies.trials import worlds
    from vision.runtime import Network, read_manifest

    chosen = worlds(count, seed, specimens)
    stamp = {}
    if paper_weights:
        stamp = {"paper weights": Network(paper_weights, "completion").sha256}
        recipe = read_manifest(paper_weights.parent)[paper_weights.name].get("recipe")
        if recipe != "paper":
            raise ConfigError(
                f"--paper-weights {paper_weights}: were made by recipe {recipe!r}, 'paper' is needed; make them: "
                f"mill train completion --recipe paper --out FILE"
            )
    trials = study.trials_of(chosen, paper_weights)
    _study("completion", study.read_one, trials, study, chosen, workers, out, json_file, stamp=stamp, beside=measure)


@experiment.command()
@click.option(
    "--trials", type=click.IntRange(1), metavar="N", help="Mice for each policy. [default: 20, or one per file]"
)
@seed_option
@specimens_option
@click.option(
    "--policy",
    "policies",
    type=click.Choice(["default", "paper", "previous"]),
    multiple=True,
    help="How to go deeper; more may be given. [default: default]",
)
@click.option(
    "--statistical", is_flag=True, help="Draw what pictures show from measured errors; for thousands of mice."
)
@fault_option
@workers_option
@click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Run the trials on the workers of this Dask scheduler (tcp://HOST:8786) in place of processes here; records "
    "of the runs are not kept.",
)
@out_option
@json_option
def milling(
    trials: int | None,
    seed: int,
    specimens: Path | None,
    policies: tuple["PolicyName", ...],
    statistical: bool,
    faults: tuple[str, ...],
    workers: int,
    cluster: str | None,
    out: Path | None,
    json_file: Path | None,
) -> None:
    """Experiment 3: whole windows of virtual mice, by policy, on the same mice.

    With full pixels a mouse takes a minute or two of one core. Success is the paper's criterion: the flap can be
    lifted and the membrane was never touched; a run that holds is a failure.
    """
    from cli.emulate import sorted_faults
    from studies import milling_trials as study
    from studies.perception import FILE, donors
    from studies.trials import worlds

    planted = [str(fault) for group in sorted_faults(faults) for fault in group]
    chosen = worlds(trials, seed, specimens)
    asked = list(dict.fromkeys(policies or ("default",)))
    stamp = {"faults": " ".join(planted), "eyes": "full pixels"}
    if statistical:
        donors()
        stamp["eyes"] = f"statistical {sha256(FILE.read_bytes()).hexdigest()}"
    keep = None if statistical or cluster else out
    arguments = study.trials_of(chosen, asked, planted, statistical, keep)
    words = [*(["--statistical"] if statistical else []), *(f"--fault {fault}" for fault in planted)]
    if out:
        out.mkdir(parents=True, exist_ok=True)
    _study(
        "milling", study.mill_one, arguments, study, chosen, workers, out, json_file,
        stamp=stamp, asked=words, cluster=cluster,
    )  # fmt: skip


def _study(
    name: str,
    trial: Callable[..., dict[str, Any]],
    arguments: Mapping[str, tuple[Any, ...]],
    study: Any,
    chosen: "list[World]",
    workers: int,
    out: Path | None,
    json_file: Path | None,
    *,
    stamp: Mapping[str, str] | None = None,
    asked: Sequence[str] = (),
    beside: Callable[[], dict[str, float]] | None = None,
    cluster: str | None = None,
) -> None:
    """Run every trial of a study, and tell its figures by recipe, beside the paper's.

    Args:
        name: of the experiment.
        trial: runs one of its trials.
        arguments: of every trial, by its name.
        study: the module, with ``summary`` and ``PUBLISHED``.
        chosen: the worlds.
        workers: processes.
        out: receives the trials and the report; None keeps nothing.
        json_file: receives the figures.
        stamp: what else makes the figures.
        asked: options that the figures are of, as they are written.
        beside: measures more figures of the default recipe, once the trials are done.
        cluster: address of a Dask scheduler, in place of processes here.
    """
    from cli.reports.study_report import write_study_report
    from studies.tables import tables
    from studies.trials import run_trials

    with ExitStack() as stack:
        folder = out or Path(stack.enter_context(TemporaryDirectory()))
        with progress_bars() as bars:
            trials = run_trials(
                trial,
                arguments,
                folder,
                workers=workers,
                progress=counter(bars, name),
                stamp={**_stamp(chosen), **(stamp or {})},
                cluster=cluster,
            )
    recipes = study.summary(trials)
    if beside is not None:
        recipes["default"] |= beside()
    published: dict[str, float] = study.PUBLISHED
    console = console_beside(json_file)
    for table in tables(name, recipes, published):
        console.print(_shown(table))
    if json_file:
        write_json(
            json_file,
            f"experiment {name}",
            seed=chosen[0].seed,
            **recipes,
            recipes=list(recipes),
            asked=list(asked),
            published=published,
            trials=list(trials.values()),
        )
    if out:
        write_study_report(out / "report.html", name, recipes, published, trials)
        console.print(f"report: {out / 'report.html'}")


def _stamp(chosen: "list[World]") -> dict[str, str]:
    """What makes the figures: this version, its networks, and the specimen files."""
    from vision.runtime import TASKS, WEIGHTS, read_manifest

    files = sorted({world.file for world in chosen if world.file is not None})
    manifest = read_manifest(WEIGHTS)
    return {
        "micromill": version("micromill"),
        **{f"{task}.onnx": manifest[f"{task}.onnx"]["sha256"] for task in TASKS},
        **{file.name: sha256(file.read_bytes()).hexdigest() for file in files},
    }


def _shown(table: "Table") -> Any:
    from rich.table import Table as Shown

    shown = Shown(title=table.title)
    for heading in table.headings:
        shown.add_column(heading, overflow="fold")
    for row in table.rows:
        shown.add_row(*row)
    return shown
