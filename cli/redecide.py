"""`mill runs replay`: a recorded run, decided once more."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cli.output import columns, write_json
from drivers.errors import ConfigError, DetectionError

if TYPE_CHECKING:
    from milling.job import Job
    from milling.record import Run
    from milling.replay import Replay, Reread

SHOWN = 12
"""Differences that are listed; all of them are in the JSON."""


def decide_again(path: Path, weights: Path | None, policy: str | None, json_file: Path | None) -> None:
    """Replay, and tell.

    Raises:
        ConfigError: the record cannot be replayed, or the weights do not fit.
    """
    from milling.job import Job
    from milling.planner import policy_for
    from milling.record import read_run
    from milling.replay import replay

    run = read_run(path)
    job = Job.of_record(run.header, run.folder)
    if job.policy != "default":
        raise ConfigError(f"{path}: ran with policy {job.policy!r}, which asked nobody; only default can be replayed")
    other = None if policy is None else policy_for(replace(job, policy=policy))  # type: ignore[arg-type]
    result = replay(
        run,
        job,
        _pitch_mm(run, job.n_points),
        policy=other,
        reread=None if weights is None else _reader(run, job, weights),
    )
    if weights is not None and result.without_picture == result.readings:
        raise ConfigError(f"{path}: kept no pictures of the ring; run with --picture-every 0 to replay other weights")
    if json_file:
        told = asdict(result)
        write_json(json_file, "runs replay", seed=None, run=str(path), weights=_name(weights), policy=policy, **told)
        if str(json_file) == "-":
            return
    _show(result, weights)


def _show(result: "Replay", weights: Path | None) -> None:
    if weights is not None:
        click.echo(
            f"pictures  {result.readings - result.without_picture} of {result.readings} readings, as JPEG; the "
            "others are left out of both decisions"
        )
    parted = len(result.differences)
    click.echo(f"decisions  {result.asked}, otherwise at {parted} visits")
    if not parted:
        return
    first = result.differences[0]
    click.echo(
        f"first      {first.t:.2f} s, point {first.point}: {_decision(first.recorded_mm, first.recorded_why)} then, "
        f"{_decision(first.now_mm, first.now_why)} now"
    )
    click.echo()
    rows = [
        (
            f"{each.t:.2f}",
            str(each.point),
            "" if each.recorded_why else f"{each.recorded_mm:.3f}",
            "" if each.now_why else f"{each.now_mm:.3f}",
            each.recorded_why or each.now_why,
        )
        for each in result.differences[:SHOWN]
    ]
    for line in columns(("t, s", "point", "then, mm", "now, mm", "why no deeper"), rows):
        click.echo(line)
    if parted > SHOWN:
        click.echo(f"... and {parted - SHOWN} more; --json FILE holds all")


def _decision(depth_mm: float, why: str) -> str:
    return f"down to {depth_mm:.3f} mm" if not why else f"no deeper ({why})"


def _name(file: Path | None) -> str | None:
    return None if file is None else str(file)


def _pitch_mm(run: "Run", n_points: int) -> float:
    """From point to point along the milled ring, as the run took it."""
    from math import pi

    import numpy as np

    from milling.trajectory import closed_path

    told = next(run.of_kind("trajectory"), None)
    if told is None:
        raise ConfigError(f"{run.folder}: ended before its trajectory was planned; nothing was decided")
    theta = 2 * pi * np.arange(1, n_points + 1) / n_points
    return float(closed_path(theta, np.array(told["tip_mm"])[:, :2]).x[-1]) / n_points


def _reader(run: "Run", job: "Job", weights: Path) -> "Reread":
    """Reads the record's pictures with other weights."""
    import cv2
    import numpy as np

    from milling.eyes import mean_radius
    from vision.completion import CompletionReader

    ring = next(run.of_kind("ring"), None)
    reference = next((event for event in run.of_kind("frame") if event["name"] == "reference_left"), None)
    if ring is None or reference is None:
        raise ConfigError(f"{run.folder}: ended before its ring was seen; nothing was decided")

    def picture(file: str) -> Any:
        image = cv2.imread(str(run.folder / file))
        return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    ring_px = np.array(ring["ring_px"])
    ball_px = job.ball_radius_mm * float(ring["radius_px"]) / mean_radius(np.array(ring["ring_mm"]))
    unmilled = picture(reference["file"])
    if unmilled is None:
        raise ConfigError(f"{run.folder}/{reference['file']}: cannot be read; restore it from a copy")
    reader = CompletionReader.load(weights).over(ring_px, ball_px, reference=unmilled)

    def reread(file: str) -> dict[str, Any] | None:
        image = picture(file)
        if image is None:
            return None
        try:
            reading = reader.read(image)
        except DetectionError:
            return None
        return {"completion": reading.completion.tolist(), "upper": reading.upper.tolist()}

    return reread
