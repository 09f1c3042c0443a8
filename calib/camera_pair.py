"""Two eyes seen from the robot: millimetres of {R} to pixels, and back with a covariance.

Each eye is an affine camera with two corrections, perspective and radial distortion, about a fixed reference point:

    q = (a + A d) / (1 + w . d)      pixel = c + q (1 + k |q|^2 / rho^2)      d = point - origin

Its twelve parameters are a (2), A (2 by 3), w (3), k (1). All models of `calib` end in this one form and differ in how
many of the twelve the setpoints may move. What is left out: decentring, skewed lenses, and any change over time.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.transform import Array
from drivers.errors import CalibrationError

N_PARAMETERS = 12
_A = slice(0, 2)
_AFFINE = slice(2, 8)
_W = slice(8, 11)
_K = 11
_CHUNK = 20_000
_STEPS = 3
_FAR_MM = 1000.0


@dataclass(frozen=True)
class Optics:
    """What no setpoint changes: the reference point in {R}, the picture's centre, its half diagonal."""

    origin_mm: tuple[float, float, float]
    center_px: tuple[float, float]
    half_diagonal_px: float


def project_eye(parameters: Array, optics: Optics, points_mm: Array) -> Array:
    """Pixels (n, 2) of points (n, 3) in {R}."""
    return _Rays(parameters, optics, points_mm).pixels


def eye_jacobians(parameters: Array, optics: Optics, points_mm: Array) -> tuple[Array, Array, Array]:
    """Pixels (n, 2), their derivatives by the point (n, 2, 3) and by the twelve parameters (n, 2, 12)."""
    rays = _Rays(parameters, optics, points_mm)
    return rays.pixels, rays.by_point(), rays.by_parameters()


class _Rays:
    """The intermediate values of one eye's projection of points (n, 3)."""

    def __init__(self, parameters: Array, optics: Optics, points_mm: Array) -> None:
        self.d = points_mm - np.array(optics.origin_mm)
        self.affine, self.w = parameters[_AFFINE].reshape(2, 3), parameters[_W]
        self.k = parameters[_K] / optics.half_diagonal_px**2
        self.depth = (1 + self.d @ self.w)[:, None, None]
        self.q = (parameters[_A] + self.d @ self.affine.T) / self.depth[:, :, 0]
        self.square = (self.q**2).sum(axis=1)
        self.pixels: Array = np.array(optics.center_px) + self.q * (1 + self.k * self.square)[:, None]
        self.half_diagonal_px = optics.half_diagonal_px

    def _bend(self) -> Array:
        """(n, 2, 2): how distortion turns a change of q into one of the pixel."""
        outer = self.q[:, :, None] * self.q[:, None, :]
        return np.asarray((1 + self.k * self.square)[:, None, None] * np.eye(2) + 2 * self.k * outer)

    def by_point(self) -> Array:
        return np.asarray(self._bend() @ ((self.affine - self.q[:, :, None] * self.w) / self.depth))

    def by_parameters(self) -> Array:
        by_q = np.zeros((len(self.d), 2, N_PARAMETERS))
        by_q[:, 0, 0] = by_q[:, 1, 1] = 1.0
        by_q[:, 0, 2:5] = by_q[:, 1, 5:8] = self.d
        by_q[:, :, _W] = -self.q[:, :, None] * self.d[:, None, :]
        result = np.asarray(self._bend() @ (by_q / self.depth))
        result[:, :, _K] = self.q * self.square[:, None] / self.half_diagonal_px**2
        return result


def optical_axis(parameters: Array) -> Array:
    """Unit vector (3,) in {R} along which this eye looks, as a picture with x right and y down implies."""
    rows = parameters[_AFFINE].reshape(2, 3)
    axis = np.cross(rows[0], rows[1])
    return np.asarray(axis / np.linalg.norm(axis))


@dataclass(frozen=True, eq=False)
class CameraPair:
    """Both eyes, the covariance of their parameters, and the error of one detected pixel coordinate."""

    optics: Optics
    left: Array
    """(12,) parameters of the left eye."""
    right: Array
    """(12,) parameters of the right eye."""
    covariance: Array
    """(24, 24) of left and right parameters; zero where a model keeps a parameter fixed."""
    sigma_px: tuple[float, float]
    """1-sigma of the x and of the y of one sighting (the median of a setpoint's frames), as the residuals show them.

    They differ: a drill leans along one of them, and height is read from x alone.
    """

    def project(self, points_mm: npt.ArrayLike) -> tuple[Array, Array]:
        """Pixels (n, 2) in the left and in the right picture of points (n, 3) in {R}."""
        points = _rows(points_mm, 3, "points_mm")
        return project_eye(self.left, self.optics, points), project_eye(self.right, self.optics, points)

    def points_from_pixels(
        self, left_px: npt.ArrayLike, right_px: npt.ArrayLike, sigma_px: npt.ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Points (n, 3) in {R} and their covariances (n, 3, 3), mm and mm^2, from matched pixels (n, 2).

        Args:
            left_px: pixels in the left picture.
            right_px: the same points in the right picture.
            sigma_px: 1-sigma of either coordinate, one number or (n,); the calibration's own where left out.

        Raises:
            CalibrationError: a pixel is not finite, or no point within a metre explains it.
        """
        left, right = _rows(left_px, 2, "left_px"), _rows(right_px, 2, "right_px")
        if left.shape != right.shape:
            raise ValueError(f"{len(left)} left and {len(right)} right pixels; as many of each wanted")
        if not (np.isfinite(left).all() and np.isfinite(right).all()):
            raise CalibrationError("points_from_pixels: a pixel is not finite; drop what was not detected")
        sigma = None if sigma_px is None else np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), len(left))
        points, covariance = np.empty((len(left), 3)), np.empty((len(left), 3, 3))
        for start in range(0, len(left), _CHUNK):
            part = slice(start, start + _CHUNK)
            points[part] = self.triangulate(left[part], right[part])
            if not np.isfinite(points[part]).all():
                raise CalibrationError(
                    "points_from_pixels: no point within a metre explains some pixels; drop matches that disagree"
                )
            covariance[part] = self.covariance_at(points[part], None if sigma is None else sigma[part])
        return points, covariance

    def covariance_at(self, points_mm: npt.ArrayLike, sigma_px: npt.ArrayLike | None = None) -> Array:
        """(n, 3, 3) mm^2: what one detection at each point (n, 3) would err by, parameters and pixels together."""
        points = _rows(points_mm, 3, "points_mm")
        by_point, by_parameters = self._jacobians(points)[1:]
        pixels = by_parameters @ self.covariance @ by_parameters.transpose(0, 2, 1)
        if sigma_px is None:
            pixels += self._detection_px2
        else:
            sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), len(points))
            pixels += sigma[:, None, None] ** 2 * np.eye(4)
        gain = _gain(by_point)
        return np.asarray(gain @ pixels @ gain.transpose(0, 2, 1))

    def sigma_at(self, points_mm: npt.ArrayLike, sigma_px: npt.ArrayLike | None = None) -> Array:
        """(n, 3): predicted 1-sigma along x, y and z of {R} at points (n, 3), mm."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance_at(points_mm, sigma_px), axis1=1, axis2=2)))

    def pixel_covariance_at(self, points_mm: npt.ArrayLike, point_sigma_mm: float = 0.0) -> Array:
        """(n, 4, 4) px^2 of (x_l, y_l, x_r, y_r) about the prediction for points known to ``point_sigma_mm``."""
        by_point, by_parameters = self._jacobians(_rows(points_mm, 3, "points_mm"))[1:]
        pixels = by_parameters @ self.covariance @ by_parameters.transpose(0, 2, 1) + self._detection_px2
        return np.asarray(pixels + point_sigma_mm**2 * by_point @ by_point.transpose(0, 2, 1))

    def disagreement_px(self, left_px: npt.ArrayLike, right_px: npt.ArrayLike) -> Array:
        """(n,): how far the eyes disagree off the epipolar line, px; large where they show different things."""
        left, right = _rows(left_px, 2, "left_px"), _rows(right_px, 2, "right_px")
        seen = np.hstack(self.project(self.triangulate(left, right)))
        return np.asarray(np.linalg.norm(np.hstack([left, right]) - seen, axis=1))

    def right_from_left(self, z_mm: float) -> Array:
        """(2, 3) affine that carries left pixels to right pixels for points at height ``z_mm`` in {R}.

        Perspective and distortion bend the true map by a fraction of a pixel; this is its least-squares affine over a
        square of 16 mm about the reference point.
        """
        grid = np.linspace(-8.0, 8.0, 9)
        x, y = np.meshgrid(grid + self.optics.origin_mm[0], grid + self.optics.origin_mm[1])
        left, right = self.project(np.stack([x.ravel(), y.ravel(), np.full(x.size, z_mm)], axis=1))
        design = np.hstack([left, np.ones((len(left), 1))])
        return np.asarray(np.linalg.lstsq(design, right, rcond=None)[0].T, dtype=np.float64)

    @property
    def _detection_px2(self) -> Array:
        """(4, 4) covariance of (x_l, y_l, x_r, y_r) of one sighting."""
        return np.diag(np.square(self.sigma_px * 2))

    def _jacobians(self, points: Array) -> tuple[Array, Array, Array]:
        """Pixels (n, 4), derivatives by the point (n, 4, 3) and by all parameters (n, 4, 24)."""
        left, left_by_point, left_by = eye_jacobians(self.left, self.optics, points)
        right, right_by_point, right_by = eye_jacobians(self.right, self.optics, points)
        by_parameters = np.zeros((len(points), 4, 2 * N_PARAMETERS))
        by_parameters[:, :2, :N_PARAMETERS], by_parameters[:, 2:, N_PARAMETERS:] = left_by, right_by
        return np.hstack([left, right]), np.concatenate([left_by_point, right_by_point], axis=1), by_parameters

    def triangulate(self, left: Array, right: Array) -> Array:
        """Points (n, 3) by least squares in the pixels of both eyes, Gauss-Newton from the reference point.

        Not finite where no point of space explains the pixels.
        """
        seen = np.hstack([left, right])
        points = np.tile(np.array(self.optics.origin_mm), (len(seen), 1))
        with np.errstate(all="ignore"):
            return self._gauss_newton(seen, points)

    def _gauss_newton(self, seen: Array, points: Array) -> Array:
        for _ in range(_STEPS):
            eyes = [_Rays(eye, self.optics, points) for eye in (self.left, self.right)]
            by_point = np.concatenate([eye.by_point() for eye in eyes], axis=1)
            error = (seen - np.hstack([eye.pixels for eye in eyes]))[:, :, None]
            points = points + (_gain(by_point) @ error)[:, :, 0]
        return np.where(np.linalg.norm(points, axis=1, keepdims=True) < _FAR_MM, points, np.nan)


def _gain(by_point: Array) -> Array:
    """(n, 3, 4): the least-squares step of a point for a change of its four pixel coordinates.

    By cofactors, which never raise: a hopeless pixel gives a value that is not finite and leaves its neighbours alone.
    """
    transposed = by_point.transpose(0, 2, 1)
    x, y, z = np.moveaxis(transposed @ by_point, 1, 0)
    cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=2)
    determinant = (x * cofactors[:, :, 0]).sum(axis=1)
    return np.asarray(cofactors @ transposed / determinant[:, None, None])


def _rows(values: npt.ArrayLike, width: int, name: str) -> Array:
    rows = np.asarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"{name} has shape {rows.shape}; (n, {width}) wanted")
    return rows
