"""The colours of one specimen: bone, the bed of vessels below, films on top, scalp and fur round it.

Everything that a picture's family varies (hue of bone and fur, light, patches, blood, wet, hair) is drawn from the
specimen's seed. Colours are linear reflectances. A photograph, where the specimen names one, takes the place of bone,
sutures, scalp and fur wherever it reaches; what is under the bone stays drawn.

Left out: fluorescence, polarisation, the growth of a haematoma, hair that hangs over the opening and moves.
"""

from dataclasses import dataclass
from typing import Final, Literal

import cv2
import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from firmware_sim.anatomy import Stroke, sutures, vessels
from firmware_sim.optics import VIEW_CENTER_MM
from firmware_sim.skull import Array, Field, Grid, Skull, smooth_noise
from firmware_sim.specimen import Specimen

Liquid = Literal["blood", "saline"]

SCENE_STEP_MM: Final = 0.05
FILM_CHANNELS: Final = 6
BLUE_MU_PER_MM: Final = 4.73
RED_MU_PER_MM: Final = 1.97
GREEN_MU_PER_MM: Final = 3.75
BLOOD_RGB: Final = np.array([0.13, 0.014, 0.02])


@dataclass(frozen=True)
class Look:
    """Fields on the bone's grid and on the wider grid of the scene, and the light.

    Channels of ``film``: its colour (3), its cover of the uncut surface, the gloss of drops, its cover that also
    runs into a kerf.
    """

    bone: Field
    bed: Field
    film: Field
    relief_mm: Field
    grain: Field
    scene_grid: Grid
    ground_z: Field
    ground: Field
    opening: Field
    mu_per_mm: Array
    light: Array
    light_rgb: Array
    ambient: float
    wetness: float
    dust: float
    dust_rgb: Array
    gain: float
    vignetting: float
    shot_noise: float


def draw_look(specimen: Specimen, skull: Skull) -> Look:
    """Draw the appearance of ``specimen``."""
    rng = np.random.default_rng([specimen.seed, 5150])
    scene_grid = Grid.around(VIEW_CENTER_MM[0], VIEW_CENTER_MM[1], 14.0, 23.0, SCENE_STEP_MM)
    style = specimen.appearance
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(48, 78))
    light = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    warmth = rng.normal(0.0, 0.05)
    draw = _draw_eggshell if specimen.kind == "eggshell" else _draw_mouse
    bone, bed, film, relief, ground_z, ground, opening = draw(rng, skull, scene_grid)
    mu = np.array([RED_MU_PER_MM, GREEN_MU_PER_MM, BLUE_MU_PER_MM]) * np.exp(rng.normal(0, 0.10))
    if style.texture is not None:
        relief *= 0.15
        bone, bed, ground, ground_z, opening = _with_photograph(
            specimen, skull, scene_grid, bone, bed, mu, ground, ground_z, opening
        )
    scales = {0.06: 0.45, 0.15: 0.5, 0.4: 0.5, 1.2: 0.5}
    grain = sum(
        weight * smooth_noise(rng, skull.outer_z.shape, skull.grid.step_mm, scale) for scale, weight in scales.items()
    )
    typical = np.mean(bone[skull.grid.middle(2.5)] @ np.array([0.3, 0.6, 0.1]))
    return Look(
        bone=bone,
        bed=bed,
        film=film,
        relief_mm=relief,
        grain=_f32(np.asarray(grain)),
        scene_grid=scene_grid,
        ground_z=ground_z,
        ground=ground,
        opening=opening,
        mu_per_mm=mu,
        light=light,
        light_rgb=np.array([1 + warmth, 1.0, 1 - warmth]),
        ambient=rng.uniform(0.35, 0.65),
        wetness=style.wetness,
        dust=style.dust,
        dust_rgb=np.array([0.62, 0.57, 0.50]) * rng.uniform(0.8, 1.2),
        gain=style.brightness * rng.uniform(0.26, 0.42) / float(typical),
        vignetting=rng.uniform(0.05, 0.35),
        shot_noise=rng.uniform(0.3, 1.0),
    )


_Parts = tuple[Field, Field, Field, Field, Field, Field, Field]


def _draw_mouse(rng: np.random.Generator, skull: Skull, scene: Grid) -> _Parts:
    shape, step = skull.outer_z.shape, skull.grid.step_mm
    s, _ = skull.frame.st(*skull.grid.coordinates())
    length = skull.frame.half_length_mm
    strokes = sutures(rng, length)
    # Two-flux reflectance of a thick layer at the published coefficients: 0.37, 0.24, 0.20.
    hue = np.array([0.37, 0.25, 0.20]) * np.exp(rng.normal(0, [0.08, 0.12, 0.16]))
    white = np.array([0.52, 0.46, 0.42]) * np.exp(rng.normal(0, 0.08))
    raw = np.array([0.22, 0.055, 0.05]) * np.exp(rng.normal(0, 0.15))
    patches = smooth_noise(rng, shape, step, 1.6) + 0.5 * smooth_noise(rng, shape, step, 0.5)
    patches += 0.25 * smooth_noise(rng, shape, step, 0.15)
    core = _ink(skull, strokes, 1.0)
    near_suture = _blur(core, 0.25 / step)
    near_suture /= max(1e-6, float(near_suture.max()))
    opaque = _step(patches + rng.normal(0.2, 0.6) - 2.2 * near_suture, rng.uniform(0.1, 1.0)) * rng.uniform(0.2, 1.0)
    muscle = _step(np.abs(s) + 0.25 * patches - rng.uniform(4.0, 4.9), 0.5) * rng.uniform(0.4, 1.0)
    congested = _step(patches * 0.7 + 3.0 * near_suture - rng.uniform(1.0, 2.2), 1.0) * rng.uniform(0.1, 0.7)
    bone = _mix(np.broadcast_to(hue, (*shape, 3)), white, opaque)
    bone = _mix(bone, raw * 1.3, 0.7 * congested)
    bone = _mix(bone, raw, muscle)
    bone *= np.exp(0.05 * smooth_noise(rng, shape, step, 0.12) + 0.04 * rng.standard_normal(shape))[..., None]
    # Vessels of the periosteum and of the bone itself, which no thickness of bone hides.
    surface_vessels = _blur(_ink(skull, vessels(rng, length), 1.0), rng.uniform(1.5, 5.0))
    bone = _mix(bone, raw, np.clip(surface_vessels, 0, 1) * rng.uniform(0.0, 0.6))
    suture_rgb = raw * rng.uniform(0.5, 1.4) + rng.uniform(0.0, 0.06)
    line = np.clip(_blur(core, 1.2), 0, 1)
    bone = _mix(bone, suture_rgb, line * rng.uniform(0.45, 0.95))

    tissue = np.array([0.45, 0.125, 0.10]) * np.exp(rng.normal(0, [0.12, 0.2, 0.2]))
    blood = BLOOD_RGB * np.exp(rng.normal(0, 0.2))
    bed = np.broadcast_to(tissue, (*shape, 3)) * np.exp(0.08 * smooth_noise(rng, shape, step, 0.6))[..., None]
    bed = _mix(bed, blood, np.clip(_blur(_ink(skull, vessels(rng, length), 1.0), 1.5), 0, 1) * 0.9)

    relief = -0.012 * line + 0.0015 * smooth_noise(rng, shape, step, 0.10)
    film = _blood_specks(rng, skull, blood, int(rng.poisson(rng.choice([1.0, 6.0]))))
    ground_z, ground, opening = _scalp_and_fur(rng, skull, scene, raw)
    return _f32(bone), _f32(bed), film, _f32(relief), ground_z, ground, opening


def _draw_eggshell(rng: np.random.Generator, skull: Skull, scene: Grid) -> _Parts:
    shape, step = skull.outer_z.shape, skull.grid.step_mm
    white = np.array([[0.80, 0.78, 0.74], [0.62, 0.42, 0.28], [0.72, 0.62, 0.50]])[rng.choice(3, p=[0.7, 0.15, 0.15])]
    speckle = 0.03 * smooth_noise(rng, shape, step, 0.2) + 0.02 * rng.standard_normal(shape)
    bone = white * np.exp(speckle + 0.02 * smooth_noise(rng, shape, step, 2.0))[..., None]
    inside = np.array([0.42, 0.36, 0.24]) * np.exp(rng.normal(0, 0.1))
    bed = inside * np.exp(0.06 * smooth_noise(rng, shape, step, 0.8))[..., None]
    relief = 0.003 * smooth_noise(rng, shape, step, 0.15)
    x, y = scene.coordinates()
    ground_z = np.maximum(skull.surface.outer_z(x, y), -14.0)
    rim = np.hypot(*skull.frame.st(x, y))
    shell = white * np.exp(0.03 * smooth_noise(rng, rim.shape, scene.step_mm, 0.3))[..., None]
    table = np.full(3, rng.uniform(0.02, 0.12))
    ground = _mix(shell, table, _step(rim - rng.uniform(13.0, 17.0), 0.3))
    opening = _step(6.8 - rim, 1.0)
    film = _no_film(skull, BLOOD_RGB)
    return _f32(bone), _f32(bed), film, _f32(relief), _f32(ground_z), _f32(ground), _f32(opening)


def _scalp_and_fur(rng: np.random.Generator, skull: Skull, scene: Grid, raw: Array) -> tuple[Field, Field, Field]:
    """Height, colour and opening of what surrounds the bone."""
    x, y = scene.coordinates()
    s, t = skull.frame.st(x, y)
    wide, nose, tail = rng.uniform(4.3, 5.6), rng.uniform(4.5, 6.8), rng.uniform(4.2, 6.2)
    ring = np.hypot(s / wide, t / np.where(t > 0, nose, tail))
    ring += 0.035 * smooth_noise(rng, ring.shape, scene.step_mm, 1.5) + 0.012 * smooth_noise(
        rng, ring.shape, scene.step_mm, 0.3
    )
    opening = _step(1.0 - ring, 0.02)
    outer = skull.surface.outer_z(x, y)
    head = np.maximum(outer, -9.0 + 0.3 * smooth_noise(rng, ring.shape, scene.step_mm, 4.0))
    head = np.maximum(head, outer.max() - 2.0 - 0.35 * np.hypot(s, t))
    thick = rng.uniform(0.3, 0.9)
    fur_edge = rng.uniform(1.08, 1.3)
    ground_z = np.where(ring < 1.0, outer, head + thick * _step(ring - 1.06, 0.06))
    ground_z += 0.15 * smooth_noise(rng, ring.shape, scene.step_mm, 0.8) * _step(ring - fur_edge, 0.1)
    flesh = raw * rng.uniform(0.4, 1.3) + rng.uniform(0.0, 0.06)
    uneven = 0.3 * smooth_noise(rng, ring.shape, scene.step_mm, 0.9)
    uneven += 0.2 * smooth_noise(rng, ring.shape, scene.step_mm, 0.2)
    skin = flesh * np.exp(uneven)[..., None]
    fur = _fur(rng, skull, scene)
    edge = _step(ring + 0.03 * smooth_noise(rng, ring.shape, scene.step_mm, 0.25) - fur_edge, 0.05)
    return _f32(ground_z), _f32(_mix(skin, fur, edge)), _f32(opening)


def _fur(rng: np.random.Generator, skull: Skull, scene: Grid) -> Array:
    """Hairs that point away from the middle, over a dark coat; some animals are white or brown."""
    coat = np.array([[0.03, 0.028, 0.026], [0.16, 0.10, 0.055], [0.62, 0.58, 0.54]])[rng.choice(3, p=[0.55, 0.25, 0.2])]
    canvas = np.empty((scene.rows, scene.columns, 3), np.uint8)
    canvas[:] = np.clip(255 * (0.6 * coat) ** 0.45, 0, 255)
    n = 7000
    start = rng.uniform((0, 0), (scene.columns, scene.rows), (n, 2))
    middle = np.array([
        (skull.frame.center_mm[1] - scene.y0_mm) / scene.step_mm,
        (skull.frame.center_mm[0] - scene.x0_mm) / scene.step_mm,
    ])  # fmt: skip
    out = np.arctan2(*(start - middle)[:, ::-1].T) + rng.normal(0, 0.45, n) + rng.normal(0, 0.3)
    reach = rng.uniform(12, 45, n)[:, None]
    bend = rng.normal(0, 0.4, n)
    mid = start + 0.5 * reach * np.column_stack([np.cos(out), np.sin(out)])
    end = mid + 0.5 * reach * np.column_stack([np.cos(out + bend), np.sin(out + bend)])
    hairs = np.round(np.stack([start, mid, end], axis=1) * 8).astype(np.int32)
    shades = np.array_split(np.arange(n), 40)
    for group in shades:
        colour = np.clip(255 * (coat * np.exp(rng.normal(0.2, 0.6))) ** 0.45, 0, 255)
        cv2.polylines(canvas, list(hairs[group]), False, colour.tolist(), 1, cv2.LINE_AA, 3)
    fur: Array = (canvas / 255.0) ** 2.2
    return fur


def _no_film(skull: Skull, blood: Array) -> Field:
    film = np.zeros((*skull.outer_z.shape, FILM_CHANNELS), np.float32)
    film[..., :3] = blood
    return film


def _blood_specks(rng: np.random.Generator, skull: Skull, blood: Array, count: int) -> Field:
    film = _no_film(skull, blood)
    grid = skull.grid
    cover = np.zeros(skull.outer_z.shape, np.float32)
    for _ in range(count):
        x, y = skull.frame.xy(rng.uniform(-4.5, 4.5), rng.uniform(-5, 5))
        at = (round((float(y) - grid.y0_mm) / grid.step_mm), round((float(x) - grid.x0_mm) / grid.step_mm))
        size = np.exp(rng.normal(-1.6, 0.6)) / grid.step_mm
        axes = (max(1, round(size)), max(1, round(size * rng.uniform(0.4, 1.0))))
        cv2.ellipse(cover, at, axes, rng.uniform(0, 180), 0, 360, rng.uniform(0.4, 0.95), -1, cv2.LINE_AA)
    ragged = _blur(cover, 5.0) + 0.10 * smooth_noise(rng, cover.shape, grid.step_mm, 0.2) * (_blur(cover, 8.0) > 0.02)
    film[..., 3] = np.clip((ragged - 0.25) * 2.2, 0.0, 0.9)
    return film


def _with_photograph(
    specimen: Specimen,
    skull: Skull,
    scene: Grid,
    bone: Field,
    bed: Field,
    mu: Array,
    ground: Field,
    ground_z: Field,
    opening: Field,
) -> tuple[Field, Field, Field, Field, Field]:
    """Lay a photograph over the skull by its bregma and lambda; solve for the bone that makes it look so."""
    style = specimen.appearance
    photo = cv2.imread(str(style.texture), cv2.IMREAD_COLOR)
    if photo is None:
        raise ConfigError(f"specimen key appearance.texture: {style.texture} is not a picture that OpenCV reads")
    linear = ((photo[..., ::-1] / 255.0) ** 2.2).astype(np.float32)
    bregma, lambda_ = np.array(style.bregma_px), np.array(style.lambda_px)
    if np.hypot(*(bregma - lambda_)) < 10:
        raise ConfigError(
            "specimen keys appearance.bregma_px, lambda_px: less than 10 px apart; name two places of the picture"
        )
    nose = (bregma - lambda_) / (2 * skull.frame.half_length_mm)
    right = np.array([-nose[1], nose[0]])
    middle = 0.5 * (bregma + lambda_)

    def sampled(grid: Grid) -> tuple[Field, Field]:
        s, t = skull.frame.st(*grid.coordinates())
        u = (middle[0] + s * right[0] + t * nose[0]).astype(np.float32)
        v = (middle[1] + s * right[1] + t * nose[1]).astype(np.float32)
        rim = np.minimum(np.minimum(u, photo.shape[1] - 1 - u), np.minimum(v, photo.shape[0] - 1 - v))
        colours = cv2.remap(linear, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return _f32(colours), _step(rim - 30.0, 28.0)

    colour, there = sampled(skull.grid)
    # Photographs are exposed as they come: the bone's middle is brought to a usual reflectance.
    balance = 0.27 / max(1e-3, float(colour[skull.grid.middle(2.5)].mean()))
    colour *= balance
    back = np.exp(-2 * (skull.outer_z - skull.inner_z)[..., None] * mu)
    bed = _f32(_mix(bed, np.minimum(bed, 0.7 * colour / back), there))
    wanted = np.clip((colour - back * bed) / (1 - back), 0.01, 0.95)
    wide, wide_there = sampled(scene)
    x, y = scene.coordinates()
    smooth = np.maximum(skull.surface.outer_z(x, y), -9.0)
    wide *= balance
    return (
        _f32(_mix(bone, wanted, there)),
        bed,
        _f32(_mix(ground, wide, wide_there)),
        _f32(ground_z + (smooth - ground_z) * wide_there),
        _f32(opening + (_step(6.5 - np.hypot(*skull.frame.st(x, y)), 0.8) - opening) * wide_there),
    )


def pour(
    look: Look, grid: Grid, x_mm: float, y_mm: float, radius_mm: float, liquid: Liquid
) -> tuple[int, int, int, int]:
    """Let a drop fall on the bone; returns the cells it may have changed."""
    half = int(1.7 * radius_mm / grid.step_mm)
    i, j = round((x_mm - grid.x0_mm) / grid.step_mm), round((y_mm - grid.y0_mm) / grid.step_mm)
    i0, i1 = max(0, i - half), min(grid.rows, i + half + 1)
    j0, j1 = max(0, j - half), min(grid.columns, j + half + 1)
    if i1 <= i0 or j1 <= j0:
        return 0, 0, 0, 0
    here = (slice(i0, i1), slice(j0, j1))
    rows, columns = np.mgrid[i0:i1, j0:j1]
    away = np.hypot(rows - i, columns - j) * grid.step_mm / radius_mm + 0.12 * look.grain[here]
    cover = _step(1.0 - away, 0.12)
    film = look.film[here]
    film[..., 4] = np.maximum(film[..., 4], cover)
    if liquid == "blood":
        film[..., 5] = np.maximum(film[..., 5], cover * np.float32(0.9))
    look.relief_mm[here] += np.float32(0.12 * radius_mm) * np.clip(1.0 - away**2, 0.0, 1.0)
    return i0, i1, j0, j1


def smear(look: Look, cover: float) -> None:
    """Let an uneven film of blood run over all bone and into every kerf; ``cover`` is its mean share of the colour."""
    film = np.clip(cover * (1.0 + 0.5 * look.grain), 0.0, 0.95)
    look.film[..., 5] = np.maximum(look.film[..., 5], film)


def _ink(skull: Skull, strokes: list[Stroke], value: float) -> Field:
    """Strokes drawn on the bone's grid, 0 to ``value``."""
    canvas = np.zeros(skull.outer_z.shape, np.uint8)
    step = skull.grid.step_mm
    for stroke in strokes:
        x, y = skull.frame.xy(stroke.st_mm[:, 0], stroke.st_mm[:, 1])
        points = np.round(16 * np.column_stack([(y - skull.grid.y0_mm) / step, (x - skull.grid.x0_mm) / step])).astype(
            np.int32
        )
        widths = np.maximum(1, np.round(stroke.width_mm / step)).astype(int)
        runs = np.flatnonzero(np.diff(widths)) + 1
        for first, last in zip([0, *runs], [*runs, len(widths)], strict=True):
            cv2.polylines(canvas, [points[first : last + 1]], False, 255, int(widths[first]), cv2.LINE_AA, 4)
    return (canvas * np.float32(value / 255.0)).astype(np.float32)


def _blur(field: Field, sigma_cells: float) -> Field:
    return np.asarray(cv2.GaussianBlur(field, (0, 0), sigma_cells), np.float32)


def _step(value: npt.NDArray[np.floating], width: float) -> Field:
    """0 below, 1 above, smooth over ``width`` round zero."""
    x = np.clip(0.5 + value / (2 * width), 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x), np.float32)


def _mix(below: Array | Field, above: Array | Field, share: Field) -> Array:
    return np.asarray(below + (above - below) * share[..., None], float)


def _f32(values: npt.ArrayLike) -> Field:
    return np.ascontiguousarray(values, dtype=np.float32)
