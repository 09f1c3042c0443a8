"""Both pictures of the toed-in microscope, and the truth about them for labels and scoring.

What changes slowly is kept: each eye's scene without the drill is shaded once, and again only where bone was cut.
A picture is that scene, the drill and its shadow over it, and the sensor's noise of that moment.
The same specimen, the same history and the same time give the same picture.

Left out: rolling shutter, motion blur of a moving stage (a 5 mm/s feed moves 1-2 px in a 10 ms exposure), depth of
field that hides behind the drill's rim, interreflection, and water that flows.
"""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal

import cv2
import numpy as np
import numpy.typing as npt

from firmware_sim.appearance import Liquid, draw_look, pour, smear
from firmware_sim.drill_picture import draw_drill, paint_drill, picture_box
from firmware_sim.machine import Machine
from firmware_sim.optics import HEIGHT_PX, WIDTH_PX, Eye, draw_eyes
from firmware_sim.shading import completion_map, develop, expose, find_ground, shade
from firmware_sim.skull import Array, Field
from firmware_sim.specimen import Specimen

Image = npt.NDArray[np.uint8]
Box = tuple[int, int, int, int]
Side = Literal["left", "right"]
EachEye = Callable[[Callable[[int], Image], tuple[int, int]], Iterable[Image]]

FOCUS_DEPTH_MM: Final = -2.5
SCENE_BLUR_PX_PER_MM: Final = 0.14
DRILL_BLUR_PX_PER_MM: Final = 0.22
BLUR_KINDS: Final = 16
DUST_CELLS: Final = 8
DUST_REACH: Final = 4
NOISE_SIZE: Final = 1 << 20
FLUTES_BLUR_ABOVE_RPM: Final = 1500.0


@dataclass(frozen=True)
class Labels:
    """Where things are: (2,) pixels in the left and in the right picture, and whether each picture shows them."""

    ball_px: tuple[Array, Array]
    bregma_px: tuple[Array, Array]
    lambda_px: tuple[Array, Array]
    ball_visible: tuple[bool, bool]
    bregma_visible: tuple[bool, bool]
    lambda_visible: tuple[bool, bool]


@dataclass(frozen=True)
class Shot:
    """Both pictures as a host gets them, and how much longer than usual each was on its way."""

    left: Image
    right: Image
    left_late_s: float = 0.0
    right_late_s: float = 0.0


@dataclass(frozen=True)
class _Spill:
    """A drop that falls while the bone is milled."""

    after_s: float
    x_mm: float
    y_mm: float
    radius_mm: float
    liquid: Liquid


class _View:
    """One eye's own store of what does not change."""

    def __init__(self, eye: Eye) -> None:
        self.eye = eye
        shape = (HEIGHT_PX, WIDTH_PX)
        self.hit: Field = np.empty((*shape, 4), np.float32)
        self.opening: Field = np.empty(shape, np.float32)
        self.blur = np.empty(shape, np.uint8)
        self.linear: Field = np.empty((*shape, 3), np.float32)
        self.display: Field = np.empty((*shape, 3), np.float32)


class Microscope:
    """Two cameras over a ``Machine``. One thread renders at a time; the machine may go on meanwhile."""

    def __init__(self, machine: Machine) -> None:
        """Look at what ``machine`` holds, through the optics of its specimen's rig."""
        self.machine = machine
        specimen = machine.specimen
        self.look = draw_look(specimen, machine.skull)
        self.drill = draw_drill(specimen)
        self._busy = threading.Lock()
        self._changed = machine.watch()
        self._changed.take()
        self._top: Field = machine.skull.outer_z.copy()
        grid = machine.skull.grid
        self._dust: Field = np.zeros((grid.rows // DUST_CELLS + 1, grid.columns // DUST_CELLS + 1), np.float32)
        self._noise = np.random.default_rng([specimen.rig.seed & 0x7FFFFFFF, 13]).standard_normal(
            NOISE_SIZE, np.float32
        )
        look = self.look
        self._colours = np.stack([look.light_rgb, look.dust_rgb, look.mu_per_mm])
        self._numbers = np.array([look.ambient, look.wetness, look.dust, look.gain, look.vignetting])
        self._weights = _blur_weights()
        self._spills = _draw_spills(specimen)
        self._views = tuple(_View(eye) for eye in draw_eyes(specimen.rig))
        for view in self._views:
            self._build(view)
        with machine.lock:
            self._changed.add(*_cut_box(machine.skull.outer_z, machine.skull.top_z))

    @property
    def eyes(self) -> tuple[Eye, Eye]:
        """Left and right optics."""
        return self._views[0].eye, self._views[1].eye

    def render(self, time_s: float, *, each: EachEye = map) -> tuple[Image, Image]:
        """Left and right picture, (540, 960, 3) uint8 RGB, of the world as it is now, with the noise of ``time_s``.

        ``each`` calls a function for either eye: ``map``, or a thread pool's, for the loops hold no interpreter.
        """
        with self._busy:
            ball, turned, rpm = self._update()
            frame = round(time_s * 1e5)

            def picture(side: int) -> Image:
                return self._picture(self._views[side], ball, turned, rpm, frame * 2 + side)

            left, right = each(picture, (0, 1))
            return left, right

    def pour(self, xy_mm: npt.ArrayLike, radius_mm: float, liquid: Liquid) -> None:
        """Let a drop of blood or saline fall at (x, y) of {R}; it stays."""
        x, y = np.asarray(xy_mm, float)[:2]
        with self._busy:
            self._pour(float(x), float(y), radius_mm, liquid)

    def smear(self, cover: float) -> None:
        """Let an uneven film of blood run over all bone; ``cover`` is its mean share of the colour. It stays."""
        with self._busy:
            smear(self.look, cover)
            for view in self._views:
                self._shade(view, (0, HEIGHT_PX, 0, WIDTH_PX))

    def project(self, points_mm: npt.ArrayLike) -> tuple[Array, Array]:
        """True pixels (n, 2) of points (n, 3) of {R} in the left and the right picture."""
        left, right = (view.eye.project(points_mm) for view in self._views)
        return left, right

    def labels(self) -> Labels:
        """True places of the ball's centre, bregma and lambda now."""
        with self._busy:
            ball, _, _ = self._update()
        skull = self.machine.skull
        points = np.stack([ball, skull.bregma_mm, skull.lambda_mm])
        pixels = self.project(points)
        marked = self.machine.specimen.kind == "mouse"
        masks = [self.drill_mask(side) for side in ("left", "right")]
        seen = [
            [_inside(p) and (n == 0 or (marked and not mask[round(p[1]), round(p[0])])) for n, p in enumerate(side)]
            for side, mask in zip(pixels, masks, strict=True)
        ]
        return Labels(
            ball_px=(pixels[0][0], pixels[1][0]),
            bregma_px=(pixels[0][1], pixels[1][1]),
            lambda_px=(pixels[0][2], pixels[1][2]),
            ball_visible=(seen[0][0], seen[1][0]),
            bregma_visible=(seen[0][1], seen[1][1]),
            lambda_visible=(seen[0][2], seen[1][2]),
        )

    def drill_mask(self, eye: Side = "left") -> npt.NDArray[np.bool_]:
        """Pixels (540, 960) that show the drill."""
        view = self._view(eye)
        mask = np.zeros((HEIGHT_PX, WIDTH_PX), bool)
        with self._busy:
            ball, turned, rpm = self._update()
            box, _, cover = self._composite(view, ball, turned, rpm)
            mask[box[0] : box[1], box[2] : box[3]] = cover > 0.5
        return mask

    def completion_map_px(self, eye: Side = "left") -> Field:
        """True completion (540, 960) of the bone that each pixel sees, as if the drill were away; NaN without bone."""
        view = self._view(eye)
        skull = self.machine.skull
        out: Field = np.empty((HEIGHT_PX, WIDTH_PX), np.float32)
        with self._busy:
            self._update()
            grid = skull.grid
            completion_map(
                view.eye.values, view.hit, view.opening, skull.outer_z, self._top, skull.inner_z, skull.membrane_z,
                grid.x0_mm, grid.y0_mm, grid.step_mm, out,
            )  # fmt: skip
        return out

    def _view(self, eye: Side) -> _View:
        return self._views[0 if eye == "left" else 1]

    def _build(self, view: _View) -> None:
        look = self.look
        scene = look.scene_grid
        find_ground(view.eye.values, look.ground_z, scene.x0_mm, scene.y0_mm, scene.step_mm, view.hit)
        rows = ((view.hit[..., 0] - scene.x0_mm) / scene.step_mm).astype(np.float32)
        columns = ((view.hit[..., 1] - scene.y0_mm) / scene.step_mm).astype(np.float32)
        view.opening[:] = cv2.remap(look.opening, columns, rows, cv2.INTER_LINEAR)
        defocus = np.abs(view.hit[..., 3] - FOCUS_DEPTH_MM) * SCENE_BLUR_PX_PER_MM
        view.blur[:] = np.clip(defocus / 1.5 * (BLUR_KINDS - 1), 0, BLUR_KINDS - 1)
        self._shade(view, (0, HEIGHT_PX, 0, WIDTH_PX))

    def _shade(self, view: _View, box: Box) -> None:
        look, skull = self.look, self.machine.skull
        grid, scene = skull.grid, look.scene_grid
        shade(
            box, view.eye.values, view.hit, (grid.x0_mm, grid.y0_mm, grid.step_mm),
            skull.outer_z, self._top, skull.inner_z, skull.membrane_z,
            look.bone, look.bed, look.film, look.relief_mm, look.grain, self._dust, DUST_CELLS,
            (scene.x0_mm, scene.y0_mm, scene.step_mm), look.ground_z, look.ground, look.opening,
            look.light, self._colours, self._numbers, view.linear,
        )  # fmt: skip
        wider = (max(0, box[0] - 2), min(HEIGHT_PX, box[1] + 2), max(0, box[2] - 2), min(WIDTH_PX, box[3] + 2))
        develop(wider, view.linear, view.blur, self._weights, view.display)

    def _pour(self, x_mm: float, y_mm: float, radius_mm: float, liquid: Liquid) -> None:
        cells = pour(self.look, self.machine.skull.grid, x_mm, y_mm, radius_mm, liquid)
        with self.machine.lock:
            self._changed.add(*cells)

    def _update(self) -> tuple[Array, float, float]:
        """Copy what changed since the last picture, and shade it again; the ball, its turn and its speed."""
        machine = self.machine
        if machine.first_cut_s is not None:
            while self._spills and self._spills[0].after_s <= machine.now_s - machine.first_cut_s:
                spill = self._spills.pop(0)
                self._pour(spill.x_mm, spill.y_mm, spill.radius_mm, spill.liquid)
        with machine.lock:
            i0, i1, j0, j1 = self._changed.take()
            self._top[i0:i1, j0:j1] = machine.skull.top_z[i0:i1, j0:j1]
            ball, turned, rpm = machine.ball_center_mm, machine.turns, machine.spindle_rpm
        if i1 > i0:
            cells = self._settle_dust(i0, i1, j0, j1)
            for view in self._views:
                box = self._pixels_of(view, cells)
                if box[1] > box[0] and box[3] > box[2]:
                    self._shade(view, box)
        return ball, turned, rpm

    def _settle_dust(self, i0: int, i1: int, j0: int, j1: int) -> Box:
        """Dust lies round a kerf in proportion to what was cut; returns the cells whose look may have changed."""
        skull, n, reach = self.machine.skull, DUST_CELLS, DUST_REACH
        rows, columns = self._dust.shape
        a0, a1 = max(0, i0 // n - reach), min(rows, (i1 - 1) // n + 1 + reach)
        b0, b1 = max(0, j0 // n - reach), min(columns, (j1 - 1) // n + 1 + reach)
        # A wider neighbourhood feeds the blur, so that the result does not depend on how a kerf came about.
        c0, c1, d0, d1 = max(0, a0 - reach), min(rows, a1 + reach), max(0, b0 - reach), min(columns, b1 + reach)
        cut = (
            skull.outer_z[c0 * n : c1 * n : 2, d0 * n : d1 * n : 2]
            - self._top[c0 * n : c1 * n : 2, d0 * n : d1 * n : 2]
        )
        coarse = cv2.resize(cut, (d1 - d0, c1 - c0), interpolation=cv2.INTER_AREA)
        spread = cv2.blur(coarse, (2 * reach + 1, 2 * reach + 1), borderType=cv2.BORDER_REPLICATE)
        self._dust[a0:a1, b0:b1] = np.minimum(spread[a0 - c0 : a1 - c0, b0 - d0 : b1 - d0] / 0.12, 1.0)
        return a0 * n, min(a1 * n, skull.grid.rows), b0 * n, min(b1 * n, skull.grid.columns)

    def _pixels_of(self, view: _View, cells: Box) -> Box:
        skull = self.machine.skull
        grid = skull.grid
        i, j = np.meshgrid(
            np.linspace(cells[0], cells[1] - 1, 7).astype(int), np.linspace(cells[2], cells[3] - 1, 7).astype(int)
        )
        i, j = i.ravel(), j.ravel()
        points = np.column_stack([grid.x0_mm + i * grid.step_mm, grid.y0_mm + j * grid.step_mm, skull.outer_z[i, j]])
        pixels = view.eye.project(points)
        low, high = np.floor(pixels.min(axis=0)).astype(int) - 3, np.ceil(pixels.max(axis=0)).astype(int) + 4
        return max(0, int(low[1])), min(HEIGHT_PX, int(high[1])), max(0, int(low[0])), min(WIDTH_PX, int(high[0]))

    def _picture(self, view: _View, ball: Array, turned: float, rpm: float, frame: int) -> Image:
        out: Image = np.empty((HEIGHT_PX, WIDTH_PX, 3), np.uint8)
        offset = (frame * 2654435761) & (NOISE_SIZE - 1)
        noise = (self._noise, offset, self.machine.specimen.rig.noise_dn, self.look.shot_noise)
        expose(view.display, 0, 0, *noise, out)
        box, work, _ = self._composite(view, ball, turned, rpm)
        if work.size:
            expose(work, box[0], box[2], *noise, out)
        return out

    def _composite(self, view: _View, ball: Array, turned: float, rpm: float) -> tuple[Box, Field, Field]:
        """Box of the drill and its shadow, its display values, and the drill's cover of each pixel."""
        look, drill = self.look, self.drill
        box = picture_box(
            view.eye, drill, ball, look.light, self.machine.specimen.skull.center_mm[2], (HEIGHT_PX, WIDTH_PX)
        )
        work: Field = view.display[box[0] : box[1], box[2] : box[3]].copy()
        mask: Field = np.zeros(work.shape[:2], np.float32)
        if work.size:
            turning = min(1.0, abs(rpm) / FLUTES_BLUR_ABOVE_RPM)
            paint_drill(
                box[0], box[2], view.eye.values, view.hit, ball, drill.axis, drill.radius_mm, drill.profile, drill.tint,
                drill.flutes, turned * 2 * np.pi, turning, look.light, look.ambient, look.gain,
                np.array([FOCUS_DEPTH_MM, DRILL_BLUR_PX_PER_MM]), work, mask,
            )  # fmt: skip
        return box, work, mask


def _draw_spills(specimen: Specimen) -> list[_Spill]:
    """What falls near the kerf during the first two minutes of cutting, by the specimen's seed."""
    rng = np.random.default_rng([specimen.seed, 606])
    spills = []
    mouse = specimen.kind == "mouse"
    for liquid, count in (
        ("saline", rng.poisson(3.0 * specimen.appearance.wetness)),
        ("blood", rng.poisson(0.8) * mouse),
    ):
        for _ in range(count):
            angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.8, 3.4)
            x = specimen.skull.center_mm[0] + reach * np.cos(angle)
            y = specimen.skull.center_mm[1] + reach * np.sin(angle)
            radius = float(np.exp(rng.normal(-1.2, 0.35)))
            spills.append(_Spill(rng.uniform(5, 120), x, y, radius, "blood" if liquid == "blood" else "saline"))
    return sorted(spills, key=lambda spill: spill.after_s)


def _blur_weights() -> Array:
    """Separable kernels of growing width, (kinds, 3)."""
    sigma = 0.45 + np.linspace(0.0, 1.5, BLUR_KINDS)
    taps = np.exp(-0.5 * (np.arange(3)[None, :] / sigma[:, None]) ** 2)
    weights: Array = taps / (taps[:, :1] + 2 * taps[:, 1:].sum(axis=1, keepdims=True))
    return weights


def _cut_box(outer: Field, top: Field) -> Box:
    rows, columns = np.nonzero(top < outer)
    if not len(rows):
        return 0, 0, 0, 0
    return int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1


def _inside(pixel: Array) -> bool:
    return bool(0 <= pixel[0] <= WIDTH_PX - 1 and 0 <= pixel[1] <= HEIGHT_PX - 1)
