"""`mill train` and `mill evaluate`."""

import math
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from cli.options import json_option
from cli.output import write_json

LOG_STEPS = 250
"""Where nobody watches a bar, a line is printed this often."""
TASKS = ("tip", "landmarks", "completion")

task_argument = click.argument("task", metavar="TASK", type=click.Choice(TASKS))
seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Draws everything.")


@click.command()
@task_argument
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Folder of the pictures: train, validation and test in it. What is missing is rendered, and kept. "
    "[default: a folder beside --out]",
)
@click.option("--recipe", type=click.Choice(["default"]), default="default", show_default=True)
@seed_option
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE", help="ONNX file."
)
def train(task: str, data: Path | None, recipe: str, seed: int, out: Path) -> None:
    """Train a network on rendered pictures, and write it with its hash and its held-out figures.

    TASK is tip, landmarks or completion.

    Training resumes where it was killed: from FILE.checkpoint, which is removed at the end.
    """
    from studies.datasets import SPLITS, ensure
    from vision.tasks import task_named
    from vision.training import finish, load_data
    from vision.training import train as fit

    out.parent.mkdir(parents=True, exist_ok=True)
    folder = data or out.with_suffix(".data")
    learned = task_named(task)
    settings = learned.recipes[recipe]
    console = Console(stderr=True)
    with _progress(console) as progress:
        for split in SPLITS:
            ensure(task, split, folder, seed=seed, progress=_counter(progress, f"{split} pictures"))
        bar = progress.add_task("training", total=settings.steps)
        checkpoint = out.with_name(out.name + ".checkpoint")

        def step(done: int, steps: int, loss: float) -> None:
            progress.update(bar, completed=done, total=steps, description=f"training, loss {loss:.3f}")
            if not console.is_terminal and done % LOG_STEPS == 0:
                console.print(f"step {done} of {steps}, loss {loss:.3f}")

        network = fit(learned, load_data(folder, "train"), settings, seed=seed, checkpoint=checkpoint, progress=step)
    about = {"task": task, "recipe": recipe, "seed": seed, "steps": settings.steps, "version": version("micromill")}
    figures = finish(learned, network, out, load_data(folder, "validation"), load_data(folder, "test"), about)
    checkpoint.unlink(missing_ok=True)
    console.print(_table(f"{out}, on held-out specimens and rigs", figures))


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
    from vision.runtime import WEIGHTS, Network
    from vision.tasks import task_named
    from vision.training import load_data

    if data and specimens:
        raise click.UsageError("--data and --specimens exclude each other; give one")
    network = Network(weights or WEIGHTS / f"{task}.onnx")
    learned = task_named(task)
    console = Console(stderr=True)
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        folder = data or Path(scratch)
        if data is None:
            with _progress(console) as progress:
                counter = _counter(progress, "pictures")
                ensure(task, "test", folder, seed=seed, specimens=specimens, progress=counter)
        figures = learned.judge(network, load_data(folder, "test"))
    console.print(_table(f"{network.path.name}, on held-out specimens and rigs", figures))
    if json_file:
        write_json(
            json_file,
            f"evaluate {task}",
            seed=seed,
            weights_sha256=network.sha256,
            duration_s=time.monotonic() - started_s,
            **{name: value if math.isfinite(value) else None for name, value in figures.items()},
        )


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )


def _counter(progress: Progress, what: str) -> Callable[[int, int], None]:
    """A bar from the first step on, as a function of how much is done and of how much."""
    bars: list[TaskID] = []

    def count(done: int, total: int) -> None:
        if not bars:
            bars.append(progress.add_task(what, total=total))
        progress.update(bars[0], completed=done)

    return count


def _table(title: str, figures: dict[str, float]) -> Table:
    table = Table("figure", "value", title=title)
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}")
    return table
