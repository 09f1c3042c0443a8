"""The drill in the picture: ball, neck, shank and chuck as a solid of revolution, and its shadow.

Left out: the picture of the specimen in the metal, water that clings to the ball, and bone in front of the ball.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import njit

from firmware_sim.optics import Eye, project_point
from firmware_sim.skull import Array
from firmware_sim.specimen import Specimen

SHADOW_REACH_MM: Final = 9.0
LENGTH_MM: Final = 45.0


@dataclass(frozen=True)
class DrillShape:
    """``profile`` (n, 2): distance from the ball's centre along the axis, and radius, in mm."""

    radius_mm: float
    axis: Array
    profile: Array
    tint: Array
    flutes: int


def draw_drill(specimen: Specimen) -> DrillShape:
    """The tool of a specimen's rig, with a neck and a shank from the rig's seed."""
    rng = np.random.default_rng([specimen.rig.seed & 0x7FFFFFFF, 77])
    ball = specimen.tool.ball_radius_mm
    neck, shank = ball * rng.uniform(0.5, 0.8), ball * rng.uniform(1.5, 2.4)
    taper, chuck = rng.uniform(2.0, 5.0), rng.uniform(12.0, 18.0)
    profile = np.array([
        [0.0, neck], [taper, neck], [taper + rng.uniform(1.0, 3.0), shank], [chuck, shank],
        [chuck + 0.1, rng.uniform(2.0, 3.0)], [LENGTH_MM, 3.0],
    ])  # fmt: skip
    tint = np.array([0.62, 0.63, 0.65]) * rng.uniform(0.6, 1.25)
    if rng.random() < 0.25:
        tint *= np.array([1.15, 0.98, 0.62])
    return DrillShape(ball, np.array(specimen.tool.axis), profile, tint, int(rng.integers(6, 13)))


def picture_box(
    eye: Eye, drill: DrillShape, ball_mm: Array, light: Array, ground_z_mm: float, shape: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Box of the picture that the drill and its shadow may touch."""
    along = np.linspace(0.0, LENGTH_MM, 46)
    wide = np.interp(along, drill.profile[:, 0], drill.profile[:, 1]).clip(drill.radius_mm)
    points = ball_mm + along[:, None] * drill.axis
    near = along <= SHADOW_REACH_MM
    drop = np.maximum(points[near, 2] - ground_z_mm + 1.0, 0.0)
    shadow = points[near] - light * (drop / light[2])[:, None]
    pixels = eye.project(np.vstack([points, shadow, points[near]]))
    margin = 28.0 * np.concatenate([wide, wide[near] + 0.08 * drop, wide[near] + 0.5]) + 5.0
    # The far end of the shank may be kilometres off the picture's edge: only what can be seen counts.
    seen = (
        (pixels[:, 0] > -margin) & (pixels[:, 0] < shape[1] + margin)
        & (pixels[:, 1] > -margin) & (pixels[:, 1] < shape[0] + margin)
    )  # fmt: skip
    if not seen.any():
        return 0, 0, 0, 0
    pixels, margin = pixels[seen], margin[seen]
    low, high = (pixels - margin[:, None]).min(axis=0), (pixels + margin[:, None]).max(axis=0)
    c0, c1 = max(0, int(low[0])), min(shape[1], int(high[0]) + 1)
    r0, r1 = max(0, int(low[1])), min(shape[0], int(high[1]) + 1)
    return (r0, r1, c0, c1) if r1 > r0 and c1 > c0 else (0, 0, 0, 0)


@njit(cache=True, nogil=True, fastmath=True)
def _radius_at(profile: Any, along: float) -> float:
    for n in range(1, profile.shape[0]):
        if along < profile[n, 0]:
            share = (along - profile[n - 1, 0]) / (profile[n, 0] - profile[n - 1, 0])
            return float(profile[n - 1, 1] + share * (profile[n, 1] - profile[n - 1, 1]))
    return float(profile[-1, 1])


@njit(cache=True, nogil=True, fastmath=True)
def _smooth(x: float) -> float:
    x = min(1.0, max(0.0, x))
    return x * x * (3 - 2 * x)


@njit(cache=True, nogil=True, fastmath=True)
def shadow_at(x: float, y: float, z: float, ball: Any, axis: Any, radius: float, profile: Any, light: Any) -> float:
    """Share of the light that the drill keeps from a point."""
    px, py, pz = x - ball[0], y - ball[1], z - ball[2]
    # The ball: distance of its centre from the ray to the light.
    along = -(px * light[0] + py * light[1] + pz * light[2])
    dark = 0.0
    if along > -radius:
        qx, qy, qz = px + along * light[0], py + along * light[1], pz + along * light[2]
        soft = 0.05 + 0.09 * max(along, 0.0)
        dark = _smooth(0.5 + (radius - math.sqrt(qx * qx + qy * qy + qz * qz)) / (2 * soft))
    # The shank: closest approach of that ray to the axis.
    al = axis[0] * light[0] + axis[1] * light[1] + axis[2] * light[2]
    pa = px * axis[0] + py * axis[1] + pz * axis[2]
    pl = px * light[0] + py * light[1] + pz * light[2]
    rest = 1.0 - al * al
    if rest > 1e-4:
        on_ray = (al * pa - pl) / rest
        on_axis = pa + al * on_ray
        if on_ray > 0.0 and 0.0 < on_axis < SHADOW_REACH_MM:
            qx = px + on_ray * light[0] - on_axis * axis[0]
            qy = py + on_ray * light[1] - on_axis * axis[1]
            qz = pz + on_ray * light[2] - on_axis * axis[2]
            soft = 0.05 + 0.09 * on_ray
            shank = _smooth(0.5 + (_radius_at(profile, on_axis) - math.sqrt(qx * qx + qy * qy + qz * qz)) / (2 * soft))
            fade = _smooth((SHADOW_REACH_MM - on_axis) / 3.0)
            dark = max(dark, shank * fade)
    return dark


@njit(cache=True, nogil=True, fastmath=True)
def paint_drill(
    row0: int, column0: int, eye: Any, hit: Any, ball: Any, axis: Any, radius: float, profile: Any, tint: Any,
    flutes: int, turned_rad: float, turning: float, light: Any, ambient: float, gain: float, focus: Any,
    work: Any, mask: Any,
) -> None:  # fmt: skip
    """Shadow and drill over ``work`` (h, w, 3), display values of the box that starts at (row0, column0).

    ``turning`` is 1 where the flutes blur together, ``focus`` = (depth in focus, blur in px per mm).
    ``mask`` (h, w) becomes the drill's cover of each pixel.
    """
    gamma = 1.0 / 2.2
    bx, by, bw = project_point(eye, ball[0], ball[1], ball[2])
    far = 12.0
    ex, ey, ew = project_point(eye, ball[0] + far * axis[0], ball[1] + far * axis[1], ball[2] + far * axis[2])
    lx, ly = ex - bx, ey - by
    length = math.sqrt(lx * lx + ly * ly)
    slant = (ew - bw) / far
    ux, uy = (lx / length, ly / length) if length > 1e-6 else (0.0, 1.0)
    per_mm = 0.5 * (eye[13] + eye[14]) * (1.0 + eye[12] * bw)
    grow = eye[12] * slant
    along_px = length / far
    # Eye coordinates of the picture's axes: across and along the drill, and towards the eye.
    vx, vy, vz = eye[6], eye[7], eye[8]
    px, py, pz = axis[0] - slant * vx, axis[1] - slant * vy, axis[2] - slant * vz
    norm = max(1e-6, math.sqrt(px * px + py * py + pz * pz))
    px, py, pz = px / norm, py / norm, pz / norm
    # Across: the picture's direction a quarter turn from ``along``, in {R}.
    qx, qy, qz = vy * pz - vz * py, vz * px - vx * pz, vx * py - vy * px
    fx, fy, fz = vx - slant * axis[0], vy - slant * axis[1], vz - slant * axis[2]
    norm = max(1e-6, math.sqrt(fx * fx + fy * fy + fz * fz))
    fx, fy, fz = fx / norm, fy / norm, fz / norm
    hx, hy, hz = light[0] + vx, light[1] + vy, light[2] + vz
    norm = math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx / norm, hy / norm, hz / norm
    ball_px = radius * per_mm
    # Share of the light on a level surface that comes straight from the lamp.
    key = light[2] * (1.0 - ambient) / (ambient + light[2] * (1.0 - ambient))
    start = math.sqrt(max(0.0, radius * radius - profile[0, 1] * profile[0, 1]))
    start_px = start * along_px
    for r in range(work.shape[0]):
        for c in range(work.shape[1]):
            x, y, z = hit[r + row0, c + column0, 0], hit[r + row0, c + column0, 1], hit[r + row0, c + column0, 2]
            gx, gy = c + column0 - bx, r + row0 - by
            away = math.sqrt(gx * gx + gy * gy)
            dark = key * shadow_at(x, y, z, ball, axis, radius, profile, light)
            if away < 4.0 * ball_px:
                qd = math.sqrt((x - ball[0]) ** 2 + (y - ball[1]) ** 2 + (z - ball[2]) ** 2) - radius
                dark = 1.0 - (1.0 - dark) * (1.0 - 0.35 * math.exp(-max(qd, 0.0) / 0.15))
            if dark > 0.003:
                keep = (1.0 - dark) ** gamma
                work[r, c, 0] *= keep
                work[r, c, 1] *= keep
                work[r, c, 2] *= keep
            mask[r, c] = 0.0
            u = gx * ux + gy * uy
            v = gx * uy - gy * ux
            if u < -2.0 * ball_px - 8.0:
                continue
            # The shank, or the ball.
            along = u / along_px if along_px > 1e-6 else 0.0
            wide = _radius_at(profile, max(along, 0.0))
            wide_px = wide * per_mm * (1.0 + grow * max(along, 0.0))
            across = v / wide_px
            blur = 0.6 + focus[1] * abs(bw + slant * max(along, 0.0) - focus[0])
            shank = 0.0
            if abs(across) < 1.0 + 2.0 * blur / wide_px:
                rim = start_px - wide_px * slant * math.sqrt(max(0.0, 1.0 - across * across))
                shank = _smooth(0.5 + (wide_px - abs(v)) / (2 * blur)) * _smooth(0.5 + (u - rim) / (2 * blur))
            tip_blur = 0.6 + focus[1] * abs(bw - focus[0])
            cover_ball = _smooth(0.5 + (ball_px - away) / (2 * tip_blur)) if away < ball_px + 2 * tip_blur else 0.0
            if shank <= 0.0 and cover_ball <= 0.0:
                continue
            mask[r, c] = max(shank, cover_ball)
            for part in range(2):
                cover = cover_ball if part == 0 else shank
                if cover <= 0.0:
                    continue
                if part == 0:
                    a, b = gx / ball_px, gy / ball_px
                    m = min(0.999, a * a + b * b)
                    up = math.sqrt(1.0 - m)
                    d, e = (gx * ux + gy * uy) / ball_px, (gx * uy - gy * ux) / ball_px
                    nx, ny, nz = d * px + e * qx + up * vx, d * py + e * qy + up * vy, d * pz + e * qz + up * vz
                else:
                    d = min(0.999, max(-0.999, across))
                    up = math.sqrt(1.0 - d * d)
                    nx, ny, nz = d * qx + up * fx, d * qy + up * fy, d * qz + up * fz
                lit = max(0.0, nx * light[0] + ny * light[1] + nz * light[2])
                near = max(0.0, nx * hx + ny * hy + nz * hz)
                # A room seen in metal: bright above, dark below, with a window.
                room = 0.10 + 0.30 * max(0.0, nz) ** 3 + 0.30 * _smooth((nx * 0.6 - ny * 0.5 + nz * 0.5 - 0.75) * 5.0)
                room -= 0.12 * _smooth(4.0 * (0.3 - abs(nx * 0.3 + ny * 0.6 - 0.35)))
                value = max(0.02, room) + 0.30 * lit + 1.3 * near**60
                if part == 0:
                    # Flutes run over the ball from pole to pole of the drill's axis.
                    lat = nx * axis[0] + ny * axis[1] + nz * axis[2]
                    ax1, ay1 = nx * qx + ny * qy + nz * qz, nx * fx + ny * fy + nz * fz
                    turn = math.atan2(ay1, ax1) + 0.9 * lat + turned_rad
                    edge = math.cos(flutes * turn)
                    depth = (0.42 - 0.34 * turning) * math.sqrt(max(0.0, 1.0 - lat * lat))
                    value *= 1.0 - depth * 0.5 * (1.0 - edge)
                    value *= 0.85
                    if shank > 0.0:
                        value *= 1.0 - 0.3 * shank
                value *= gain * 1.55
                for k in range(3):
                    display = 255.0 * min(1.0, value * tint[k]) ** gamma
                    work[r, c, k] += (display - work[r, c, k]) * cover
