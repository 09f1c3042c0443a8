"""Scenes of the virtual bench with their labels: what each network is shown, one specimen at a time."""

from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from firmware_sim.machine import Machine
from firmware_sim.microscope import Microscope, Side
from firmware_sim.specimen import Specimen
from vision.completion import crop_affine, cut, stacked
from vision.completion_training import STORED_PX, paint_labels
from vision.runtime import Image

Array = npt.NDArray[np.float64]
Sample = dict[str, npt.NDArray[np.generic]]

SIDES: tuple[Side, Side] = ("left", "right")
PARK_MM = (23.0, -10.0, 12.0)
BOX_MM = ((-1.0, -21.0, -0.5), (11.0, 1.0, 11.0))
"""The paper's validation box, and a little round it."""
POSES = 4
RINGS = 2
STAGES = 4
RING_POINTS = 64
INSIDE_PX = 4.0
"""A point nearer to the edge of the picture than this is not asked for."""


class Scene:
    """A world whose drill and bone are put where they are wanted."""

    def __init__(self, specimen: Specimen, rng: np.random.Generator) -> None:
        self.machine = Machine(specimen)
        self.microscope = Microscope(self.machine)
        self._rng = rng
        self._time_s = float(rng.uniform(0.0, 100.0))
        self.center_mm = np.array(specimen.skull.center_mm[:2])

    def pictures(self) -> tuple[Image, Image]:
        """A pair at another moment: other noise, the shaft turned."""
        self._time_s += float(self._rng.uniform(0.5, 5.0))
        self.machine.turns = float(self._rng.uniform(0.0, 1.0))
        return self.microscope.render(self._time_s)

    def park(self) -> None:
        """Drill out of both pictures."""
        self.machine.set_tip(PARK_MM)

    def outer_z(self, xy_mm: Array) -> Array:
        """Height of the unmilled surface."""
        skull = self.machine.skull
        return np.asarray(skull.grid.sample(skull.outer_z, xy_mm[:, 0], xy_mm[:, 1]))

    def thickness_mm(self, xy_mm: Array) -> Array:
        """Of the unmilled bone."""
        skull = self.machine.skull
        inner = skull.grid.sample(skull.inner_z, xy_mm[:, 0], xy_mm[:, 1])
        return np.asarray(self.outer_z(xy_mm) - inner)

    def ring(self) -> tuple[Array, float]:
        """A circle as milling uses it: radius 2 to 4 mm, its middle where the bone allows."""
        radius_mm = float(self._rng.uniform(2.0, 2.4) if self._rng.random() < 0.6 else self._rng.uniform(2.0, 4.0))
        angles = np.arange(RING_POINTS) * 2 * np.pi / RING_POINTS
        middle = self.center_mm + self._rng.uniform(-1.0, 1.0, size=2)
        return middle + radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1), radius_mm

    def mill(self, ring_mm: Array) -> Array:
        """Cut a kerf of uneven depth; return the completion at each point of the ring."""
        rng = self._rng
        self.machine.restore_bone()
        kind = rng.choice(["none", "even", "late", "arc", "bridges"], p=[0.06, 0.34, 0.30, 0.10, 0.20])
        angles = np.arange(len(ring_mm)) * 2 * np.pi / len(ring_mm)
        waves = sum(rng.normal(0.0, 1.0 / k) * np.cos(k * angles + rng.uniform(0, 2 * np.pi)) for k in (1, 2, 3, 5, 8))
        share = {
            "none": np.zeros(len(angles)),
            "even": rng.uniform(0.0, 1.05) + 0.10 * waves,
            "late": rng.uniform(0.75, 1.05) + rng.uniform(0.03, 0.12) * waves,
            "arc": np.where(
                np.cos(angles - rng.uniform(0, 2 * np.pi)) > rng.uniform(-0.8, 0.8), rng.uniform(0, 1.1), 0.0
            ),
            "bridges": _bridges(angles, rng) + 0.03 * waves,
        }[str(kind)]
        thickness_mm = self.thickness_mm(ring_mm)
        self.machine.carve(ring_mm, np.clip(share * thickness_mm, 0.0, thickness_mm + 0.06))
        return np.asarray(self.machine.completion_at(ring_mm, search_mm=0.06))


def _bridges(angles: Array, rng: np.random.Generator) -> Array:
    """How a run ends: through nearly all round, and some arcs of bone, thick or thin, between holes."""
    share = np.full(len(angles), 1.0 + rng.uniform(0.0, 0.15))
    for _ in range(int(rng.integers(1, 4))):
        away = np.abs((angles - rng.uniform(0, 2 * np.pi) + np.pi) % (2 * np.pi) - np.pi)
        solid = 1.0 / (1.0 + np.exp((away - rng.uniform(0.1, 0.9)) / rng.uniform(0.04, 0.25)))
        share -= solid * (share - rng.uniform(0.2, 0.97))
    return share


def tip_samples(specimen: Specimen, rng: np.random.Generator) -> Iterator[Sample]:
    """The drill in the box, near the skull, in a kerf, and out of the picture."""
    bench = Scene(specimen, rng)
    ring_mm, _ = bench.ring()
    for pose in range(POSES):
        if pose == 2:
            bench.mill(ring_mm)
        bench.machine.set_spindle(float(rng.choice([0.0, 45_000.0])))
        draw = rng.random()
        if draw < 0.6:
            bench.machine.set_tip(rng.uniform(*BOX_MM))
        elif draw < 0.92:
            at = ring_mm[int(rng.integers(len(ring_mm)))] + rng.normal(0.0, 0.5 if draw < 0.75 else 0.02, size=2)
            height = rng.uniform(0.0, 2.0) if draw < 0.75 else rng.uniform(-0.2, 0.2)
            bench.machine.set_tip(np.array([*at, bench.outer_z(at[None])[0] + height]))
        else:
            bench.park()
        places = bench.microscope.project(bench.machine.ball_center_mm[None])
        for picture, (place,) in zip(bench.pictures(), places, strict=True):
            yield _keypoints(picture, place[None], np.ones(1, bool))


def landmark_samples(specimen: Specimen, rng: np.random.Generator) -> Iterator[Sample]:
    """Bregma and lambda, mostly with the drill away; sometimes with a kerf round them."""
    bench = Scene(specimen, rng)
    skull = bench.machine.skull
    places = bench.microscope.project(np.stack([skull.bregma_mm, skull.lambda_mm]))
    there = specimen.kind == "mouse"
    for pose in range(2):
        if pose == 0 or rng.random() < 0.5:
            bench.park()
        else:
            bench.machine.set_tip(rng.uniform(*BOX_MM))
        if pose == 1 and rng.random() < 0.4:
            bench.mill(bench.ring()[0])
        pictures = bench.pictures()
        for side, picture, points in zip(SIDES, pictures, places, strict=True):
            free = ~_at(bench.microscope.drill_mask(side), points)
            yield _keypoints(picture, points if there else np.full_like(points, np.nan), free & there)


def completion_samples(specimen: Specimen, rng: np.random.Generator) -> Iterator[Sample]:
    """A ring at several depths, with the drill in it, above it and away."""
    bench = Scene(specimen, rng)
    for _ in range(RINGS):
        bench.machine.restore_bone()
        bench.park()
        ring_mm, _ = bench.ring()
        points_mm = np.column_stack([ring_mm, bench.outer_z(ring_mm)])
        rings_px = bench.microscope.project(points_mm)
        before = bench.pictures()
        for _ in range(STAGES):
            completion = bench.mill(ring_mm)
            _drill_somewhere(bench, points_mm, rng)
            now = bench.pictures()
            for eye, side in enumerate(SIDES):
                drill = bench.microscope.drill_mask(side)
                completion_map = bench.microscope.completion_map_px(side)
                yield _ring_sample(now[eye], before[eye], rings_px[eye], completion, completion_map, drill, rng)


def _drill_somewhere(bench: Scene, points_mm: Array, rng: np.random.Generator) -> None:
    draw = rng.random()
    bench.machine.set_spindle(45_000.0)
    if draw < 0.35:
        bench.park()
        return
    at = points_mm[int(rng.integers(len(points_mm)))]
    lift_mm = rng.uniform(-0.35, 0.1) if draw < 0.8 else rng.uniform(0.1, 4.0)
    bench.machine.set_tip(at + np.array([0.0, 0.0, lift_mm]))


def _ring_sample(
    now: Image,
    before: Image,
    ring_px: Array,
    completion: Array,
    completion_map: npt.NDArray[np.float32],
    drill: npt.NDArray[np.bool_],
    rng: np.random.Generator,
) -> Sample:
    middle = (ring_px.min(axis=0) + ring_px.max(axis=0)) / 2
    radius_px = float(np.hypot(*(ring_px - middle).T).mean() * np.exp(rng.normal(0.0, 0.02)))
    crop_from_image = crop_affine(ring_px, radius_px, side_px=STORED_PX)
    crop_ring_px = ring_px @ crop_from_image[:, :2].T + crop_from_image[:, 2]
    half = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25]])
    cells_from_image = half[:, :2] @ crop_from_image + np.array([[0, 0, half[0, 2]], [0, 0, half[1, 2]]])
    size = (STORED_PX // 2, STORED_PX // 2)
    cells = cv2.warpAffine(np.nan_to_num(completion_map), cells_from_image, size).astype(np.float32)
    hides = np.asarray(cv2.warpAffine(drill.astype(np.float32), cells_from_image, size) > 0.5)
    return {
        "crops": stacked(cut(now, crop_from_image, side_px=STORED_PX), cut(before, crop_from_image, side_px=STORED_PX)),
        "labels": paint_labels(crop_ring_px, completion, cells, hides),
        "rings_px": crop_ring_px,
        "completions": completion,
        "hidden": _at(drill, ring_px),
    }


def _keypoints(picture: Image, points: Array, visible: npt.NDArray[np.bool_]) -> Sample:
    limit = np.array([picture.shape[1], picture.shape[0]]) - 1 - INSIDE_PX
    with np.errstate(invalid="ignore"):
        inside = np.all((points >= INSIDE_PX) & (points <= limit), axis=1)
    return {
        "pictures": picture,
        "points": np.where(inside[:, None], points, np.nan),
        "visible": visible & inside,
    }


def _at(mask: npt.NDArray[np.bool_], points: Array) -> npt.NDArray[np.bool_]:
    """Values of a mask at (n, 2) pixels; False outside the picture."""
    columns, rows = np.round(points).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < mask.shape[1]) & (rows < mask.shape[0])
    result = np.zeros(len(points), bool)
    result[inside] = mask[rows[inside], columns[inside]]
    return result
