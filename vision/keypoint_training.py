"""What the tip network learns from, and how every keypoint network is judged."""

from collections.abc import Iterable, Mapping
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from drivers.errors import ConfigError
from vision.keypoints import PICTURE_PX, WINDOW_CELLS, Finder, Keypoint, TipFinder
from vision.networks import CELL_PX, COARSE, CROP_PX, KeypointNet, normalized, read_peak
from vision.runtime import Image, Network
from vision.samples import Arrays, Data, relit
from vision.training import Batch, Recipe, Worst

Found = tuple[Keypoint, npt.NDArray[Any], bool]

CROPS_PER_PICTURE = 3
COARSE_SIGMA_CELLS = 0.7
FINE_SIGMA_CELLS = 1.2
LEAST_ERROR_PX = 0.1
"""Smaller errors are as good."""
TURNED = 0.4
"""Share of the crops that are turned by up to ``TURN_DEG`` and scaled: rigs and heads are not all as drawn."""
TURN_DEG = 12.0
NEAR_PX = 24
"""The second look is trained on crops whose centre misses the point by at most this, as the first look may."""


class KeypointTask:
    """Find ``names`` in a picture.

    Data: ``pictures`` (N, 540, 960, 3) uint8, ``points`` (N, K, 2) px, NaN where outside the picture, and ``visible``
    (N, K) bool.
    """

    def __init__(self, name: str, names: tuple[str, ...], *, steps: int) -> None:
        self.recipes: Mapping[str, Recipe] = {"default": Recipe(steps=steps, batch=8, learning_rate=2e-3)}
        self.arrays: Arrays = {
            "pictures": ((PICTURE_PX[1], PICTURE_PX[0], 3), "u"),
            "points": ((len(names), 2), "f"),
            "visible": ((len(names),), "b"),
        }
        self.name = name
        self.names = names

    def network(self) -> nn.Module:
        """A fresh network."""
        return KeypointNet(len(self.names))

    def finder(self, network: Network) -> Finder:
        """What runs the exported network."""
        return TipFinder(network)

    def batch(self, data: Data, size: int, rng: np.random.Generator) -> Batch:
        """``size`` whole pictures, reduced, and some crops of each."""
        reduced, crops, targets, wanted, present = [], [], [], [], []
        coarse_targets, coarse_present = [], []
        for index in rng.integers(len(data["pictures"]), size=size):
            picture = data["pictures"][index]
            points, visible = data["points"][index], data["visible"][index]
            small = cv2.resize(picture, None, fx=1 / COARSE, fy=1 / COARSE, interpolation=cv2.INTER_AREA)
            small = cv2.copyMakeBorder(small, 0, 144 - small.shape[0], 0, 0, cv2.BORDER_REPLICATE)
            reduced.append(relit(small.astype(np.uint8), rng))
            coarse_targets.append(np.nan_to_num(points))
            coarse_present.append(visible)
            for _ in range(CROPS_PER_PICTURE):
                k = int(rng.integers(len(self.names)))
                corner = self._corner(points[k], rng)
                place = points[k] - corner
                inside = bool(visible[k]) and bool((place > 2).all() and (place < CROP_PX - 3).all())
                crop = np.asarray(picture[corner[1] : corner[1] + CROP_PX, corner[0] : corner[0] + CROP_PX])
                if inside and rng.random() < TURNED:
                    crop = _turned(picture, corner, points[k], rng)
                crops.append(relit(crop, rng))
                targets.append(place if inside else np.zeros(2))
                present.append(inside)
                wanted.append(k)
        return {
            "reduced": as_input(reduced),
            "coarse_targets": torch.tensor(np.array(coarse_targets), dtype=torch.float32),
            "coarse_present": torch.tensor(np.array(coarse_present)),
            "crops": as_input(crops),
            "targets": torch.tensor(np.array(targets), dtype=torch.float32),
            "present": torch.tensor(present),
            "point": torch.tensor(wanted),
        }

    def _corner(self, point: npt.NDArray[Any], rng: np.random.Generator) -> npt.NDArray[np.int64]:
        if np.isfinite(point).all() and rng.random() < 0.8:
            center = point + rng.uniform(-NEAR_PX, NEAR_PX, size=2)
        else:
            center = rng.uniform((0, 0), PICTURE_PX)
        corner = np.round(center - CROP_PX // 2).astype(np.int64)
        return np.clip(corner, 0, np.array(PICTURE_PX) - CROP_PX)

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Where it is (both looks), how exactly, how sure, and whether at all."""
        net = cast(KeypointNet, network)
        rough = rough_loss(net.look(batch["reduced"]).float(), batch["coarse_targets"], batch["coarse_present"])
        maps = net.look_closely(batch["crops"], batch["point"]).float()
        return rough + close_loss(maps, (batch["targets"] - 0.5) / CELL_PX, batch["present"])

    def example(self, data: Data) -> dict[str, Tensor]:
        """A picture."""
        return {"picture": torch.from_numpy(data["pictures"][0].copy())}

    def calibrate(self, network: Network, data: Data) -> dict[str, float]:
        """``sigma_scale`` makes the normalised error's 68 % quantile what a 2-D Gaussian has."""
        pairs = [(found, truth) for found, truth, seen in self._found(network, data) if seen and found.visible]
        ratios = [np.hypot(f.x_px - t[0], f.y_px - t[1]) / f.sigma_px for f, t in pairs]
        if not ratios:
            raise ConfigError("the network finds nothing on the validation pictures; its training was too short")
        return {"sigma_scale": float(np.quantile(ratios, 0.68) / np.sqrt(-2 * np.log(0.32)))}

    def judge(self, network: Network, data: Data) -> dict[str, float]:
        """RMSE over what was found, worst case, what was missed and what was invented."""
        return self.figures_of(self._found(network, data))

    def judge_draws(
        self, network: Network, data: Data, draws: Iterable[npt.NDArray[np.int64]]
    ) -> list[dict[str, float]]:
        """The same of each of several draws of the pictures."""
        found, points = self._found(network, data), len(self.names)
        return [self.figures_of([found[points * k + i] for k in chosen for i in range(points)]) for chosen in draws]

    def figures_of(self, found: list[Found]) -> dict[str, float]:
        """The figures of all pictures' points in turn, each with its true place and whether it can be seen."""
        figures: dict[str, float] = {}
        for k, name in enumerate(self.names):
            mine = found[k :: len(self.names)]
            errors = np.array([np.hypot(f.x_px - t[0], f.y_px - t[1]) for f, t, seen in mine if seen and f.visible])
            ratios = np.array(
                [np.hypot(f.x_px - t[0], f.y_px - t[1]) / f.sigma_px for f, t, seen in mine if seen and f.visible]
            )
            there = [f.visible for f, _, seen in mine if seen]
            absent = [f.visible for f, _, seen in mine if not seen]
            figures[f"{name}_rmse_px"] = float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")
            figures[f"{name}_median_px"] = float(np.median(errors)) if len(errors) else float("nan")
            figures[f"{name}_worst_px"] = float(errors.max()) if len(errors) else float("nan")
            figures[f"{name}_normalized_error"] = (
                float(np.sqrt(np.mean(ratios**2) / 2)) if len(errors) else float("nan")
            )
            figures[f"{name}_missed"] = 1.0 - float(np.mean(there)) if there else 0.0
            figures[f"{name}_invented"] = float(np.mean(absent)) if absent else 0.0
        figures["pictures"] = float(len(found) // len(self.names))
        return figures

    def worst(self, network: Network, data: Data, count: int) -> list[Worst]:
        """Round the true place: a cross where the point is, a circle where it was found."""
        found = self._found(network, data)
        off = [np.hypot(f.x_px - t[0], f.y_px - t[1]) if seen and f.visible else -1.0 for f, t, seen in found]
        cases = []
        for index in np.argsort(off)[::-1][:count]:
            if off[index] < 0:
                break
            keypoint, place, _ = found[index]
            picture = np.asarray(data["pictures"][index // len(self.names)])
            what = f"{self.names[index % len(self.names)]} in picture {index // len(self.names)}"
            cases.append(
                Worst(
                    _marked(picture, place, (keypoint.x_px, keypoint.y_px)),
                    f"{what}: off by {off[index]:.2f} px, sigma {keypoint.sigma_px:.2f} px",
                )
            )
        return cases

    def _found(self, network: Network, data: Data) -> list[Found]:
        finder = self.finder(network)
        return [
            (found, data["points"][index][k], bool(data["visible"][index][k]))
            for index in range(len(data["pictures"]))
            for k, found in enumerate(finder.find_all(np.asarray(data["pictures"][index])))
        ]


def _marked(picture: Image, truth: npt.NDArray[Any], found: tuple[float, float]) -> Image:
    """A square round the truth, enlarged, with both places drawn in."""
    scale, half = 3.0, 60.0
    side = round(2 * half * scale)
    affine = np.array([[scale, 0.0, scale * (half - truth[0])], [0.0, scale, scale * (half - truth[1])]])
    crop = cv2.warpAffine(picture, affine, (side, side), flags=cv2.INTER_CUBIC).astype(np.uint8)
    middle = (side // 2, side // 2)
    cv2.drawMarker(crop, middle, (80, 255, 120), cv2.MARKER_CROSS, 21, 1, cv2.LINE_AA)
    x, y = affine[:, :2] @ np.array(found) + affine[:, 2]
    if abs(x) < 1e4 and abs(y) < 1e4:
        cv2.circle(crop, (round(float(x)), round(float(y))), 9, (255, 200, 60), 1, cv2.LINE_AA)
    return crop


def _turned(picture: Image, corner: npt.NDArray[np.int64], point: npt.NDArray[Any], rng: np.random.Generator) -> Image:
    """The crop at ``corner``, with the picture turned and scaled a little about ``point``."""
    degrees, scale = rng.uniform(-TURN_DEG, TURN_DEG), np.exp(rng.uniform(-0.1, 0.1))
    affine = cv2.getRotationMatrix2D((float(point[0]), float(point[1])), degrees, scale)
    affine[:, 2] -= corner
    crop = cv2.warpAffine(picture, affine, (CROP_PX, CROP_PX), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    return crop.astype(np.uint8)


def rough_loss(heat: Tensor, points_px: Tensor, present: Tensor) -> Tensor:
    """Of (N, K, h, w) heat of the reduced picture, for (N, K, 2) places in the picture, where ``present``."""
    step = COARSE * CELL_PX
    return _mean_where(_cross_entropy(heat, (points_px - (step - 1) / 2) / step, COARSE_SIGMA_CELLS), present)


def close_loss(maps: Tensor, cells: Tensor, present: Tensor, window_cells: int = WINDOW_CELLS) -> Tensor:
    """Of (N, 3, h, w) maps of close looks, for (N, 2) places in cells, where ``present``."""
    fine = _mean_where(_cross_entropy(maps[:, :1], cells[:, None], FINE_SIGMA_CELLS)[:, 0], present)
    place, doubts = read_peak(maps, window_cells)
    log_sigma, visible = doubts.unbind(1)
    seen = functional.binary_cross_entropy_with_logits(visible, present.float())
    error = (_near(maps[:, 0], cells) - cells) * CELL_PX
    exact = _mean_where(functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none").sum(1), present)
    # The logarithm of the error is learnt, and scaled on validation data: the likelihood itself has gradients without
    # bound where a network is sure and wrong, and all else then stands still.
    missed = ((place - cells).detach() * CELL_PX).square().mean(1)
    sure = functional.smooth_l1_loss(log_sigma, 0.5 * torch.log(missed + LEAST_ERROR_PX**2), reduction="none")
    return fine + exact + _mean_where(sure, present) + seen


def as_input(pictures: list[Image]) -> Tensor:
    """(N, 3, H, W), normalised."""
    return normalized(torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2).float())


def _grid(heat: Tensor) -> tuple[Tensor, Tensor]:
    rows, columns = (torch.arange(size, dtype=torch.float32, device=heat.device) for size in heat.shape[-2:])
    return rows, columns


def _cross_entropy(heat: Tensor, cells: Tensor, sigma_cells: float) -> Tensor:
    """(N, K, h, w) log-probabilities against a Gaussian at (N, K, 2) cells -> (N, K)."""
    rows, columns = _grid(heat)
    y = torch.exp(-((rows - cells[..., 1:]) ** 2) / (2 * sigma_cells**2))
    x = torch.exp(-((columns - cells[..., :1]) ** 2) / (2 * sigma_cells**2))
    target = (y[..., :, None] * x[..., None, :]).flatten(2)
    target = target / target.sum(2, keepdim=True).clamp(min=1e-9)
    return -(target * functional.log_softmax(heat.flatten(2), dim=2)).sum(2)


def _near(heat: Tensor, cells: Tensor) -> Tensor:
    """Mean place of the (N, h, w) heat within a window round the true place -> (N, 2) cells."""
    rows, columns = _grid(heat)
    y = (rows - cells[:, 1:].round()).abs() <= WINDOW_CELLS
    x = (columns - cells[:, :1].round()).abs() <= WINDOW_CELLS
    window = y[:, :, None] & x[:, None, :]
    weight = torch.softmax(heat.masked_fill(~window, -1e4).flatten(1), dim=1).reshape(heat.shape)
    return torch.stack([(weight.sum(1) * columns).sum(1), (weight.sum(2) * rows).sum(1)], dim=1)


def _mean_where(values: Tensor, mask: Tensor) -> Tensor:
    return (values * mask).sum() / mask.sum().clamp(min=1)
