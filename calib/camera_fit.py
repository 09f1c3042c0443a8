"""Fits a camera pair to setpoints: as many terms as the setpoints support, judged on setpoints held out of the fit.

The setpoints are known to a few micrometres and the detections to a fraction of a pixel, so each eye is fitted on its
own: a bundle adjustment would only add unknowns. The candidates, simplest first:

    linear        the paper's linear model and a rigid transform       6 parameters, and constants known beforehand
    affine        an affine camera for each eye                        8 for each eye
    perspective   and perspective along the eye's own axis             9 for each eye
    radial        and one radial term                                 10 for each eye
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.camera_pair import N_PARAMETERS, CameraPair, Optics, eye_jacobians, optical_axis, project_eye
from calib.landmark import MIN_SPREAD_MM, LandmarkFit, align, fit_rigid, spread_mm
from calib.stereo import PAPER_MODEL, StereoModel
from calib.transform import Array, RigidTransform
from drivers.errors import CalibrationError

EYE_MODELS = {"affine": 8, "perspective": 9, "radial": 10}
"""Parameters that each model frees in each eye."""
MIN_SETPOINTS = 5
_MIN_MOTION_PX = 5.0
"""RMS extent, across the direction of most motion, that the drill must show in each picture."""
_MIN_DISPARITY_PX_PER_MM = 0.5
"""Less, and both pictures show the same view; the paper's microscope has 6.4."""
_SIMPLER_WITHIN = 1.05
"""A simpler model is kept while its held-out error in pixels is within this factor of the best."""
_OUTLIER_SIGMAS = 6.0
_OUTLIER_FLOOR_PX = 1.0
_SURE_SHARE = 0.6
_READMISSIONS = 5
_MAX_OUTLIER_SHARE = 0.25
_PRIOR_DOF = 2.0
"""Weight, in degrees of freedom of x and of y, of the detector's own sigma against that of the residuals."""
_STEPS = 5


@dataclass(frozen=True, eq=False)
class PairFit:
    """A fitted camera pair and what it tells about itself."""

    pair: CameraPair
    model: str
    candidates_mm: dict[str, float]
    """Held-out RMSE of every model that the setpoints support."""
    used: Array
    """(n,) bool: False for outliers."""
    residuals_px: Array
    """(n, 4): seen minus predicted (x_l, y_l, x_r, y_r)."""
    residuals_mm: Array
    """(n, 3): triangulated minus commanded."""
    leave_one_out_mm: Array
    """(n,): error at each setpoint of the fit to all others; for outliers, of the final fit."""
    handedness: str

    @property
    def rmse_mm(self) -> float:
        """Held-out RMSE over the setpoints in use."""
        return _rms(self.leave_one_out_mm[self.used])


def fit_camera_pair(
    points_mm: Array, left_px: Array, right_px: Array, *, size_px: tuple[int, int], detector_sigma_px: float
) -> PairFit:
    """Fit and choose by held-out error.

    Args:
        points_mm: (n, 3) true places in {R}.
        left_px: (n, 2) where the left eye saw them.
        right_px: (n, 2) where the right eye saw them.
        size_px: width and height of the pictures.
        detector_sigma_px: what the detector claims for one coordinate.

    Raises:
        CalibrationError: too few or coplanar setpoints, swapped or mirrored pictures, or too many outliers.
    """
    _require_spread(points_mm)
    _require_motion(left_px, right_px)
    optics = optics_of(points_mm, size_px)
    used = _inliers(optics, points_mm, left_px, right_px, detector_sigma_px)
    points, left, right = points_mm[used], left_px[used], right_px[used]
    _require_spread(points)
    handedness = check_handedness(_fit_pair("affine", optics, points, left, right, detector_sigma_px))

    models = ["linear", *(name for name, free in EYE_MODELS.items() if 2 * (len(points) - 1) > free)]
    held_out = {name: _held_out(name, optics, points, left, right) for name in models}
    candidates = {name: errors for name, errors in held_out.items() if np.isfinite([errors.px, errors.mm]).all()}
    if not candidates:
        raise CalibrationError(
            "calibration: no model predicts each setpoint from the others; visit more of them, spread over the box"
        )
    best = min(_rms(errors.px) for errors in candidates.values())
    model = next(name for name, errors in candidates.items() if _rms(errors.px) <= _SIMPLER_WITHIN * best)

    if model == "linear":
        fit = fit_rigid(PAPER_MODEL.points_from_pixels(left, right), points, source="Mi", target="R")
        pair = embed(PAPER_MODEL, fit, optics, left, right, points, detector_sigma_px)
    else:
        pair = _fit_pair(model, optics, points, left, right, detector_sigma_px)
    leave_one_out = np.linalg.norm(_placed(pair, left_px, right_px) - points_mm, axis=1)
    leave_one_out[used] = held_out[model].mm
    candidates_mm = {name: _rms(errors.mm) for name, errors in candidates.items()}
    return _report(pair, model, candidates_mm, used, leave_one_out, points_mm, left_px, right_px, handedness)


def fit_paper(
    points_mm: Array, left_px: Array, right_px: Array, *, size_px: tuple[int, int], detector_sigma_px: float
) -> PairFit:
    """The paper's recipe with its errata 1 and 3 applied: known constants, one rigid fit.

    Its setpoints lie in one plane, so that height is taken on trust: residuals say nothing of the error off that plane.

    Raises:
        CalibrationError: fewer than three or collinear setpoints, or a mirrored picture.
    """
    _require_motion(left_px, right_px)
    optics = optics_of(points_mm, size_px)
    fit = fit_rigid(PAPER_MODEL.points_from_pixels(left_px, right_px), points_mm, source="Mi", target="R")
    pair = embed(PAPER_MODEL, fit, optics, left_px, right_px, points_mm, detector_sigma_px)
    check_handedness(pair)
    used = np.ones(len(points_mm), dtype=bool)
    candidates = {"linear": _rms(fit.leave_one_out_mm)}
    return _report(pair, "linear", candidates, used, fit.leave_one_out_mm, points_mm, left_px, right_px, fit.handedness)


def check_handedness(pair: CameraPair) -> str:
    """``right-handed``, where both eyes look down on {R} and height moves a point right in the left picture.

    Raises:
        CalibrationError: naming the mirrored picture, or that left and right are swapped.
    """
    mirrored = [name for name, eye in (("left", pair.left), ("right", pair.right)) if optical_axis(eye)[2] > 0.0]
    if len(mirrored) == 2:
        raise CalibrationError(
            "handedness: both pictures are mirrored against the robot; undo the mirror in the camera's settings, "
            "or check the signs of the robot's axes"
        )
    if mirrored:
        raise CalibrationError(
            f"handedness: the {mirrored[0]} picture is mirrored and the other is not; undo the mirror of that camera"
        )
    disparity_px_per_mm = pair.left[4] - pair.right[4]
    if abs(disparity_px_per_mm) < _MIN_DISPARITY_PX_PER_MM:
        raise CalibrationError(
            f"handedness: 1 mm of height moves points by {disparity_px_per_mm:.2f} px between the pictures, at least "
            f"{_MIN_DISPARITY_PX_PER_MM} px needed: left and right show the same view; check both in the rig file"
        )
    if disparity_px_per_mm < 0.0:
        raise CalibrationError(
            "handedness: height moves points the wrong way between the pictures; the cameras are swapped "
            "(or both pictures are turned by 180 degrees): exchange left and right in the rig file"
        )
    return "right-handed"


def optics_of(points_mm: Array, size_px: tuple[int, int]) -> Optics:
    """The reference point in the middle of the setpoints, on a grid of 0.1 mm so that a file shows it exactly."""
    x, y, z = (float(v) for v in np.round(points_mm.mean(axis=0), 1))
    width, height = size_px
    return Optics((x, y, z), (width / 2, height / 2), float(np.hypot(width, height) / 2))


def embed(
    model: StereoModel,
    fit: LandmarkFit,
    optics: Optics,
    left_px: Array,
    right_px: Array,
    points_mm: Array,
    detector_sigma_px: float,
) -> CameraPair:
    """The linear model behind a rigid transform, as the affine camera pair that it is, with its covariance."""
    values = _linear_eyes(model, fit.transform, optics)
    source_center, step, columns = fit.source_mm.mean(axis=0), 1e-6, []
    for change in np.eye(6) * step:
        # The fit's error turns the points about their centre and shifts that centre.
        rotation = Rotation.from_rotvec(change[:3]).as_matrix() @ fit.transform.rotation
        shift = fit.center_mm + change[3:] - rotation @ source_center
        columns.append((_linear_eyes(model, RigidTransform("R", "Mi", rotation, shift), optics) - values) / step)
    jacobian = np.stack(columns, axis=1)
    pair = _bare_pair(optics, values[:N_PARAMETERS], values[N_PARAMETERS:])
    residuals = np.hstack([left_px, right_px]) - np.hstack(pair.project(points_mm))
    sigma = _sigma_px(residuals, 6, detector_sigma_px)
    spread = fit.covariance_for(model.covariance_mm2(sigma))
    return CameraPair(optics, pair.left, pair.right, jacobian @ spread @ jacobian.T, sigma)


def _linear_eyes(model: StereoModel, transform: RigidTransform, optics: Optics) -> Array:
    """(24,) parameters of both eyes."""
    basis = np.array(optics.origin_mm) + np.vstack([np.zeros(3), np.eye(3)])
    result = np.zeros(2 * N_PARAMETERS)
    for start, pixels in zip((0, N_PARAMETERS), model.project(transform.inverse().apply(basis)), strict=True):
        result[start : start + 2] = pixels[0] - np.array(optics.center_px)
        result[start + 2 : start + 8] = (pixels[1:] - pixels[0]).T.ravel()
    return result


def _bare_pair(optics: Optics, left: Array, right: Array) -> CameraPair:
    return CameraPair(optics, left, right, np.zeros((2 * N_PARAMETERS, 2 * N_PARAMETERS)), (0.0, 0.0))


def _fit_pair(
    model: str, optics: Optics, points: Array, left: Array, right: Array, detector_sigma_px: float
) -> CameraPair:
    eyes = [_fit_eye(model, optics, points, pixels) for pixels in (left, right)]
    residuals = np.hstack(
        [pixels - project_eye(eye, optics, points) for (eye, _), pixels in zip(eyes, (left, right), strict=True)]
    )
    sigma = _sigma_px(residuals, 2 * EYE_MODELS[model], detector_sigma_px)
    covariance = np.zeros((2 * N_PARAMETERS, 2 * N_PARAMETERS))
    for start, (eye, basis) in zip((0, N_PARAMETERS), eyes, strict=True):
        jacobian = (eye_jacobians(eye, optics, points)[2] @ basis).reshape(-1, basis.shape[1])
        # The fit weighs x and y alike, though one is seen better than the other: what each brings into the estimate.
        step = basis @ np.linalg.pinv(jacobian) * np.tile(sigma, len(points))
        covariance[start : start + N_PARAMETERS, start : start + N_PARAMETERS] = step @ step.T
    return CameraPair(optics, eyes[0][0], eyes[1][0], covariance, sigma)


def _fit_eye(model: str, optics: Optics, points: Array, pixels: Array) -> tuple[Array, Array]:
    """Parameters (12,) and the basis (12, free) in which they moved."""
    eye = _affine_eye(optics, points, pixels)
    basis = free_basis(model, eye)
    if model != "affine":
        for _ in range(_STEPS):
            predicted, _, by_parameters = eye_jacobians(eye, optics, points)
            jacobian = (by_parameters @ basis).reshape(-1, basis.shape[1])
            eye = eye + basis @ np.linalg.lstsq(jacobian, (pixels - predicted).ravel(), rcond=None)[0]
    return eye, basis


def _affine_eye(optics: Optics, points: Array, pixels: Array) -> Array:
    design = np.hstack([np.ones((len(points), 1)), points - np.array(optics.origin_mm)])
    solution = np.linalg.lstsq(design, pixels - np.array(optics.center_px), rcond=None)[0]
    return np.concatenate([solution[0], solution[1:].T.ravel(), np.zeros(4)])


def free_basis(model: str, eye: Array) -> Array:
    """(12, free): the directions in which ``model`` may move the parameters of ``eye``."""
    basis = np.zeros((N_PARAMETERS, EYE_MODELS[model]))
    basis[:8, :8] = np.eye(8)
    if model != "affine":
        basis[8:11, 8] = optical_axis(eye)
    if model == "radial":
        basis[11, 9] = 1.0
    return basis


@dataclass(frozen=True, eq=False)
class _HeldOut:
    """Each setpoint against the fit to all others; infinite where these do not determine the model."""

    mm: Array
    """(n,): distance of the triangulated point."""
    px: Array
    """(n,): distance of the four pixel coordinates."""


def _held_out(model: str, optics: Optics, points: Array, left: Array, right: Array) -> _HeldOut:
    n = len(points)
    mm, px = np.full(n, np.inf), np.full(n, np.inf)
    in_mi = PAPER_MODEL.points_from_pixels(left, right)
    for i in range(n):
        kept, one = np.arange(n) != i, slice(i, i + 1)
        if spread_mm(points[kept])[2] < MIN_SPREAD_MM:
            continue
        if model == "linear":
            eyes = _linear_eyes(PAPER_MODEL, align(in_mi[kept], points[kept], "Mi", "R"), optics)
            pair = _bare_pair(optics, eyes[:N_PARAMETERS], eyes[N_PARAMETERS:])
        else:
            pair = _bare_pair(
                optics, *(_fit_eye(model, optics, points[kept], pixels[kept])[0] for pixels in (left, right))
            )
        mm[i] = np.linalg.norm(pair.triangulate(left[one], right[one]) - points[one])
        px[i] = np.linalg.norm(np.hstack([left[one], right[one]]) - np.hstack(pair.project(points[one])))
    return _HeldOut(mm, px)


def _inliers(optics: Optics, points: Array, left: Array, right: Array, detector_sigma_px: float) -> Array:
    """(n,) bool: the setpoints that agree best, and all that a fit to these predicts.

    The richest model that the number of setpoints supports is the judge, or else missing terms would look like
    outliers; with too few setpoints for perspective none is left out, and the held-out error tells.
    """
    n = len(points)
    n_sure = int(np.ceil(_SURE_SHARE * n))
    allowed = int(_MAX_OUTLIER_SHARE * n)
    judges = [name for name in ("perspective", "radial") if 2 * n_sure >= EYE_MODELS[name] + 4]
    if not judges:
        return np.ones(n, dtype=bool)
    misfit = np.hstack([_robust_residuals(judges[-1], optics, points, pixels) for pixels in (left, right)])
    used = np.zeros(n, dtype=bool)
    used[np.argsort((misfit**2).sum(axis=1))[:n_sure]] = True
    for _ in range(_READMISSIONS):
        pair = _fit_pair(judges[-1], optics, points[used], left[used], right[used], detector_sigma_px)
        misfit = np.hstack([left, right]) - np.hstack(pair.project(points))
        whitened = np.linalg.solve(pair.pixel_covariance_at(points), misfit[:, :, None])[:, :, 0]
        near = np.linalg.norm(misfit, axis=1) <= _OUTLIER_FLOOR_PX
        used = near | ((misfit * whitened).sum(axis=1) <= _OUTLIER_SIGMAS**2)
        if (~used).sum() > allowed:
            names = ", ".join(str(tuple(float(v) for v in p)) for p in points[~used])
            raise CalibrationError(
                f"calibration: {(~used).sum()} of {n} setpoints disagree with the others ({names} mm), at most "
                f"{allowed} allowed; look at their pictures, clean the optics, check that nothing slips"
            )
    return used


def _robust_residuals(model: str, optics: Optics, points: Array, pixels: Array) -> Array:
    start = _affine_eye(optics, points, pixels)
    basis = free_basis(model, start)

    def residuals(step: Array) -> Array:
        return (project_eye(start + basis @ step, optics, points) - pixels).ravel()

    def jacobian(step: Array) -> Array:
        by_parameters = eye_jacobians(start + basis @ step, optics, points)[2]
        return (by_parameters @ basis).reshape(-1, basis.shape[1])

    fit = least_squares(
        # A scale far below the noise: nearly the sum of absolute residuals, which needs no guess of the noise.
        residuals,
        np.zeros(basis.shape[1]),
        jacobian,
        loss="soft_l1",
        f_scale=0.05,
        x_scale="jac",
    )
    return residuals(fit.x).reshape(-1, 2)


def _require_spread(points: Array) -> None:
    if len(points) < MIN_SETPOINTS:
        raise CalibrationError(
            f"calibration: {len(points)} usable setpoints, at least {MIN_SETPOINTS} needed; use the default sequence"
        )
    spread = spread_mm(points)
    if spread[1] < MIN_SPREAD_MM:
        raise CalibrationError(
            "calibration: the setpoints lie on one line; spread them over the box, in all three axes"
        )
    if spread[2] < MIN_SPREAD_MM:
        raise CalibrationError(
            f"calibration: the setpoints lie within {spread[2]:.3f} mm (RMS) of one plane, at least {MIN_SPREAD_MM} mm "
            "needed: scale, shear and handedness off that plane would be unobserved; add setpoints at another height"
        )


def _require_motion(left: Array, right: Array) -> None:
    for name, pixels in (("left", left), ("right", right)):
        extent = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(pixels))
        if not extent >= _MIN_MOTION_PX:
            raise CalibrationError(
                f"calibration: the robot moved, yet the drill stayed within {extent:.1f} px (RMS) of one place or line "
                f"in the {name} picture, at least {_MIN_MOTION_PX:g} px needed: frozen picture, or not the drill"
            )


def _sigma_px(residuals: Array, n_parameters: int, detector_sigma_px: float) -> tuple[float, float]:
    """The sigmas of x and y by (n, 4) residuals, steadied by the detector's claim where few degrees are left."""
    dof = max(0.0, (residuals.size - n_parameters) / 2)
    squares = (residuals**2).sum(axis=0)
    x, y = ((squares[:2] + squares[2:]) + _PRIOR_DOF * detector_sigma_px**2) / (dof + _PRIOR_DOF)
    return float(np.sqrt(x)), float(np.sqrt(y))


def _report(
    pair: CameraPair,
    model: str,
    candidates: dict[str, float],
    used: Array,
    leave_one_out: Array,
    points: Array,
    left: Array,
    right: Array,
    handedness: str,
) -> PairFit:
    residuals_px = np.hstack([left, right]) - np.hstack(pair.project(points))
    residuals_mm = _placed(pair, left, right) - points
    return PairFit(pair, model, candidates, used, residuals_px, residuals_mm, leave_one_out, handedness)


def _placed(pair: CameraPair, left: Array, right: Array) -> Array:
    """Triangulated points; an outlier that no point explains counts as a metre off."""
    return np.nan_to_num(pair.triangulate(left, right), nan=1000.0)


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))
