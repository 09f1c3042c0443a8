"""Scenes of the virtual bench with their labels: what each network is shown, one specimen at a time."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from firmware_sim.machine import Machine
from firmware_sim.microscope import Microscope, Side
from firmware_sim.specimen import Specimen
from milling.eyes import mean_radius
from vision.completion_training import HIDDEN, KERF_FROM, LEVELS, STORED_PX
from vision.runtime import Image
from vision.strip import CELLS, Strip, unroll

Array = npt.NDArray[np.float64]
Sample = dict[str, npt.NDArray[np.generic]]

SIDES: tuple[Side, Side] = ("left", "right")
PARK_MM = (23.0, -10.0, 12.0)
BOX_MM = ((-1.0, -21.0, -0.5), (11.0, 1.0, 11.0))
"""The paper's validation box, and a little round it."""
POSES = 4
RINGS = 2
STAGES = 8
RING_POINTS = CELLS[1]
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
        kind = rng.choice(["none", "even", "late", "arc", "bridges"], p=[0.04, 0.44, 0.24, 0.08, 0.20])
        angles = np.arange(len(ring_mm)) * 2 * np.pi / len(ring_mm)
        waves = np.zeros(len(angles))
        for k in (1, 2, 3, 5, 8):
            waves += rng.normal(0.0, 1.0 / k) * np.cos(k * angles + rng.uniform(0, 2 * np.pi))
        level = rng.uniform(0.0, 1.05)
        share = {
            "none": np.zeros(len(angles)),
            "even": level + min(0.10, 0.03 + 0.3 * level) * rng.uniform(0.2, 1.0) * waves,
            "late": rng.uniform(0.75, 1.05) + rng.uniform(0.03, 0.12) * waves,
            "arc": np.where(
                np.cos(angles - rng.uniform(0, 2 * np.pi)) > rng.uniform(-0.8, 0.8), rng.uniform(0, 1.1), 0.0
            ),
            "bridges": _bridges(angles, rng) + 0.03 * waves,
        }[str(kind)]
        return self.carve(ring_mm, share)

    def carve(self, ring_mm: Array, share: Array) -> Array:
        """Cut so much of the thickness at each point, 60 um past it at most; return the completion there."""
        thickness_mm = self.thickness_mm(ring_mm)
        self.machine.carve(ring_mm, np.clip(share * thickness_mm, 0.0, thickness_mm + 0.06))
        return np.asarray(self.machine.completion_at(ring_mm, search_mm=0.06))

    def pour(self, xy_mm: Array) -> None:
        """What falls on a ring while it is milled: drops near it, and now and then a film of blood over everything."""
        rng = self._rng
        for _ in range(int(rng.integers(1, 7))):
            at = xy_mm[int(rng.integers(len(xy_mm)))] + rng.normal(0.0, 0.5, size=2)
            size_mm = float(np.exp(rng.normal(-1.2, 0.5)))
            self.microscope.pour(at, size_mm, "blood" if rng.random() < 0.3 else "saline")
        if rng.random() < 0.3:
            self.microscope.smear(float(rng.uniform(0.05, 0.5)))


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
            free = ~hides(bench.microscope.drill_mask(side), points)
            yield _keypoints(picture, points if there else np.full_like(points, np.nan), free & there)


def completion_samples(specimen: Specimen, rng: np.random.Generator) -> Iterator[Sample]:
    """A ring at several depths, with the drill in it, above it and away; the last ones wet or bloody as a rule."""
    bench = Scene(_weathered(specimen, rng), rng)
    ball_mm = specimen.tool.ball_radius_mm
    for ring in range(RINGS):
        bench.machine.restore_bone()
        bench.park()
        ring_mm, radius_mm = bench.ring()
        points_mm = np.column_stack([ring_mm, bench.outer_z(ring_mm)])
        rings_px = bench.microscope.project(points_mm)
        balls_px = [ball_mm * mean_radius(ring_px) / radius_mm * np.exp(rng.normal(0.0, 0.02)) for ring_px in rings_px]
        before = bench.pictures()
        for stage in range(STAGES):
            if ring == RINGS - 1 and stage == STAGES // 2 and rng.random() < 0.65:
                bench.pour(ring_mm)
            completion = bench.mill(ring_mm)
            _drill_somewhere(bench, points_mm, rng)
            now = bench.pictures()
            for eye, side in enumerate(SIDES):
                drill = bench.microscope.drill_mask(side)
                completion_map = np.nan_to_num(bench.microscope.completion_map_px(side))
                strip = unroll(rings_px[eye], balls_px[eye], across_px=STORED_PX)
                yield {
                    "strips": np.concatenate([strip.cut(now[eye]), strip.cut(before[eye])], axis=2),
                    "maps": _labels(strip, completion_map, drill),
                    "completions": completion,
                    "hidden": hides(drill, rings_px[eye]),
                    "rings_px": rings_px[eye],
                    "balls_px": np.asarray(balls_px[eye]),
                    "boxes_px": kerf_box(completion_map),
                }


def _weathered(specimen: Specimen, rng: np.random.Generator) -> Specimen:
    """Now and then as dusty, as clean, as wet or as dry as can be."""
    if rng.random() < 0.7:
        return specimen
    extreme = {"dust": float(rng.integers(2)), "wetness": float(rng.integers(2))}
    return specimen.model_copy(update={"appearance": specimen.appearance.model_copy(update=extreme)})


def _labels(strip: Strip, completion: npt.NDArray[np.float32], drill: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Completion along the strip in ``LEVELS``, and ``HIDDEN`` where the drill stands before it."""
    levels = np.round(LEVELS * strip.of_plane(completion))
    return np.where(strip.of_plane(drill.astype(np.float32)) > 0.5, HIDDEN, levels).astype(np.uint8)


def kerf_box(completion: npt.NDArray[np.float32]) -> Array:
    """(4,) x0, y0, x1, y1 of the kerf in a map of the picture, drill or not; NaN where there is none."""
    rows, columns = np.nonzero(completion > KERF_FROM)
    if len(rows) == 0:
        return np.full(4, np.nan)
    return np.array([columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5])


def _drill_somewhere(bench: Scene, points_mm: Array, rng: np.random.Generator) -> None:
    draw = rng.random()
    bench.machine.set_spindle(45_000.0)
    if draw < 0.4:
        bench.park()
        return
    at = points_mm[int(rng.integers(len(points_mm)))]
    lift_mm = rng.uniform(-0.35, 0.1) if draw < 0.85 else rng.uniform(0.1, 4.0)
    bench.machine.set_tip(at + np.array([0.0, 0.0, lift_mm]))


def _keypoints(picture: Image, points: Array, visible: npt.NDArray[np.bool_]) -> Sample:
    limit = np.array([picture.shape[1], picture.shape[0]]) - 1 - INSIDE_PX
    with np.errstate(invalid="ignore"):
        inside = np.all((points >= INSIDE_PX) & (points <= limit), axis=1)
    return {
        "pictures": picture,
        "points": np.where(inside[:, None], points, np.nan),
        "visible": visible & inside,
    }


def hides(mask: npt.NDArray[np.bool_], points: Array) -> npt.NDArray[np.bool_]:
    """Values of a mask at (n, 2) pixels; False outside the picture."""
    columns, rows = np.round(points).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < mask.shape[1]) & (rows < mask.shape[0])
    result = np.zeros(len(points), bool)
    result[inside] = mask[rows[inside], columns[inside]]
    return result
