"""The skull's surface from matched pixels: a height field with an uncertainty everywhere, and normals.

A smooth quadratic carries the dome; what is left of the matches is averaged locally and fades out in holes, where the
uncertainty grows to what the relief shows elsewhere. The random part shrinks with the matches averaged; the
calibration's own error does not, and is carried along unshrunk.
"""

import warnings
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.errors import DetectionError, PlanError

Floats = npt.NDArray[np.float64]

GRID_MM = 0.1
CLOSE_BY_MM = 0.2
"""One sigma of the neighbourhood in which something must be matched, or the place is a hole."""
SMOOTH_MM = 0.3
"""One sigma of the local average: less than the ball's footprint."""
OUTLIER_SIGMAS = 4.0
LEAST_POINTS = 300
NORMAL_RADIUS_MM = 0.5


@dataclass(frozen=True, eq=False)
class Surface:
    """z(x, y) in {R} on a regular grid; rows are y, columns are x."""

    x_mm: Floats
    y_mm: Floats
    z_mm: Floats
    sigma_mm: Floats
    """One sigma of z, calibration included."""
    measured: npt.NDArray[np.bool_]
    """False in holes, where the height is filled in."""
    normals: Floats
    """(ny, nx, 3) unit vectors out of the bone, towards the eyes."""

    def height(self, xy_mm: Floats) -> tuple[Floats, Floats]:
        """Heights and their sigma at (n, 2) places.

        Raises:
            PlanError: a place outside the reconstructed patch.
        """
        return self._interpolate(self.z_mm, xy_mm), self._interpolate(self.sigma_mm, xy_mm)

    def normal(self, xy_mm: Floats) -> Floats:
        """(n, 3) unit normals at (n, 2) places."""
        found = np.stack([self._interpolate(self.normals[..., k], xy_mm) for k in range(3)], axis=1)
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))

    def _interpolate(self, field: Floats, xy_mm: Floats) -> Floats:
        from scipy.interpolate import RegularGridInterpolator

        try:
            found = RegularGridInterpolator((self.y_mm, self.x_mm), field)(xy_mm[:, ::-1])
        except ValueError as error:
            low = (self.x_mm[0], self.y_mm[0])
            high = (self.x_mm[-1], self.y_mm[-1])
            raise PlanError(
                f"the reconstructed surface spans x {low[0]:.2f} to {high[0]:.2f}, y {low[1]:.2f} to {high[1]:.2f} mm, "
                "and a point outside it was asked for; see more of the skull, or choose a smaller radius"
            ) from error
        return np.asarray(found, dtype=np.float64)


def fit_surface(points_mm: Floats, variance_mm2: Floats, center_xy_mm: Floats, half_width_mm: float) -> Surface:
    """The height field round ``center_xy_mm`` from (n, 3) points in {R} and the variance of their z.

    Raises:
        DetectionError: too few points agree on a surface.
    """
    near = np.all(np.abs(points_mm[:, :2] - center_xy_mm) <= half_width_mm + SMOOTH_MM, axis=1)
    near &= np.isfinite(points_mm).all(axis=1)
    points, variance = points_mm[near], variance_mm2[near]
    if len(points) < LEAST_POINTS:
        raise DetectionError(
            f"the pictures match at {len(points)} places near the ring, at least {LEAST_POINTS} are needed: "
            "check light, focus and glare"
        )
    local = points[:, :2] - center_xy_mm
    coefficients, good = _robust_quadratic(local, points[:, 2])
    if good.sum() < LEAST_POINTS:
        raise DetectionError(
            f"only {int(good.sum())} of {len(points)} matched places agree on one surface, {LEAST_POINTS} are needed"
        )
    residual = points[:, 2] - _quadratic(local) @ coefficients

    side = np.arange(-half_width_mm, half_width_mm + GRID_MM / 2, GRID_MM)
    weight, total = _binned(local[good], residual[good], side)
    smooth_weight, smooth_total = _blur(weight, SMOOTH_MM), _blur(total, SMOOTH_MM)
    # A pull of one match towards the quadratic keeps the ratio finite in holes.
    relief = smooth_total / (smooth_weight + 1e-2)
    scatter = _scatter(local[good], residual[good], relief, side)
    effective = smooth_weight * (4 * np.pi * (SMOOTH_MM / GRID_MM) ** 2)
    close_by = _blur(weight, CLOSE_BY_MM) * (4 * np.pi * (CLOSE_BY_MM / GRID_MM) ** 2)
    gap = float(np.std(relief)) + scatter
    random = scatter**2 / np.maximum(effective, 1.0) + gap**2 * np.exp(-close_by)
    grid_x, grid_y = np.meshgrid(side, side)
    height = (_quadratic(np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)) @ coefficients).reshape(grid_x.shape)
    height = height + relief
    x, y = side + center_xy_mm[0], side + center_xy_mm[1]
    return Surface(
        x_mm=x,
        y_mm=y,
        z_mm=height,
        sigma_mm=np.sqrt(random + float(np.median(variance[good]))),
        measured=close_by >= 1.0,
        normals=_normals(x, y, height),
    )


def point_at(points_mm: Floats, left_px: Floats, at_px: Floats, *, within_px: float = 15.0) -> Floats:
    """The surface point (3,) that the left eye sees at ``at_px``, from matches round it.

    Raises:
        DetectionError: nothing matched there.
    """
    offset = left_px - at_px
    near = np.hypot(offset[:, 0], offset[:, 1]) <= within_px
    if near.sum() < 12:
        raise DetectionError(
            f"the surface is not seen at pixel ({at_px[0]:.0f}, {at_px[1]:.0f}): {int(near.sum())} matches within "
            f"{within_px:g} px, 12 are needed; remove what covers it, or change the light"
        )
    terms = np.column_stack([np.ones(int(near.sum())), offset[near]])
    middle = np.median(points_mm[near], axis=0)
    spread = np.abs(points_mm[near, 2] - middle[2])
    keep = spread <= max(0.3, 3 * float(np.median(spread)))
    found, *_ = np.linalg.lstsq(terms[keep], points_mm[near][keep], rcond=None)
    return np.asarray(found[0], dtype=np.float64)


def _quadratic(xy: Floats) -> Floats:
    x, y = xy[:, 0], xy[:, 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _robust_quadratic(xy: Floats, z: Floats) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Coefficients and which points agree with them: least squares, re-fitted without what strays."""
    terms = _quadratic(xy)
    good = np.abs(z - np.median(z)) <= max(1.5, 6 * float(np.median(np.abs(z - np.median(z)))))
    for _ in range(6):
        coefficients, *_ = np.linalg.lstsq(terms[good], z[good], rcond=None)
        residual = z - terms @ coefficients
        spread = 1.4826 * float(np.median(np.abs(residual[good] - np.median(residual[good]))))
        good = np.abs(residual) <= max(OUTLIER_SIGMAS * spread, 0.01)
    return np.asarray(coefficients, dtype=np.float64), good


def _binned(xy: Floats, values: Floats, side: Floats) -> tuple[Floats, Floats]:
    edges = np.append(side - GRID_MM / 2, side[-1] + GRID_MM / 2)
    weight, *_ = np.histogram2d(xy[:, 1], xy[:, 0], bins=(edges, edges))
    total, *_ = np.histogram2d(xy[:, 1], xy[:, 0], bins=(edges, edges), weights=values)
    return weight, total


def _blur(field: Floats, sigma_mm: float) -> Floats:
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(field, sigma_mm / GRID_MM, mode="constant"), dtype=np.float64)


def _scatter(xy: Floats, residual: Floats, relief: Floats, side: Floats) -> float:
    """How far single matches stray from the smoothed relief."""
    cell = np.clip(np.round((xy - side[0]) / GRID_MM).astype(int), 0, len(side) - 1)
    left = residual - relief[cell[:, 1], cell[:, 0]]
    return 1.4826 * float(np.median(np.abs(left)))


def _normals(x: Floats, y: Floats, z: Floats) -> Floats:
    with warnings.catch_warnings():
        # It says that there is no GPU, which nothing here needs.
        warnings.simplefilter("ignore", ImportWarning)
        import open3d

    grid_x, grid_y = np.meshgrid(x, y)
    cloud = open3d.geometry.PointCloud(
        open3d.utility.Vector3dVector(np.column_stack([grid_x.ravel(), grid_y.ravel(), z.ravel()]))
    )
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=NORMAL_RADIUS_MM, max_nn=100))
    # The eyes look down on the skull from +z of {R}.
    cloud.orient_normals_to_align_with_direction(np.array([0.0, 0.0, 1.0]))
    return np.asarray(cloud.normals, dtype=np.float64).reshape(*z.shape, 3)
