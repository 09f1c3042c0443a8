"""The rigid landmark fit (Horn 1987), and what it must tell about itself: residuals, held-out error, covariance.

A rotation cannot undo a mirror. A mirrored set of points is therefore a fault to name, never to fit; it shows only when
the points leave their common plane.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from calib.transform import Array, RigidTransform
from drivers.errors import CalibrationError

MIN_SPREAD_MM = 0.5
"""Points whose RMS distance from a common line (plane) is below this are treated as collinear (coplanar)."""
_MIRROR_RATIO = 0.5
"""A mirrored fit whose residual is below this share of the proper one means a mirrored frame."""


@dataclass(frozen=True, eq=False)
class LandmarkFit:
    """A rigid fit and its quality; all lengths in mm."""

    transform: RigidTransform
    residuals_mm: Array
    """(n, 3): target minus transformed source."""
    leave_one_out_mm: Array
    """(n,): distance of each point from where the fit of all others puts it; infinite where those are degenerate."""
    condition: float
    """Largest over second-largest spread of the points: how badly the rotation about the long axis is held."""
    covariance: Array
    """(6, 6) of (rotation vector in the target frame about the points' centre, rad; shift of that centre, mm), for an
    isotropic error of the size of the residuals."""
    center_mm: Array
    """(3,): centre of the transformed points, about which ``covariance`` turns."""
    source_mm: Array
    """(n, 3): the points in the source frame."""
    handedness: str
    """``right-handed``, or ``untested`` where the points lie in one plane."""

    @property
    def rmse_mm(self) -> float:
        """Root mean square of the residuals' lengths."""
        return float(np.sqrt((self.residuals_mm**2).sum(axis=1).mean()))

    def covariance_for(self, source_covariance_mm2: npt.ArrayLike) -> Array:
        """``covariance`` for source points that each err by this (3, 3), mm^2 in the source frame."""
        return _covariance(self.transform, self.source_mm, np.asarray(source_covariance_mm2, dtype=np.float64))


def spread_mm(points_mm: npt.ArrayLike) -> Array:
    """RMS extents (3,) of points (n, 3) along their principal directions, largest first."""
    points = np.asarray(points_mm, dtype=np.float64)
    centred = points - points.mean(axis=0)
    return np.asarray(np.linalg.svd(np.vstack([centred, np.zeros((3, 3))]), compute_uv=False) / np.sqrt(len(points)))


def fit_rigid(
    source_mm: npt.ArrayLike,
    target_mm: npt.ArrayLike,
    *,
    source: str,
    target: str,
) -> LandmarkFit:
    """Find the rotation and shift that bring ``source_mm`` (n, 3) onto ``target_mm`` (n, 3) with the least squares.

    Args:
        source_mm: points in the source frame.
        target_mm: the same points, in the same order, in the target frame.
        source: name of the source frame.
        target: name of the target frame.

    Raises:
        CalibrationError: fewer than three points, collinear points, or points that only a mirror would fit.
    """
    a, b = np.asarray(source_mm, dtype=np.float64), np.asarray(target_mm, dtype=np.float64)
    if a.ndim != 2 or a.shape[1:] != (3,) or a.shape != b.shape:
        raise ValueError(f"landmarks: source {a.shape} and target {b.shape}; two (n, 3) wanted")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise CalibrationError("landmarks: a coordinate is not finite; detect the points again")
    if len(a) < 3:
        raise CalibrationError(f"landmarks: {len(a)} points; at least 3 that are not on one line are needed")
    for name, points in ((source, a), (target, b)):
        if (spread := spread_mm(points))[1] < MIN_SPREAD_MM:
            raise CalibrationError(
                f"landmarks in {name}: all within {spread[1]:.3f} mm (RMS) of one line, at least {MIN_SPREAD_MM} mm "
                "needed; add a point beside that line"
            )
    handedness = _handedness(a, b)
    transform = align(a, b, source, target)
    residuals = b - transform.apply(a)
    spread = spread_mm(a)
    return LandmarkFit(
        transform,
        residuals,
        _leave_one_out(a, b, source, target),
        float(spread[0] / spread[1]),
        _covariance(transform, a, np.eye(3) * (residuals**2).sum() / max(1, 3 * len(a) - 6)),
        transform.apply(a.mean(axis=0)),
        a,
        handedness,
    )


def align(a: Array, b: Array, source: str, target: str) -> RigidTransform:
    """The least-squares transform of points ``a`` (n, 3) onto ``b``; nothing is checked."""
    a_center, b_center = a.mean(axis=0), b.mean(axis=0)
    rotation = Rotation.align_vectors(b - b_center, a - a_center)[0].as_matrix()
    return RigidTransform(target, source, rotation, b_center - rotation @ a_center)


def _handedness(a: Array, b: Array) -> str:
    """``right-handed`` or ``untested``; raises where only a mirror fits."""
    if min(spread_mm(a)[2], spread_mm(b)[2]) < MIN_SPREAD_MM:
        return "untested"
    a_centred, b_centred = a - a.mean(axis=0), b - b.mean(axis=0)
    proper = np.sqrt(_best_square_sum(a_centred, b_centred) / len(a))
    mirrored = np.sqrt(_best_square_sum(-a_centred, b_centred) / len(a))
    if mirrored < _MIRROR_RATIO * proper:
        raise CalibrationError(
            f"landmarks: a mirror fits with {mirrored:.3f} mm, a rotation only with {proper:.3f} mm; "
            "the cameras are swapped or a picture is mirrored: exchange left and right, or undo the mirror"
        )
    return "right-handed"


def _best_square_sum(a: Array, b: Array) -> float:
    """The least sum of squares over all proper rotations of ``a`` onto ``b`` (both centred)."""
    u, s, vt = np.linalg.svd(a.T @ b)
    s[2] *= np.sign(np.linalg.det(u @ vt))
    return max(0.0, float((a**2).sum() + (b**2).sum() - 2 * s.sum()))


def _leave_one_out(a: Array, b: Array, source: str, target: str) -> Array:
    errors = np.full(len(a), np.inf)
    for i in range(len(a)):
        kept = np.arange(len(a)) != i
        if kept.sum() >= 3 and min(spread_mm(a[kept])[1], spread_mm(b[kept])[1]) >= MIN_SPREAD_MM:
            errors[i] = np.linalg.norm(b[i] - align(a[kept], b[kept], source, target).apply(a[i]))
    return errors


def _covariance(transform: RigidTransform, a: Array, source_covariance_mm2: Array) -> Array:
    """First-order covariance of rotation vector and centre shift under independent errors of the points."""
    turned = transform.rotate(a - a.mean(axis=0))
    jacobian = np.zeros((len(a), 3, 6))
    for axis in range(3):
        jacobian[:, :, axis] = np.cross(np.eye(3)[axis], turned)
        jacobian[:, axis, 3 + axis] = 1.0
    per_point = transform.rotation @ source_covariance_mm2 @ transform.rotation.T
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", jacobian, jacobian))
    return np.asarray(inverse @ np.einsum("nij,ik,nkl->jl", jacobian, per_point, jacobian) @ inverse)
