"""`mill dataset`: labelled pictures from the virtual bench, from photographs and from a rig."""

import csv
from pathlib import Path

import click

from cli.bars import counter, progress_bars
from cli.options import BenchChoice, on_a_bench
from cli.train import TASKS, seed_option, task_argument

SPLITS = ("train", "validation", "test")

out_option = click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="Made if it is missing.",
)


@click.group()
def dataset() -> None:
    """Make data sets for `mill train` and `mill evaluate`.

    Each has a card, DIR/card.json, that says what is in it and where it comes from.
    """


@dataset.command()
@task_argument
@out_option
@seed_option
@click.option(
    "--specimens",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    metavar="DIR",
    help="Specimen files to render, in place of drawn ones; all become the test split.",
)
def render(task: str, out: Path, seed: int, specimens: Path | None) -> None:
    """Render labelled pictures of drawn specimens and rigs, which no two splits share.

    TASK is tip, landmarks or completion. A rendering that was interrupted goes on where it stopped.
    """
    from studies.datasets import ensure

    out.mkdir(parents=True, exist_ok=True)
    with progress_bars() as bars:
        for split in SPLITS if specimens is None else ("test",):
            ensure(task, split, out, seed=seed, specimens=specimens, progress=counter(bars, f"{split} specimens"))
    click.echo(f"{out}: {task}; the card is {out / 'card.json'}")


@dataset.command("import")
@click.argument("photographs", metavar="DIR", type=click.Path(path_type=Path, exists=True, file_okay=False))
@out_option
@click.option("--task", type=click.Choice(TASKS), help="Whose labels to take. [default: the first there are]")
@click.option(
    "--split",
    type=click.Choice(SPLITS),
    help="Put all of them there, as with photographs kept for judging. [default: blocks of consecutive numbers]",
)
def import_(photographs: Path, out: Path, task: str | None, split: str | None) -> None:
    """Read an album: DIR/images, and DIR/keypoints.csv or DIR/rings.csv, as `mill annotate` writes them.

    keypoints.csv has a row per picture: image,bregma_x_px,bregma_y_px,lambda_x_px,lambda_y_px and/or tip_x_px,tip_y_px,
    in px from the top left. A point that is not to be seen is left empty; "?" is one that nobody has looked for.
    rings.csv has a row per ring: image,center_x_px,center_y_px,radius_px,ball_px,reference,completion (0 to 1 at each
    point, "?" where unknown). The photographs themselves stay as they are.
    """
    from studies.photographs import bring_in

    with progress_bars() as bars:
        taken, counts = bring_in(photographs, out, task, only=split, progress=counter(bars, "photographs"))
    parts = ", ".join(f"{name} {count}" for name, count in counts.items())
    click.echo(f"{out}: {taken}; {parts}")


@dataset.command()
@on_a_bench
@out_option
@click.option("--pairs", type=click.IntRange(1), default=20, show_default=True, help="How many to take.")
@click.option("--every", "every_s", type=click.FloatRange(0.0), default=1.0, show_default=True, help="Seconds between.")
def collect(chosen: BenchChoice, out: Path, pairs: int, every_s: float) -> None:
    """Take pictures from a rig, with where the tip was and what the spindle did. Nothing is moved.

    DIR/images receives left and right of each pair, DIR/state.csv a row for each.
    """
    import cv2

    from cli.rig import rig_for
    from drivers.errors import ConfigError

    table = out / "state.csv"
    if table.exists():
        raise ConfigError(f"{table}: is there already; name another folder, or remove it")
    images = out / "images"
    images.mkdir(parents=True, exist_ok=True)
    with (
        rig_for(chosen) as bench,
        bench.open_camera() as camera,
        bench.open_motion() as motion,
        bench.open_spindle() as spindle,
        table.open("w", newline="", encoding="utf-8") as file,
        progress_bars() as bars,
    ):
        rows = csv.writer(file)
        rows.writerow(
            ["left", "right", "exposed_at_s", "x_mm", "y_mm", "z_mm", "state", "speed_rpm", "torque_fraction"]
        )
        count = counter(bars, "pairs")
        for index in range(pairs):
            if index:
                bench.clock.sleep_s(every_s)
            frame, status, turning = camera.capture(), motion.status(), spindle.status()
            names = [f"{index:05d}-{side}.png" for side in ("left", "right")]
            for name, picture in zip(names, (frame.left, frame.right), strict=True):
                if not cv2.imwrite(str(images / name), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)):
                    raise ConfigError(f"{images / name}: cannot be written; make room there, or name another --out")
            place = [f"{value:.4f}" for value in status.position_mm]
            figures = [f"{turning.speed_rpm:.0f}", f"{turning.torque_fraction:.4f}"]
            rows.writerow([*names, f"{frame.exposed_at_s:.6f}", *place, status.state.value, *figures])
            file.flush()
            count(index + 1, pairs)
    click.echo(f"{out}: {pairs} pairs; {table}")
