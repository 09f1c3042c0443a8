"""The bone as height fields over a grid that is aligned with {R}.

Field element ``[i, j]`` lies at ``x = x0 + i * step``, ``y = y0 + j * step``; seen as a picture, a field is oriented
as the microscope shows it (rows along +x of {R}, columns along +y).

The skull's own frame has its origin at the middle of bregma and lambda: ``t`` towards the nose, ``s`` towards the
animal's right. Without yaw the nose points along -x of {R}: up in the picture.

Left out: overhangs (a height field has none), the diploe between the tables of the bone, and any change of thickness
at the sutures.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from drivers.errors import ConfigError
from firmware_sim.specimen import Specimen

Field = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

HALF_WIDTH_MM: Final = 7.5
HIGHEST_BONE_MM: Final = -1.0
BEHIND_LAMBDA_MM: Final = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.48, 8.0)
DROP_MM: Final = (0.0, 0.18, 0.27, 0.35, 0.43, 0.56, 0.70, 0.98, 1.54, 2.12, 6.0)
_DROP_BEHIND_LAMBDA: Final = PchipInterpolator(BEHIND_LAMBDA_MM, DROP_MM)


@dataclass(frozen=True)
class Grid:
    """A square lattice in the xy plane of {R}."""

    x0_mm: float
    y0_mm: float
    step_mm: float
    rows: int
    columns: int

    @classmethod
    def around(cls, x_mm: float, y_mm: float, half_x_mm: float, half_y_mm: float, step_mm: float) -> "Grid":
        """The lattice whose middle element is at (x, y)."""
        n_x, n_y = round(half_x_mm / step_mm), round(half_y_mm / step_mm)
        return cls(x_mm - n_x * step_mm, y_mm - n_y * step_mm, step_mm, 2 * n_x + 1, 2 * n_y + 1)

    def middle(self, half_mm: float) -> tuple[slice, slice]:
        """The elements within ``half_mm`` of the middle."""
        n = round(half_mm / self.step_mm)
        i, j = self.rows // 2, self.columns // 2
        return slice(max(0, i - n), i + n + 1), slice(max(0, j - n), j + n + 1)

    def coordinates(self) -> tuple[Array, Array]:
        """Rows' x (rows, 1) and columns' y (1, columns)."""
        x: Array = self.x0_mm + self.step_mm * np.arange(self.rows, dtype=float)
        y: Array = self.y0_mm + self.step_mm * np.arange(self.columns, dtype=float)
        return x[:, None], y[None, :]

    def sample(self, field: Field, x_mm: npt.ArrayLike, y_mm: npt.ArrayLike) -> Array:
        """Bilinear values; NaN outside."""
        i = (np.asarray(x_mm, float) - self.x0_mm) / self.step_mm
        j = (np.asarray(y_mm, float) - self.y0_mm) / self.step_mm
        inside = (i >= 0) & (j >= 0) & (i <= self.rows - 1) & (j <= self.columns - 1)
        i0 = np.clip(np.nan_to_num(i).astype(np.int64), 0, self.rows - 2)
        j0 = np.clip(np.nan_to_num(j).astype(np.int64), 0, self.columns - 2)
        u, v = i - i0, j - j0
        value = (field[i0, j0] * (1 - v) + field[i0, j0 + 1] * v) * (1 - u) + (
            field[i0 + 1, j0] * (1 - v) + field[i0 + 1, j0 + 1] * v
        ) * u
        return np.where(inside, value, np.nan)


class SkullFrame:
    """From {R} to the skull's (s, t) and back, in the plane."""

    def __init__(self, specimen: Specimen) -> None:
        """Axes of the skull of ``specimen``."""
        yaw = np.deg2rad(specimen.skull.tilt_deg.yaw)
        self.center_mm = np.array(specimen.skull.center_mm)
        self.nose = np.array([-np.cos(yaw), -np.sin(yaw)])
        self.right = np.array([-np.sin(yaw), np.cos(yaw)])
        pitch = np.deg2rad(specimen.skull.tilt_deg.pitch)
        self.half_length_mm = 0.5 * specimen.skull.bregma_lambda_mm * float(np.cos(pitch))

    def st(self, x_mm: npt.ArrayLike, y_mm: npt.ArrayLike) -> tuple[Array, Array]:
        """(s, t) of points of {R}."""
        dx, dy = np.asarray(x_mm) - self.center_mm[0], np.asarray(y_mm) - self.center_mm[1]
        return dx * self.right[0] + dy * self.right[1], dx * self.nose[0] + dy * self.nose[1]

    def xy(self, s_mm: npt.ArrayLike, t_mm: npt.ArrayLike) -> tuple[Array, Array]:
        """(x, y) in {R} of points of the skull."""
        s, t = np.asarray(s_mm, float), np.asarray(t_mm, float)
        return (
            self.center_mm[0] + s * self.right[0] + t * self.nose[0],
            self.center_mm[1] + s * self.right[1] + t * self.nose[1],
        )


class SurfaceShape:
    """The outer surface without anything removed, for any (x, y): it goes on beyond the grid, under the scalp."""

    def __init__(self, specimen: Specimen) -> None:
        """Shape of the skull (or shell) of ``specimen``; reads its height map if it names one."""
        self._specimen = specimen
        self.frame = SkullFrame(specimen)
        shape = specimen.skull
        self._heights = None if shape.height_map is None else _read_map("height_map", shape.height_map)

    def outer_z(self, x_mm: npt.ArrayLike, y_mm: npt.ArrayLike) -> Array:
        """Height of the outer surface in {R}."""
        s, t = self.frame.st(x_mm, y_mm)
        shape = self._specimen.skull
        tilt = shape.tilt_deg
        z: Array = shape.center_mm[2] + t * np.tan(np.deg2rad(tilt.pitch)) + s * np.tan(np.deg2rad(tilt.roll))
        if self._heights is not None:
            return np.asarray(z + _sample_map(self._heights, s, t, shape.grid_mm))
        radius = shape.radius_of_curvature_mm
        if self._specimen.kind == "eggshell":
            return np.asarray(z - _sag(s, radius.lateral) - _sag(t, radius.rostrocaudal))
        length = self.frame.half_length_mm
        drop = _DROP_BEHIND_LAMBDA(np.clip(-t - length, 0.0, BEHIND_LAMBDA_MM[-1]))
        along = _sag(np.maximum(t, -length), radius.rostrocaudal) + drop
        return np.asarray(z - _sag(s, radius.lateral) - along)


class Skull:
    """Outer surface, inner surface, and what is left between them."""

    def __init__(self, specimen: Specimen) -> None:
        """Build the fields of ``specimen``.

        Raises:
            ConfigError: a map cannot be used, or bone stands higher than 1 mm below z = 0.
        """
        shape = specimen.skull
        self.surface = SurfaceShape(specimen)
        self.frame = self.surface.frame
        self.grid = Grid.around(shape.center_mm[0], shape.center_mm[1], HALF_WIDTH_MM, HALF_WIDTH_MM, shape.grid_mm)
        x, y = self.grid.coordinates()
        self.outer_z: Field = self.surface.outer_z(x, y).astype(np.float32)
        highest = float(self.outer_z.max())
        if highest > HIGHEST_BONE_MM:
            raise ConfigError(
                f"specimen [skull]: its highest bone is at z = {highest:.2f} mm of {{R}}; at most "
                f"{HIGHEST_BONE_MM} mm is allowed, because calibration moves freely above; lower center_mm or tilt less"
            )
        self.inner_z: Field = self.outer_z - self._thickness(specimen)
        self.top_z: Field = self.outer_z.copy()
        self.membrane_z: Field = self.inner_z - np.float32(specimen.membrane.clearance_mm)

    @property
    def bregma_mm(self) -> Array:
        """Bregma on the outer surface, in {R}."""
        return self._on_surface(self.frame.half_length_mm)

    @property
    def lambda_mm(self) -> Array:
        """Lambda on the outer surface, in {R}."""
        return self._on_surface(-self.frame.half_length_mm)

    def completion_at(self, x_mm: npt.ArrayLike, y_mm: npt.ArrayLike) -> Array:
        """Share of the local thickness that is removed at each (x, y): 0 untouched, 1 through; NaN off the grid."""
        outer = self.grid.sample(self.outer_z, x_mm, y_mm)
        thickness = outer - self.grid.sample(self.inner_z, x_mm, y_mm)
        return np.clip((outer - self.grid.sample(self.top_z, x_mm, y_mm)) / thickness, 0.0, 1.0)

    def remaining_at(self, x_mm: npt.ArrayLike, y_mm: npt.ArrayLike) -> Array:
        """Bone left at each (x, y), in mm; NaN off the grid."""
        top = self.grid.sample(self.top_z, x_mm, y_mm)
        return np.maximum(top - self.grid.sample(self.inner_z, x_mm, y_mm), 0.0)

    def _on_surface(self, t_mm: float) -> Array:
        x, y = self.frame.xy(0.0, t_mm)
        return np.array([x, y, self.surface.outer_z(x, y)])

    def _thickness(self, specimen: Specimen) -> Field:
        shape = specimen.skull
        x, y = self.grid.coordinates()
        s, t = self.frame.st(x, y)
        if shape.thickness_map is not None:
            given = _sample_map(_read_map("thickness_map", shape.thickness_map), s, t, shape.grid_mm)
            if not given.min() > 0:
                raise ConfigError(f"specimen key skull.thickness_map: found {given.min():.3f} mm; above 0 is allowed")
            return given.astype(np.float32)
        bound = shape.thickness_mm
        rng = np.random.default_rng([specimen.seed, 71])
        thickness = bound.mean + bound.waviness * smooth_noise(rng, self.outer_z.shape, self.grid.step_mm, 2.5)
        if specimen.kind == "mouse":
            # Bone is thicker along the midline and thinner towards the temples.
            thickness = thickness + 0.03 * np.exp(-np.square(s / 0.8)) - 0.004 * np.abs(s)
        return np.asarray(np.clip(thickness, bound.min, bound.max), np.float32)


def smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], step_mm: float, scale_mm: float) -> Field:
    """Zero mean, unit standard deviation, smooth over ``scale_mm``."""
    coarse = tuple(max(4, int(np.ceil(n * step_mm / scale_mm)) + 3) for n in shape[:2])
    values = rng.standard_normal(coarse).astype(np.float32)
    # Cubic enlargement keeps about 0.63 of the standard deviation of independent samples.
    return np.asarray(cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC) / 0.63, np.float32)


def _sag(distance_mm: Array, radius_mm: float) -> Array:
    """Drop of a circle, carried on straight where it gets steep."""
    limit = 0.75 * radius_mm
    near = np.minimum(np.abs(distance_mm), limit)
    beyond = np.abs(distance_mm) - near
    edge = np.sqrt(radius_mm**2 - limit**2)
    return np.asarray(radius_mm - np.sqrt(radius_mm**2 - near**2) + beyond * limit / edge)


def _read_map(key: str, path: Path) -> Field:
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"specimen key skull.{key}: {path} is not a NumPy file: {error}") from error
    if values.ndim != 2 or min(values.shape) < 2 or not np.isfinite(values).all():
        raise ConfigError(
            f"specimen key skull.{key}: {path} holds {values.shape}; a finite (H, W) array in mm is asked"
        )
    return np.asarray(values, np.float32)


def _sample_map(values: Field, s_mm: Array, t_mm: Array, step_mm: float) -> Array:
    """Values of a map: its middle at the skull's origin, its first row at the nose, its columns towards the right.

    Its rim goes on outside.
    """
    rows = (values.shape[0] - 1) / 2 - np.asarray(t_mm) / step_mm
    columns = (values.shape[1] - 1) / 2 + np.asarray(s_mm) / step_mm
    rows, columns = np.broadcast_arrays(rows, columns)
    shape = rows.shape
    flat_x = np.atleast_2d(columns).astype(np.float32)
    flat_y = np.atleast_2d(rows).astype(np.float32)
    return np.asarray(
        cv2.remap(values, flat_x, flat_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), float
    ).reshape(shape)
