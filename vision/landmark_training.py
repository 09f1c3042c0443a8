"""What the landmark network learns from, and how it is judged."""

import math
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from vision.keypoint_training import Found, KeypointTask, as_input, close_loss, rough_loss
from vision.keypoints import BORDER, PICTURE_PX, SPAN_MM, Finder, LandmarkFinder
from vision.landmark_network import SPAN_PX, VIEW_PX, WINDOW_CELLS, LandmarkNet, view_frames
from vision.networks import CELL_PX, COARSE
from vision.runtime import Image, Network
from vision.samples import Data, relit
from vision.training import Batch

Points = npt.NDArray[np.float64]

VIEWS_PER_PICTURE = 2
EDGE_PX = 4
"""A landmark nearer to the edge of a view is not asked for."""
_REDUCED_PX = (PICTURE_PX[0] // COARSE, 144)


class LandmarkTask(KeypointTask):
    """Find bregma and lambda.

    Data: ``pictures`` (N, 540, 960, 3) uint8, ``points`` (N, 2, 2) px, NaN where outside the picture, and ``visible``
    (N, 2) bool.
    """

    def __init__(self) -> None:
        super().__init__("landmarks", ("bregma", "lambda"), steps=1500)

    def network(self) -> nn.Module:
        """A fresh network."""
        return LandmarkNet()

    def finder(self, network: Network) -> Finder:
        """What runs the exported network."""
        return LandmarkFinder(network)

    def batch(self, data: Data, size: int, rng: np.random.Generator) -> Batch:
        """``size`` whole pictures, reduced, in any direction, and some close views of each."""
        reduced, places, inside = [], [], []
        views, targets, present = [], [], []
        for index in rng.integers(len(data["pictures"]), size=size):
            picture = np.asarray(data["pictures"][index])
            points, visible = np.asarray(data["points"][index], dtype=np.float64), data["visible"][index]
            small, there = _turned(picture, points, rng)
            reduced.append(relit(_shaded(small, rng), rng))
            places.append(np.nan_to_num(there))
            inside.append(_within(there, PICTURE_PX, EDGE_PX))
            for _ in range(VIEWS_PER_PICTURE):
                view, seen_at = _view(picture, points, rng)
                views.append(relit(_shaded(view, rng), rng))
                targets.append(np.nan_to_num(seen_at))
                present.append(visible & _within(seen_at, (VIEW_PX, VIEW_PX), EDGE_PX))
        return {
            "reduced": as_input(reduced),
            "places": torch.tensor(np.array(places), dtype=torch.float32),
            "inside": torch.tensor(np.array(inside)),
            "views": as_input(views),
            "targets": torch.tensor(np.array(targets), dtype=torch.float32),
            "present": torch.tensor(np.array(present)),
        }

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Where they are (both looks), how exactly, how sure, and whether at all."""
        net = cast(LandmarkNet, network)
        rough = rough_loss(net.look(batch["reduced"]).float(), batch["places"], batch["inside"])
        maps = net.look_closely(batch["views"]).float().flatten(0, 1)
        cells = ((batch["targets"] - 0.5) / CELL_PX).flatten(0, 1)
        return rough + close_loss(maps, cells, batch["present"].flatten(), WINDOW_CELLS)

    def figures_of(self, found: list[Found]) -> dict[str, float]:
        """As of every keypoint; and in mm, along the midline and across it, where both landmarks were found."""
        figures = super().figures_of(found)
        errors = []
        swapped = 0
        for (bregma, at_bregma, _), (lambda_, at_lambda, _) in zip(found[::2], found[1::2], strict=True):
            if not (bregma.visible and lambda_.visible and np.isfinite([at_bregma, at_lambda]).all()):
                continue
            span = at_lambda - at_bregma
            mm_per_px = SPAN_MM / np.hypot(*span)
            along = span / np.hypot(*span)
            error = np.array([[k.x_px, k.y_px] for k in (bregma, lambda_)]) - [at_bregma, at_lambda]
            swapped += bool((np.array([lambda_.x_px - bregma.x_px, lambda_.y_px - bregma.y_px]) @ span) < 0)
            errors.append(np.stack([error @ along, error @ [-along[1], along[0]]], axis=1) * mm_per_px)
        if errors:
            whole = np.array(errors)
            length = np.hypot(whole[..., 0], whole[..., 1])
            third = (2 * whole[:, 0] + whole[:, 1]) / 3
            figures |= {
                "mean_mm": float(length.mean()),
                "median_mm": float(np.median(length)),
                "worst_mm": float(length.max()),
                "along_midline_mean_mm": float(np.abs(whole[..., 0]).mean()),
                "across_midline_mean_mm": float(np.abs(whole[..., 1]).mean()),
                "center_rmse_mm": float(np.sqrt((third**2).sum(1).mean())),
            }
        figures["swapped"] = float(swapped)
        return figures


def _turned(picture: Image, points: Points, rng: np.random.Generator) -> tuple[Image, Points]:
    """The picture reduced for the rough look, turned and scaled, and where its points are at full scale."""
    small = cv2.resize(picture, None, fx=1 / COARSE, fy=1 / COARSE, interpolation=cv2.INTER_AREA)
    degrees = rng.uniform(-180.0, 180.0) if rng.random() < 0.5 else rng.uniform(-15.0, 15.0)
    scale = math.exp(rng.uniform(-0.35, 0.3))
    mirror = rng.random() < 0.5
    center = np.array([small.shape[1] - 1, small.shape[0] - 1]) / 2
    affine = cv2.getRotationMatrix2D((float(center[0]), float(center[1])), degrees, scale)
    affine[:, 2] += rng.uniform(-0.15, 0.15, size=2) * [small.shape[1], small.shape[0]]
    if mirror:
        affine = affine @ np.array([[-1.0, 0.0, small.shape[1] - 1], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    result = cv2.warpAffine(small, affine, _REDUCED_PX, borderValue=(BORDER,) * 3)
    half = (COARSE - 1) / 2
    there = ((points - half) / COARSE) @ affine[:, :2].T + affine[:, 2]
    return result.astype(np.uint8), there * COARSE + half


def _view(picture: Image, points: Points, rng: np.random.Generator) -> tuple[Image, Points]:
    """A close view as the rough look may aim it, and where its points are."""
    line = _aimed(points, rng)
    change = [[rng.normal(0.0, 0.12), math.exp(rng.normal(0.0, 0.1)), 1.0 if rng.random() < 0.5 else -1.0]]
    turned, middle = view_frames(torch.tensor(line), torch.tensor(change, dtype=torch.float64))
    picture_from_view = np.column_stack([turned[0].numpy(), middle.numpy()])
    picture_from_view[:, 2] -= picture_from_view[:, :2] @ np.full(2, (VIEW_PX - 1) / 2)
    view = cv2.warpAffine(
        picture,
        picture_from_view,
        (VIEW_PX, VIEW_PX),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderValue=(BORDER,) * 3,
    )
    view_from_picture = cv2.invertAffineTransform(picture_from_view)
    return view.astype(np.uint8), points @ view_from_picture[:, :2].T + view_from_picture[:, 2]


def _shaded(picture: Image, rng: np.random.Generator) -> Image:
    """Lit from a side, and with more or less colour: heads and rigs differ more than one set of pictures shows."""
    if rng.random() < 0.5:
        return picture
    field = cv2.resize(rng.normal(0.0, 0.25, size=(3, 4)).astype(np.float32), picture.shape[1::-1])
    lit = picture.astype(np.float32) * np.exp(field)[..., None]
    gray = lit.mean(axis=2, keepdims=True)
    return np.asarray(np.clip(gray + (lit - gray) * rng.uniform(0.4, 1.3), 0, 255), dtype=np.uint8)


def _aimed(points: Points, rng: np.random.Generator) -> Points:
    """Where the rough look might see the line; now and then it is wrong altogether."""
    span = np.diff(points, axis=0)[0]
    if not np.isfinite(points).all() or rng.random() < 0.08:
        start = rng.uniform((150, 100), (PICTURE_PX[0] - 150, PICTURE_PX[1] - 100))
        angle, length = rng.uniform(-math.pi, math.pi), SPAN_PX * math.exp(rng.normal(0.0, 0.3))
        return np.array([start, start + length * np.array([math.cos(angle), math.sin(angle)])])
    sigma = np.hypot(*span) * (0.04 if rng.random() < 0.6 else 0.12)
    return points + rng.normal(0.0, sigma, size=(2, 2))


def _within(points: Points, size: tuple[int, int], edge: float) -> npt.NDArray[Any]:
    with np.errstate(invalid="ignore"):
        return np.asarray(((points >= edge) & (points <= np.array(size) - 1 - edge)).all(axis=-1))
