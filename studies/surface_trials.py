"""Experiment 2 on virtual specimens: how far the reconstructed bone is off, at a ring as milling uses it.

Scored in {Mi}, before the transform: the calibration's error does not enter. ``default`` is the reconstruction that
milling uses; ``paper`` is semi-global matching and the cloud's own points, as the paper's group describe it. Both are
given the same pictures, as many as milling takes.
"""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import numpy.typing as npt

from calib.stereo import PAPER_MODEL
from drivers.errors import DetectionError, PlanError
from milling.surface import NORMAL_RADIUS_MM, fit_surface
from milling.survey import BEYOND_MM, FRAMES, LOOK_HALF_PX
from studies.scenes import Scene
from studies.trials import Figures, World, by_recipe, rms, rms_interval
from vision.disparity import averaged, match
from vision.keypoints import LandmarkFinder
from vision.runtime import Image

Floats = npt.NDArray[np.float64]

RECIPES = ("default", "paper")
PUBLISHED = {"bregma_rmse_px": 1.19, "lambda_rmse_px": 1.73, "center_rmse_px": 1.37}
"""The paper's figures, on its pictures."""
LANDMARK_RATIO = 1.0 / 3.0
"""The ring's centre between bregma and lambda."""
RADIUS_MM = 2.0
RING_POINTS = 64
SGBM_BLOCK_PX = 5
SGBM_DISPARITIES = 64


def reconstruct_one(world: World, recipe: str) -> Figures:
    """Reconstruct the unmilled bone of ``world`` from what milling looks at.

    Returns:
        ``seed``, ``recipe``, ``failed`` (the reason, or None), and at the ring's points ``height_rmse_mm``,
        ``height_bias_mm``, ``normal_rmse_deg``; for ``default`` also the share of them ``within_2_sigma``, and of a
        mouse how far ``bregma_px``, ``lambda_px`` and ``center_px`` are off in each picture, None where not seen.
    """
    scene = Scene(world.specimen(), np.random.default_rng([world.seed, 2]))
    scene.park()
    pairs = [scene.pictures() for _ in range(FRAMES)]
    left, right = (averaged([pair[side] for pair in pairs]) for side in (0, 1))
    angles = np.arange(RING_POINTS) * 2 * np.pi / RING_POINTS
    ring = scene.center_mm + RADIUS_MM * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    truth = _in_mi(scene, ring)
    normals = _true_normals(scene, ring)
    warp = _right_from_left(scene, float(scene.outer_z(ring).mean()))
    middle_px = np.mean(scene.microscope.project(_on_bone(scene, ring))[0], axis=0)
    about: Figures = {"seed": world.seed, "recipe": recipe, "failed": None}
    if recipe == "default" and scene.machine.specimen.kind == "mouse":
        about |= _landmark_errors(scene, pairs[0])
    try:
        if recipe == "default":
            heights, found_normals, sigma = _default(left, right, warp, middle_px, truth)
            about["within_2_sigma"] = float(np.mean(np.abs(heights - truth[:, 2]) <= 2 * sigma))
        else:
            heights, found_normals = _paper(left, right, warp, middle_px, truth)
    except (DetectionError, PlanError) as error:
        return {**about, "failed": str(error)}
    errors = heights - truth[:, 2]
    cosine = np.clip((found_normals * normals).sum(axis=1), -1.0, 1.0)
    return {
        **about,
        "height_rmse_mm": rms(errors),
        "height_bias_mm": float(errors.mean()),
        "normal_rmse_deg": rms(np.degrees(np.arccos(cosine))),
    }


def trials_of(specimens: Sequence[World]) -> dict[str, tuple[World, str]]:
    """Name and arguments of every trial: each specimen with every recipe."""
    return {f"specimen-{world.name}-{recipe}": (world, recipe) for world in specimens for recipe in RECIPES}


def summary(trials: Mapping[str, Figures]) -> dict[str, Figures]:
    """By recipe: how many, how many failed, and RMSE with its interval; landmarks are read by ``default`` alone."""
    result: dict[str, Figures] = {}
    for recipe, (figures, good) in by_recipe(trials, RECIPES, ("height_rmse_mm", "normal_rmse_deg")).items():
        result[recipe] = figures
        if good:
            figures["height_worst_specimen_mm"] = max(trial["height_rmse_mm"] for trial in good)
        if recipe == "default":
            if good:
                figures["within_2_sigma"] = float(np.mean([trial["within_2_sigma"] for trial in good]))
            mice = [t for t in trials.values() if t["recipe"] == recipe and "bregma_px" in t]
            figures.update(_landmarks(mice))
    return result


def _landmarks(trials: Sequence[Figures]) -> Figures:
    """RMSE with its interval, worst case and misses over the pictures of all mice."""
    figures: Figures = {}
    for name in ("bregma", "lambda", "center"):
        errors = [error for trial in trials for error in trial[f"{name}_px"]]
        seen = [error for error in errors if error is not None]
        if seen:
            per_trial = [[error for error in trial[f"{name}_px"] if error is not None] for trial in trials]
            value, low, high = rms_interval([rms(errors_px) for errors_px in per_trial if errors_px])
            figures |= {f"{name}_rmse_px": value, f"{name}_rmse_px_low": low, f"{name}_rmse_px_high": high}
            figures |= {f"{name}_median_px": float(np.median(seen)), f"{name}_worst_px": max(seen)}
        if errors:
            figures[f"{name}_missed"] = 1.0 - len(seen) / len(errors)
    return figures


def _landmark_errors(scene: Scene, pictures: tuple[Image, Image]) -> Figures:
    """Distances in px from where landmarks and the ring's centre are, of each picture; None where one is not seen."""
    skull = scene.machine.skull
    errors: dict[str, list[float | None]] = {"bregma_px": [], "lambda_px": [], "center_px": []}
    places = scene.microscope.project(np.stack([skull.bregma_mm, skull.lambda_mm]))
    find = LandmarkFinder.load().find
    for picture, truth in zip(pictures, places, strict=True):
        bregma, lambda_ = find(picture)
        found = np.array([[bregma.x_px, bregma.y_px], [lambda_.x_px, lambda_.y_px]])
        off = found - truth
        whole = [off[0], off[1], (1 - LANDMARK_RATIO) * off[0] + LANDMARK_RATIO * off[1]]
        seen = [bregma.visible, lambda_.visible, bregma.visible and lambda_.visible]
        for name, error, visible in zip(errors, whole, seen, strict=True):
            errors[name].append(float(np.hypot(*error)) if visible else None)
    return dict(errors)


def _on_bone(scene: Scene, xy_mm: Floats) -> Floats:
    return np.column_stack([xy_mm, scene.outer_z(xy_mm)])


def _in_mi(scene: Scene, xy_mm: Floats) -> Floats:
    """Where the paper's model puts the bone at (n, 2) places of {R}, if both pictures are read without error."""
    return PAPER_MODEL.points_from_pixels(*scene.microscope.project(_on_bone(scene, xy_mm)))


def _true_normals(scene: Scene, xy_mm: Floats) -> Floats:
    """Normals in {Mi} of planes through the bone within the radius that normals are fitted over."""
    angles = np.arange(12) * np.pi / 6
    steps = [NORMAL_RADIUS_MM * share * np.array([np.cos(a), np.sin(a)]) for share in (0.5, 1.0) for a in angles]
    return _plane_normals(np.stack([_in_mi(scene, xy_mm + step) for step in steps], axis=1))


def _right_from_left(scene: Scene, z_mm: float) -> Floats:
    """(2, 3): from left to right pixels for a horizontal plane at ``z_mm``, as a calibration tells it."""
    side = np.linspace(-4.0, 4.0, 5)
    x, y = (axis.ravel() for axis in np.meshgrid(scene.center_mm[0] + side, scene.center_mm[1] + side))
    plane = np.column_stack([x, y, np.full_like(x, z_mm)])
    left, right = scene.microscope.project(plane)
    solved, *_ = np.linalg.lstsq(np.column_stack([left, np.ones(len(left))]), right, rcond=None)
    return np.asarray(solved.T)


def _default(
    left: Image, right: Image, warp: Floats, middle_px: Floats, truth: Floats
) -> tuple[Floats, Floats, Floats]:
    """Heights, normals and sigma of the heights, as ``milling.survey`` finds them."""
    x, y = middle_px
    region = (x - LOOK_HALF_PX, y - LOOK_HALF_PX, x + LOOK_HALF_PX, y + LOOK_HALF_PX)
    matches = match([left], [right], right_from_left=warp, region=region)
    points = PAPER_MODEL.points_from_pixels(matches.left_px, matches.right_px)
    variance = 2 * (matches.sigma_px / PAPER_MODEL.disparity_px_per_mm) ** 2
    surface = fit_surface(points, variance, truth[:, :2].mean(axis=0), RADIUS_MM + BEYOND_MM)
    heights, sigma = surface.height(truth[:, :2])
    return heights, surface.normal(truth[:, :2]), sigma


def _paper(left: Image, right: Image, warp: Floats, middle_px: Floats, truth: Floats) -> tuple[Floats, Floats]:
    """Heights and normals from the semi-global matcher's cloud: its points nearest to each place.

    Raises:
        DetectionError: no point of the cloud near a place of the ring.
    """
    height, width = left.shape[:2]
    aligned = cv2.warpAffine(right, warp, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
    matcher = cv2.StereoSGBM.create(
        minDisparity=-SGBM_DISPARITIES // 2,
        numDisparities=SGBM_DISPARITIES,
        blockSize=SGBM_BLOCK_PX,
        P1=8 * 3 * SGBM_BLOCK_PX**2,
        P2=32 * 3 * SGBM_BLOCK_PX**2,
        uniquenessRatio=5,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(left, aligned).astype(np.float64) / 16.0
    rows, columns = np.mgrid[:height, :width]
    near = np.hypot(columns - middle_px[0], rows - middle_px[1]) <= LOOK_HALF_PX
    known = near & (disparity > -SGBM_DISPARITIES // 2)
    at_left = np.stack([columns[known], rows[known]], axis=1).astype(np.float64)
    at_aligned = at_left - np.stack([disparity[known], np.zeros(int(known.sum()))], axis=1)
    cloud = PAPER_MODEL.points_from_pixels(at_left, at_aligned @ warp[:, :2].T + warp[:, 2])
    heights, normals = [], []
    for place in truth:
        away = np.hypot(*(cloud[:, :2] - place[:2]).T)
        close, patch = cloud[away <= 0.1], cloud[away <= NORMAL_RADIUS_MM]
        if len(close) < 3 or len(patch) < 12:
            raise DetectionError("the semi-global matcher finds nothing at a place of the ring")
        heights.append(float(np.median(close[:, 2])))
        normals.append(_plane_normals(patch[None])[0])
    return np.array(heights), np.array(normals)


def _plane_normals(patches: Floats) -> Floats:
    """(n, m, 3) points -> (n, 3) unit normals of the planes through them, upwards."""
    centered = patches - patches.mean(axis=1, keepdims=True)
    normals = np.linalg.svd(centered, full_matrices=False)[2][:, 2]
    return np.asarray(normals * np.sign(normals[:, 2:]))
