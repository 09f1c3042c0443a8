"""An album of pictures of the virtual bench, whose labels are known: no photograph is needed to test with."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from firmware_sim.specimen import draw_specimen
from studies.scenes import Scene

RADIUS_MM = 2.0


@dataclass(frozen=True)
class Known:
    """Of one picture: the landmarks, and the ring that is milled."""

    name: str
    bregma: tuple[float, float]
    lambda_: tuple[float, float]
    ring: dict[str, float]
    completion: list[float]


def bench_album(folder: Path, count: int, *, first_seed: int = 41_000_000) -> list[Known]:
    """``count`` pictures of as many mice in ``folder/images``, each with a ring milled half way on one side."""
    (folder / "images").mkdir(parents=True)
    return [_drawn(folder, first_seed + k, f"mouse-{k + 1}") for k in range(count)]


def _drawn(folder: Path, seed: int, name: str) -> Known:
    scene = Scene(draw_specimen(seed), np.random.default_rng(seed))
    skull = scene.machine.skull
    scene.park()
    angles = np.arange(32) * 2 * np.pi / 32
    ring_mm = scene.center_mm + RADIUS_MM * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points_mm = np.column_stack([ring_mm, scene.outer_z(ring_mm)])
    ring_px = scene.microscope.project(points_mm)[0]
    _save(folder / "images" / f"{name}-before.png", scene.pictures()[0])
    share = scene.carve(ring_mm, 0.5 + 0.5 * np.cos(angles))
    _save(folder / "images" / f"{name}.png", scene.pictures()[0])
    bregma, lambda_ = scene.microscope.project(np.stack([skull.bregma_mm, skull.lambda_mm]))[0]
    middle = ring_px.mean(axis=0)
    radius = float(np.hypot(*(ring_px - middle).T).mean())
    ball = scene.machine.specimen.tool.ball_radius_mm * radius / RADIUS_MM
    ring = {"center_x_px": float(middle[0]), "center_y_px": float(middle[1]), "radius_px": radius, "ball_px": ball}
    # What was cut at the painted points' angles in the picture, which are not those on the bone.
    seen = np.arctan2(*(ring_px - middle).T[::-1])
    nearest = [int(np.argmin(np.abs(np.exp(1j * seen) - np.exp(1j * a)))) for a in angles]
    return Known(name + ".png", tuple(bregma), tuple(lambda_), ring, [float(share[k]) for k in nearest])


def _save(file: Path, picture: np.ndarray) -> None:
    cv2.imwrite(str(file), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
