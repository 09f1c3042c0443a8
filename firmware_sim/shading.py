"""Compiled loops that turn height fields and colours into one eye's picture, box by box.

A box is (first row, past the last row, first column, past the last column) of the picture.
"""

import math
from typing import Any

from numba import njit

from firmware_sim.optics import point_at, ray_offsets

MARCH_MM = 0.015
GAMMA = 1.0 / 2.2


@njit(cache=True, nogil=True, fastmath=True)
def find_ground(eye: Any, ground: Any, x0: float, y0: float, step: float, hit: Any) -> None:
    """Where each pixel's ray meets the uncut scene: ``hit[row, column] = x, y, z, depth towards the eye``."""
    rows, columns = ground.shape
    for r in range(hit.shape[0]):
        depth = -2.5
        for c in range(hit.shape[1]):
            u, v = ray_offsets(eye, c, r)
            for _ in range(14):
                x, y, z = point_at(eye, u, v, depth)
                fi = min(max((x - x0) / step, 0.0), rows - 1.001)
                fj = min(max((y - y0) / step, 0.0), columns - 1.001)
                i, j = int(fi), int(fj)
                a, b = fi - i, fj - j
                height = (ground[i, j] * (1 - b) + ground[i, j + 1] * b) * (1 - a) + (
                    ground[i + 1, j] * (1 - b) + ground[i + 1, j + 1] * b
                ) * a
                error = height - z
                depth += 0.8 * error
                if abs(error) < 2e-4:
                    break
            hit[r, c, 0] = x
            hit[r, c, 1] = y
            hit[r, c, 2] = z
            hit[r, c, 3] = depth


@njit(cache=True, nogil=True, fastmath=True)
def seen_bone(
    eye: Any,
    hit: Any,
    r: int,
    c: int,
    outer: Any,
    top: Any,
    inner: Any,
    membrane: Any,
    x0: float,
    y0: float,
    step: float,
) -> tuple[int, int, float]:
    """Cell and height of what a pixel sees where the uncut bone at its ray may be gone; row -1 off the grid."""
    x, y, z, depth = hit[r, c, 0], hit[r, c, 1], hit[r, c, 2], hit[r, c, 3]
    i, j = round((x - x0) / step), round((y - y0) / step)
    if i < 2 or j < 2 or i >= top.shape[0] - 2 or j >= top.shape[1] - 2:
        return -1, -1, z
    if outer[i, j] - top[i, j] < 0.002:
        return i, j, z
    u, v = ray_offsets(eye, c, r)
    previous_i, previous_j = i, j
    for _ in range(120):
        surface = top[i, j]
        if surface <= inner[i, j]:
            surface = min(surface, membrane[i, j])
        if surface >= z:
            # A wall is seen where the ray enters it, so that its height is the ray's.
            return i, j, min(z, top[previous_i, previous_j] + MARCH_MM) if top[i, j] > z + MARCH_MM else surface
        depth -= MARCH_MM
        x, y, z = point_at(eye, u, v, depth)
        previous_i, previous_j = i, j
        i, j = round((x - x0) / step), round((y - y0) / step)
        if i < 2 or j < 2 or i >= top.shape[0] - 2 or j >= top.shape[1] - 2:
            return -1, -1, z
    return i, j, z


@njit(cache=True, nogil=True, fastmath=True)
def shade(
    box: tuple[int, int, int, int],
    eye: Any,
    hit: Any,
    bone_origin: tuple[float, float, float],
    outer: Any,
    top: Any,
    inner: Any,
    membrane: Any,
    bone: Any,
    bed: Any,
    film: Any,
    relief: Any,
    grain: Any,
    dust: Any,
    dust_cells: int,
    scene_origin: tuple[float, float, float],
    ground_z: Any,
    ground: Any,
    opening: Any,
    light: Any,
    colours: Any,
    numbers: Any,
    out: Any,
) -> None:
    """Linear colours of the scene without the drill.

    colours: light, dust, attenuation per mm (3 rows of RGB). numbers: ambient share, wetness, dust, gain, vignetting.
    ``dust`` is coarse: one value per ``dust_cells`` cells of the bone's grid.
    """
    x0, y0, step = bone_origin
    sx0, sy0, sstep = scene_origin
    ambient, wetness, dustiness, gain, vignetting = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    hx, hy, hz = light[0] + eye[6], light[1] + eye[7], light[2] + eye[8]
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx / length, hy / length, hz / length
    rows, columns = ground_z.shape
    half_r, half_c = 0.5 * hit.shape[0], 0.5 * hit.shape[1]
    for r in range(box[0], box[1]):
        for c in range(box[2], box[3]):
            fi = min(max((hit[r, c, 0] - sx0) / sstep, 1.0), rows - 2.001)
            fj = min(max((hit[r, c, 1] - sy0) / sstep, 1.0), columns - 2.001)
            si, sj = int(fi), int(fj)
            a, b = fi - si, fj - sj
            w00, w01, w10, w11 = (1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b
            open_share = (
                opening[si, sj] * w00
                + opening[si, sj + 1] * w01
                + opening[si + 1, sj] * w10
                + opening[si + 1, sj + 1] * w11
            )
            edge = half_r * half_r + half_c * half_c
            corner = ((r - half_r) * (r - half_r) + (c - half_c) * (c - half_c)) / edge
            exposure = gain * (1.0 - vignetting * corner)
            red = green = blue = 0.0
            if open_share < 0.996:
                nx = -(ground_z[si + 1, sj] - ground_z[si - 1, sj]) / (2 * sstep)
                ny = -(ground_z[si, sj + 1] - ground_z[si, sj - 1]) / (2 * sstep)
                scale = 1.0 / math.sqrt(1 + nx * nx + ny * ny)
                lit = ambient + (1 - ambient) * max(0.0, (nx * light[0] + ny * light[1] + light[2]) * scale)
                red = (
                    colours[0, 0]
                    * lit
                    * (
                        ground[si, sj, 0] * w00
                        + ground[si, sj + 1, 0] * w01
                        + ground[si + 1, sj, 0] * w10
                        + ground[si + 1, sj + 1, 0] * w11
                    )
                )
                green = (
                    colours[0, 1]
                    * lit
                    * (
                        ground[si, sj, 1] * w00
                        + ground[si, sj + 1, 1] * w01
                        + ground[si + 1, sj, 1] * w10
                        + ground[si + 1, sj + 1, 1] * w11
                    )
                )
                blue = (
                    colours[0, 2]
                    * lit
                    * (
                        ground[si, sj, 2] * w00
                        + ground[si, sj + 1, 2] * w01
                        + ground[si + 1, sj, 2] * w10
                        + ground[si + 1, sj + 1, 2] * w11
                    )
                )
            if open_share > 0.004:
                i, j, z = seen_bone(eye, hit, r, c, outer, top, inner, membrane, x0, y0, step)
                if i >= 0:
                    cut = outer[i, j] - z
                    fresh = min(1.0, max(0.0, (cut - 0.002) / 0.02))
                    left = z - inner[i, j]
                    through = left <= 0.0
                    nx = -(top[i + 2, j] - top[i - 2, j]) / (4 * step)
                    ny = -(top[i, j + 2] - top[i, j - 2]) / (4 * step)
                    bump = 1.0 - 0.7 * fresh
                    nx -= bump * (relief[i + 1, j] - relief[i - 1, j]) / (2 * step)
                    ny -= bump * (relief[i, j + 1] - relief[i, j - 1]) / (2 * step)
                    if through:
                        nx, ny = 0.3 * grain[i, j] * step / 0.1, 0.3 * grain[j, i] * step / 0.1
                    nx, ny = min(max(nx, -2.0), 2.0), min(max(ny, -2.0), 2.0)
                    scale = 1.0 / math.sqrt(1 + nx * nx + ny * ny)
                    shut = 1.0 - 0.30 * min(1.0, max(0.0, cut) / 0.5)
                    if fresh > 0.0 and cut > 0.03:
                        # Does the kerf's own rim stand in the light?
                        for k in range(1, 6):
                            reach = 0.09 * k
                            qi = i + round(reach * light[0] / light[2] / step)
                            qj = j + round(reach * light[1] / light[2] / step)
                            if 0 <= qi < top.shape[0] and 0 <= qj < top.shape[1] and top[qi, qj] > z + reach + 0.01:
                                shut *= 0.82
                                break
                    lit = (
                        ambient + (1 - ambient) * max(0.0, (nx * light[0] + ny * light[1] + light[2]) * scale)
                    ) * shut
                    thick = max(left, 0.0)
                    back0 = math.exp(-2 * colours[2, 0] * thick)
                    back1 = math.exp(-2 * colours[2, 1] * thick)
                    back2 = math.exp(-2 * colours[2, 2] * thick)
                    # Fresh bone has no patches, sutures or congestion of the surface, but the colour of bone inside.
                    p0 = bone[i, j, 0] * (1 - back0) + bed[i, j, 0] * back0
                    p1 = bone[i, j, 1] * (1 - back1) + bed[i, j, 1] * back1
                    p2 = bone[i, j, 2] * (1 - back2) + bed[i, j, 2] * back2
                    cover = 1.0 - (1.0 - film[i, j, 3] * (1.0 - fresh)) * (1.0 - film[i, j, 5])
                    p0 += (film[i, j, 0] - p0) * cover
                    p1 += (film[i, j, 1] - p1) * cover
                    p2 += (film[i, j, 2] - p2) * cover
                    powder = dust[i // dust_cells, j // dust_cells]
                    if powder > 0.0 and not through:
                        heap = powder * dustiness * 1.6 + 0.22 * grain[i, j] * min(1.0, powder * 4.0)
                        heap = min(1.0, max(0.0, heap - 0.12)) * (0.9 - 0.55 * wetness) * (1.0 - 0.6 * fresh)
                        heap *= 1.0 - max(film[i, j, 4], film[i, j, 5])
                        p0 += (colours[1, 0] - p0) * heap
                        p1 += (colours[1, 1] - p1) * heap
                        p2 += (colours[1, 2] - p2) * heap
                    gloss = wetness * (1.0 - 0.8 * fresh) + 0.6 * cover + 0.8 * film[i, j, 4]
                    if through:
                        gloss = 0.5 + 0.5 * wetness
                    near = (nx * hx + ny * hy + hz) * scale
                    spec = 0.0
                    if near > 0.9:
                        wet = max(0.0, 0.55 + 0.35 * grain[i, j])
                        spec = gloss * wet * 0.5 * near**220
                        spec += gloss * 0.05 * near**30
                    red += (p0 * lit * colours[0, 0] + spec - red) * open_share
                    green += (p1 * lit * colours[0, 1] + spec - green) * open_share
                    blue += (p2 * lit * colours[0, 2] + spec - blue) * open_share
            out[r, c, 0] = red * exposure
            out[r, c, 1] = green * exposure
            out[r, c, 2] = blue * exposure


@njit(cache=True, nogil=True, fastmath=True)
def develop(box: tuple[int, int, int, int], linear: Any, sigma: Any, weights: Any, display: Any) -> None:
    """Defocus, then the sensor's curve: ``display`` 0 to 255 from ``linear``.

    ``sigma`` is an index into ``weights`` (kinds, 3): middle, next, and second neighbours of a separable kernel.
    """
    rows, columns = linear.shape[0], linear.shape[1]
    for r in range(box[0], box[1]):
        for c in range(box[2], box[3]):
            kind = sigma[r, c]
            s0 = s1 = s2 = 0.0
            for dr in range(-2, 3):
                wr = weights[kind, abs(dr)]
                rr = min(max(r + dr, 0), rows - 1)
                for dc in range(-2, 3):
                    w = wr * weights[kind, abs(dc)]
                    cc = min(max(c + dc, 0), columns - 1)
                    s0 += w * linear[rr, cc, 0]
                    s1 += w * linear[rr, cc, 1]
                    s2 += w * linear[rr, cc, 2]
            display[r, c, 0] = 255.0 * min(1.0, s0) ** GAMMA
            display[r, c, 1] = 255.0 * min(1.0, s1) ** GAMMA
            display[r, c, 2] = 255.0 * min(1.0, s2) ** GAMMA


@njit(cache=True, nogil=True, fastmath=True)
def expose(display: Any, row0: int, column0: int, noise: Any, offset: int, read: float, shot: float, out: Any) -> None:
    """Noise and rounding of ``display``, whose first pixel is (row0, column0) of ``out``.

    A pixel has the same noise whichever box it is exposed with.
    """
    mask = noise.shape[0] - 1
    for r in range(display.shape[0]):
        for c in range(display.shape[1]):
            # Rows start far apart in the table, so that its period never lines up in the picture.
            at = offset + (r + row0) * 40503 + (c + column0) * 3
            for k in range(3):
                value = display[r, c, k]
                sigma = read * (1.0 - shot + shot * (0.4 + value * (1.2 / 255.0)))
                value += sigma * noise[(at + k) & mask] + 0.5
                out[r + row0, c + column0, k] = min(255.0, max(0.0, value))


@njit(cache=True, nogil=True, fastmath=True)
def completion_map(
    eye: Any, hit: Any, opening_at: Any, outer: Any, top: Any, inner: Any, membrane: Any,
    x0: float, y0: float, step: float, out: Any,
) -> None:  # fmt: skip
    """Completion of the bone column that each pixel sees; NaN where it sees no bone."""
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[r, c] = math.nan
            if opening_at[r, c] < 0.5:
                continue
            i, j, _ = seen_bone(eye, hit, r, c, outer, top, inner, membrane, x0, y0, step)
            if i >= 0:
                done = (outer[i, j] - top[i, j]) / (outer[i, j] - inner[i, j])
                out[r, c] = min(1.0, max(0.0, done))
