"""`mill train` and `mill evaluate`."""

import math
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from cli.bars import counter, progress_bars
from cli.options import json_option
from cli.output import write_json
from drivers.errors import ConfigError

LOG_STEPS = 250
"""Where nobody watches a bar, a line is printed this often."""
WORST = 12
"""Cases in the report."""
ENDS = ("low", "high")
TASKS = ("tip", "landmarks", "completion")

task_argument = click.argument("task", metavar="TASK", type=click.Choice(TASKS))
seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Draws everything.")


@click.command()
@task_argument
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="A data set, as `mill dataset` makes them, or an album of photographs with keypoints.csv or rings.csv. "
    "[default: pictures rendered into a folder beside --out]",
)
@click.option("--recipe", type=click.Choice(["default", "paper"]), default="default", show_default=True)
@seed_option
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE", help="ONNX file."
)
def train(task: str, data: Path | None, recipe: str, seed: int, out: Path) -> None:
    """Train a network on rendered pictures or on photographs; write it with its hash and its held-out figures.

    TASK is tip, landmarks or completion.

    Training resumes where it was killed: from FILE.checkpoint, which is removed at the end.
    """
    from cli.reports.model_card import write_model_card
    from cli.reports.train_report import write_train_report
    from studies.datasets import SPLITS, ensure, read_card
    from studies.photographs import ensure_in, holds_photographs
    from vision.runtime import Network, read_manifest
    from vision.samples import load_data
    from vision.tasks import task_named
    from vision.training import finish
    from vision.training import train as fit

    learned = task_named(task, recipe)
    settings = learned.recipes[recipe]
    if data and not holds_photographs(data) and not all((data / split).is_dir() for split in SPLITS):
        raise ConfigError(
            f"{data}: neither a data set (folders {', '.join(SPLITS)}) nor an album (keypoints.csv, rings.csv); make "
            "one with `mill dataset`, or leave --data out"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = data if data and not holds_photographs(data) else out.with_suffix(".data")
    console = Console(stderr=True)
    with progress_bars(console) as progress:
        if data is None:
            for split in SPLITS:
                ensure(task, split, folder, seed=seed, progress=counter(progress, f"{split} specimens"))
        elif folder != data:
            ensure_in(data, folder, task, progress=counter(progress, "photographs"))
        parts = {split: load_data(folder, split, task, learned.arrays) for split in SPLITS}
        steps = settings.steps_for(len(next(iter(parts["train"].values()))))
        bar = progress.add_task("training", total=steps)
        checkpoint = out.with_name(out.name + ".checkpoint")

        def step(done: int, steps: int, loss: float) -> None:
            progress.update(bar, completed=done, total=steps, description=f"training, loss {loss:.3f}")
            if not console.is_terminal and done % LOG_STEPS == 0:
                console.print(f"step {done} of {steps}, loss {loss:.3f}")

        network, history = fit(
            learned,
            parts["train"],
            parts["validation"],
            settings,
            seed=seed,
            checkpoint=checkpoint,
            progress=step,
        )
    trained = {"task": task, "recipe": recipe, "seed": seed, "steps": len(history.losses)}
    about = {**trained, "version": version("micromill"), "data": read_card(folder).get("splits", {})}
    figures = finish(learned, network, out, parts["validation"], parts["test"], about)
    checkpoint.unlink(missing_ok=True)
    told = read_manifest(out.parent)[out.name]
    console.print(_table(f"{out}, on the test pictures of {folder}", figures, told["held_out_95"]))
    worst = learned.worst(Network(out), parts["test"], WORST)
    write_train_report(out.with_suffix(".html"), f"{task} network", trained, figures, history, worst)
    console.print(f"report: {out.with_suffix('.html')}")
    card = out.with_suffix(".card.html")
    write_model_card(card, out.name, told)
    console.print(f"model card: {card}")


@click.command()
@task_argument
@click.option(
    "--data",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIR",
    help="Measure on the test pictures in this folder instead of fresh ones.",
)
@click.option(
    "--weights",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="FILE",
    help="ONNX file in place of mill's own.",
)
@click.option(
    "--specimens",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIR",
    help="Specimen files to render, in place of drawn ones.",
)
@seed_option
@json_option
def evaluate(
    task: str, data: Path | None, weights: Path | None, specimens: Path | None, seed: int, json_file: Path | None
) -> None:
    """Measure a network on specimens and rigs it never saw.

    TASK is tip, landmarks or completion.
    """
    import tempfile

    from studies.datasets import ensure
    from studies.photographs import bring_in, holds_photographs
    from vision.runtime import WEIGHTS, Network
    from vision.samples import load_data
    from vision.tasks import task_named
    from vision.training import judged

    if data and specimens:
        raise click.UsageError("--data and --specimens exclude each other; give one")
    network = Network(weights or WEIGHTS / f"{task}.onnx", task)
    learned = task_named(task)
    photographs = data is not None and holds_photographs(data)
    if data and photographs:
        _require_unseen(network.path, data, task)
    console = Console(stderr=True)
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "set" if data is None or photographs else data
        with progress_bars(console) as progress:
            if data and photographs:
                bring_in(data, folder, task, only="test", progress=counter(progress, "photographs"))
            if data is None:
                ensure(task, "test", folder, seed=seed, specimens=specimens, progress=counter(progress, "specimens"))
        figures, intervals = judged(learned, network, load_data(folder, "test", task, learned.arrays))
    title = f"{network.path.name}, on {data or 'specimens and rigs that training never saw'}"
    console.print(_table(title, figures, intervals))
    if json_file:
        write_json(
            json_file,
            f"evaluate {task}",
            seed=seed,
            weights_sha256=network.sha256,
            duration_s=time.monotonic() - started_s,
            **{name: value if math.isfinite(value) else None for name, value in figures.items()},
            **{
                f"{name}_{end}": value
                for name, both in intervals.items()
                for end, value in zip(ENDS, both, strict=True)
            },
        )


def _require_unseen(weights: Path, album: Path, task: str) -> None:
    """Weights are not measured on what they learnt from."""
    from studies.photographs import digest
    from vision.runtime import read_manifest

    learnt = read_manifest(weights.parent).get(weights.name, {}).get("data", {}).get("train", {})
    if learnt.get("table_sha256") == digest(album, task):
        raise ConfigError(
            f"{album}: {weights} learnt from these photographs; measure on others, or on those that were kept for "
            f"judging: --data {weights.with_suffix('.data')}"
        )


def _table(title: str, figures: dict[str, float], intervals: Mapping[str, Sequence[float]]) -> Table:
    table = Table("figure", "value", "95 %", title=title)
    for name, value in figures.items():
        between = " to ".join(f"{end:.3g}" for end in intervals.get(name, ()))
        table.add_row(name, f"{value:.4g}", between)
    return table
