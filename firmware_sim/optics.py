"""Where a point of {R} falls in each picture of the toed-in pair, and back along the ray.

An eye looks along ``w``; ``u`` is right and ``v`` is up in its picture. Scale grows by ``perspective`` per 10 mm
towards the eye. Left out: a true pinhole's 1/(1 - x) law (a line stands for it), tangential distortion, chromatic
errors.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import njit

from firmware_sim.skull import Array
from firmware_sim.specimen import Rig

WIDTH_PX: Final = 960
HEIGHT_PX: Final = 540
MM_PER_PX: Final = 0.0394
VIEW_CENTER_MM: Final = (5.0, -10.0, 0.0)
DISTORTION_RADIUS_PX: Final = 480.0


@dataclass(frozen=True)
class Eye:
    """One axis of the microscope; ``values`` is what the compiled code reads.

    values: 0-2 u, 3-5 v, 6-8 w (unit vectors in {R}); 9-11 pivot; 12 perspective per mm; 13, 14 px per mm;
    15, 16 cosine and sine of the roll; 17, 18 principal point; 19 distortion.
    """

    values: Array

    @property
    def view(self) -> Array:
        """Unit vector towards the eye, in {R}."""
        return self.values[6:9]

    def project(self, points_mm: npt.ArrayLike) -> Array:
        """Pixels (n, 2) of points (n, 3) of {R}."""
        points = np.ascontiguousarray(np.asarray(points_mm, float).reshape(-1, 3))
        pixels = np.empty((len(points), 2))
        _project_all(self.values, points, pixels)
        return pixels


def draw_eyes(rig: Rig) -> tuple[Eye, Eye]:
    """Left and right eye of a rig: what the file names, and small errors of its own from its seed."""
    rng = np.random.default_rng([rig.seed & 0x7FFFFFFF, 404])
    towards = rng.uniform(0, 2 * np.pi)
    tilt = np.deg2rad(rig.microscope_tilt_deg)
    twist = np.deg2rad(rng.uniform(-2.0, 2.0))
    pivot = np.array(VIEW_CENTER_MM) + np.append(rng.uniform(-0.4, 0.4, 2), 0.0)
    # Columns: the microscope's X (picture right), Y (picture up) and Z (towards the viewer) in {R}.
    upright = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    axes = _turn((math.cos(towards), math.sin(towards), 0.0), tilt) @ _turn((0.0, 0.0, 1.0), twist) @ upright
    aspect = rng.uniform(-0.006, 0.006)
    eyes = []
    for side in (1.0, -1.0):
        toe = np.deg2rad(rig.toe_in_deg + rng.uniform(-0.15, 0.15)) * side
        u = axes[:, 0] * math.cos(toe) + axes[:, 2] * math.sin(toe)
        w = axes[:, 2] * math.cos(toe) - axes[:, 0] * math.sin(toe)
        scale = (1.0 + rng.uniform(-0.004, 0.004)) / MM_PER_PX
        roll = np.deg2rad(rng.uniform(-0.4, 0.4))
        center = np.array([0.5 * WIDTH_PX, 0.5 * HEIGHT_PX]) + rng.uniform((-3.0, -1.0), (3.0, 1.0))
        scales = (scale * (1 + aspect), scale * (1 - aspect))
        values = [*u, *axes[:, 1], *w, *pivot, rig.perspective / 10.0, *scales, math.cos(roll), math.sin(roll), *center]
        eyes.append(Eye(np.array([*values, rig.distortion])))
    return eyes[0], eyes[1]


def _turn(axis: tuple[float, float, float], angle_rad: float) -> Array:
    x, y, z = axis
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Array = np.eye(3) + math.sin(angle_rad) * k + (1 - math.cos(angle_rad)) * k @ k
    return turn


@njit(cache=True, nogil=True)
def project_point(eye: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Pixel, and depth towards the eye in mm."""
    qx, qy, qz = x - eye[9], y - eye[10], z - eye[11]
    u = eye[0] * qx + eye[1] * qy + eye[2] * qz
    v = eye[3] * qx + eye[4] * qy + eye[5] * qz
    w = eye[6] * qx + eye[7] * qy + eye[8] * qz
    scale = 1.0 + eye[12] * w
    a = (eye[15] * u - eye[16] * v) * scale * eye[13]
    b = (eye[16] * u + eye[15] * v) * scale * eye[14]
    stretch = 1.0 + eye[19] * (a * a + b * b) / (DISTORTION_RADIUS_PX * DISTORTION_RADIUS_PX)
    return eye[17] + a * stretch, eye[18] - b * stretch, w


@njit(cache=True, nogil=True)
def ray_offsets(eye: Any, px: float, py: float) -> tuple[float, float]:
    """(u, v) in mm that a pixel shows at scale 1, that is at depth 0; divide by ``1 + perspective * w`` elsewhere."""
    da, db = px - eye[17], eye[18] - py
    a, b = da, db
    for _ in range(5):
        stretch = 1.0 + eye[19] * (a * a + b * b) / (DISTORTION_RADIUS_PX * DISTORTION_RADIUS_PX)
        a, b = da / stretch, db / stretch
    a /= eye[13]
    b /= eye[14]
    return eye[15] * a + eye[16] * b, -eye[16] * a + eye[15] * b


@njit(cache=True, nogil=True)
def point_at(eye: Any, u0: float, v0: float, w: float) -> tuple[float, float, float]:
    """Point of {R} at depth ``w`` along a ray of ``ray_offsets``."""
    scale = 1.0 / (1.0 + eye[12] * w)
    u, v = u0 * scale, v0 * scale
    return (
        eye[9] + u * eye[0] + v * eye[3] + w * eye[6],
        eye[10] + u * eye[1] + v * eye[4] + w * eye[7],
        eye[11] + u * eye[2] + v * eye[5] + w * eye[8],
    )


@njit(cache=True, nogil=True)
def _project_all(eye: Any, points: Any, pixels: Any) -> None:
    for n in range(points.shape[0]):
        px, py, _ = project_point(eye, points[n, 0], points[n, 1], points[n, 2])
        pixels[n, 0] = px
        pixels[n, 1] = py
