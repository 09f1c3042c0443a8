"""What the completion network learns from, and how it is judged.

The label of a ring point is the bone removed along the kerf's centre line, painted over a band as wide as the error
that the surface and the calibration may put into the ring: the reading must not hinge on a pixel.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.completion import (
    CROP_PX,
    DRILL_NOT_EXCLUDED,
    HOLE_NOT_EXCLUDED,
    MISSING,
    THROUGH,
    bounded,
    box_of,
    cell_from_crop,
    probability,
    sample,
)
from vision.networks import CELL_PX, CompletionNet
from vision.runtime import Floats, Network
from vision.samples import Arrays, Data, relit
from vision.scores import IOU_STEPS, average_precision, by_tenths, iou
from vision.training import Batch, Recipe, Worst

STORED_PX = 192
"""Side of the stored crops: wider than the network's, for jitter."""
BOUND = 0.975
"""Share of truths that the upper bound must cover."""
CAUTION = 0.98
"""Share it is calibrated for, so that another set of specimens still is covered."""
BAND_CELLS = 4
RELIT = 0.5
"""Share of the crops that are seen under another light than the one they were rendered in."""
COMPLETION, RING, DRILL, KERF, HOLE = range(5)
"""Planes of ``labels``."""


_ARRAYS: Arrays = {
    "crops": ((STORED_PX, STORED_PX, 6), "u"),
    "labels": ((STORED_PX // 2, STORED_PX // 2, 5), "u"),
    "rings_px": ((None, 2), "f"),
    "completions": ((None,), "f"),
    "hidden": ((None,), "b"),
}


class CompletionTask:
    """Read the ring.

    Data: ``crops`` (N, 192, 192, 6) uint8, ``labels`` (N, 96, 96, 5) uint8 (completion x 250, then flags: ring band,
    drill, kerf, through), ``rings_px`` (N, n, 2) px of the crop, ``completions`` (N, n), ``hidden`` (N, n) bool.
    """

    name = "completion"
    recipes: Mapping[str, Recipe] = {"default": Recipe(steps=2500, batch=16, learning_rate=2e-3)}

    arrays = _ARRAYS

    def network(self) -> nn.Module:
        """A fresh network."""
        return CompletionNet()

    def batch(self, data: Data, size: int, rng: np.random.Generator) -> Batch:
        """Crops with the ring off its middle, under changed light, some of them without a reference."""
        crops, labels = [], []
        spare = (STORED_PX - CROP_PX) // CELL_PX
        for index in rng.integers(len(data["crops"]), size=size):
            middle = spare / 2
            row, column = (int(np.clip(round(rng.normal(middle, 1.5)), 0, spare)) for _ in range(2))
            y, x = row * CELL_PX, column * CELL_PX
            crop = np.asarray(data["crops"][index, y : y + CROP_PX, x : x + CROP_PX])
            label = np.asarray(
                data["labels"][index, row : row + CROP_PX // CELL_PX, column : column + CROP_PX // CELL_PX]
            )
            if rng.random() < 0.5:
                crop, label = crop[:, ::-1], label[:, ::-1]
            seed = int(rng.integers(2**31))
            # Light that changes between the days changes both pictures; light that drifts, only one.
            both = [crop[..., :3], crop[..., 3:]]
            if rng.random() < RELIT:
                both = [relit(part, np.random.default_rng(seed)) for part in both]
            if rng.random() < 0.3:
                both[0] = _drifted(both[0], rng)
            if rng.random() < 0.05:
                both[1] = np.full_like(both[1], MISSING)
            crops.append(np.concatenate(both, axis=2))
            labels.append(label)
        return {
            "crops": torch.from_numpy(np.stack(crops)),
            "labels": torch.from_numpy(np.stack(labels).transpose(0, 3, 1, 2).copy()).float(),
        }

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Completion, its quantile, and what is kerf, drill and hole."""
        maps = network(batch["crops"]).float()
        labels = batch["labels"]
        truth = labels[:, COMPLETION] / 250.0
        shown = 1.0 - labels[:, DRILL]
        weight = shown * (labels[:, RING] + 0.1 * labels[:, KERF] + 0.02)
        weight = weight / weight.sum()
        estimate = (functional.smooth_l1_loss(maps[:, 0], truth, beta=0.05, reduction="none") * weight).sum()
        short = truth - (maps[:, 0].detach() + maps[:, 1] - maps[:, 0])
        pinball = (torch.maximum(BOUND * short, (BOUND - 1.0) * short) * weight).sum()
        kerf = functional.binary_cross_entropy_with_logits(maps[:, 2], labels[:, KERF])
        drill = functional.binary_cross_entropy_with_logits(maps[:, 3], labels[:, DRILL])
        through = functional.binary_cross_entropy_with_logits(maps[:, 4], labels[:, HOLE], reduction="none")
        return 4.0 * estimate + 4.0 * pinball + 0.3 * kerf + 0.5 * drill + (through * weight).sum()

    def example(self, data: Data) -> dict[str, Tensor]:
        """A crop."""
        first = (STORED_PX - CROP_PX) // 2
        return {"crops": torch.from_numpy(data["crops"][:1, first : first + CROP_PX, first : first + CROP_PX].copy())}

    def calibrate(self, network: Network, data: Data) -> dict[str, float]:
        """``upper_margin``: what must be added to the quantile head so that held-out truth stays below (conformal)."""
        read = self._read(network, data)
        seen = ~read["hidden"].astype(bool)
        short = np.where(read["through"] >= HOLE_NOT_EXCLUDED, -1.0, read["truth"] - read["upper"])[seen]
        # Truth of 1 is bounded by 1 whatever is added, so a bound may fall short there only by missing the hole.
        return {"upper_margin": float(np.quantile(short, CAUTION))}

    def judge(self, network: Network, data: Data) -> dict[str, float]:
        """Error, coverage of the bound, its tightness, penetration, visibility and the kerf's box.

        A share of nothing, as on a handful of rings, counts as 1.
        """
        read = self._read(network, data)
        seen = ~read["hidden"].astype(bool)
        margin = network.constants.get("upper_margin", 0.0)
        covered = probability(read["drill"]) >= DRILL_NOT_EXCLUDED
        truth, estimate = read["truth"][seen], read["completion"][seen]
        estimate, upper = bounded(estimate, read["upper"][seen] + margin, read["through"][seen])
        boxes = read["box_iou"], read["box_score"], int(read["has_box"].sum())
        hole, bone, begun = truth >= 0.999, truth <= 0.85, truth >= 0.05
        return {
            "rmse": float(np.sqrt(np.mean((estimate - truth) ** 2))),
            "mape_from_0.05": _mean(np.abs(estimate - truth)[begun] / truth[begun]),
            "upper_bound_coverage": float(np.mean(upper >= truth)),
            "bite_permitted_up_to_0.85": _mean(upper[bone] < THROUGH),
            "penetration_recall": _mean(upper[hole] >= THROUGH),
            "penetration_false_alarm": _mean(estimate[bone] >= THROUGH),
            "hidden_recall": _mean(covered[~seen]),
            "hidden_false_alarm": _mean(covered[seen]),
            "kerf_iou": _mean(read["iou"]),
            "box_ap50": average_precision(*boxes, 0.5),
            "box_ap50_95": float(np.mean([average_precision(*boxes, step) for step in IOU_STEPS])),
            **by_tenths(estimate - truth, truth),
            "rings": float(len(data["crops"])),
        }

    def worst(self, network: Network, data: Data, count: int) -> list[Worst]:
        """The ring's crop: each point's colour is its error, from green (none) to red (0.3 and more)."""
        read = self._read(network, data)
        seen = ~read["hidden"].astype(bool)
        estimate, _ = bounded(read["completion"], read["upper"], read["through"])
        errors = np.where(seen, estimate - read["truth"], 0.0)
        squares = (errors**2).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        cases = []
        for index in np.argsort(squares)[::-1][:count]:
            crop = np.asarray(data["crops"][index, ..., :3])
            large = cv2.resize(crop, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC).astype(np.uint8)
            for place, error, shown in zip(data["rings_px"][index], errors[index], seen[index], strict=True):
                share = min(abs(float(error)) / 0.3, 1.0)
                color = (round(255 * share), round(255 * (1 - share)), 60) if shown else (128, 128, 128)
                cv2.circle(large, (round(2 * float(place[0])), round(2 * float(place[1]))), 3, color, -1, cv2.LINE_AA)
            cases.append(Worst(large, f"ring {index}: RMSE {np.sqrt(squares[index]):.3f} (grey: hidden)"))
        return cases

    def _read(self, network: Network, data: Data) -> dict[str, npt.NDArray[Any]]:
        first = (STORED_PX - CROP_PX) // 2
        cell = first // CELL_PX
        names = ("completion", "upper", "kerf", "drill", "through")
        read: dict[str, list[Any]] = {name: [] for name in (*names, "iou", "box_iou", "box_score", "has_box")}
        for index in range(len(data["crops"])):
            crop = np.asarray(data["crops"][index, first : first + CROP_PX, first : first + CROP_PX])
            maps = network.run(crops=crop[None])[0][0]
            cells = cell_from_crop(np.asarray(data["rings_px"][index]) - first)
            for name, plane in zip(names, maps, strict=True):
                read[name].append(sample(plane, cells))
            kerf = np.asarray(data["labels"][index, cell:-cell, cell:-cell, KERF]) > 0
            found, true = box_of(maps[2] > 0), box_of(kerf)
            read["has_box"].append(true is not None)
            if found is not None:
                read["box_iou"].append(iou(found, true) if true is not None else 0.0)
                read["box_score"].append(float(probability(maps[2][maps[2] > 0]).mean()))
            if kerf.any():
                read["iou"].append((kerf & (maps[2] > 0)).sum() / (kerf | (maps[2] > 0)).sum())
        result = {name: np.array(values) for name, values in read.items()}
        return {
            **result,
            "through": probability(result["through"]),
            "truth": np.asarray(data["completions"]),
            "hidden": np.asarray(data["hidden"]),
        }


def paint_labels(
    ring_px: npt.NDArray[np.float64],
    completion: npt.NDArray[np.float64],
    completion_map: Floats,
    drill: npt.NDArray[np.bool_],
) -> npt.NDArray[np.uint8]:
    """Label planes of one stored crop.

    Args:
        ring_px: (n, 2) true centre line of the kerf in pixels of the crop.
        completion: (n,) removed share at each point.
        completion_map: (96, 96) removed share at each place, 0 where nothing is.
        drill: (96, 96) where the drill hides the bone.
    """
    cells = cell_from_crop(ring_px)
    label = np.zeros((*completion_map.shape, 5), np.uint8)
    label[..., COMPLETION] = np.round(250 * np.clip(completion_map, 0, 1))
    rows, columns = np.mgrid[: completion_map.shape[0], : completion_map.shape[1]]
    grid = np.stack([columns.ravel(), rows.ravel()], axis=1)
    distance = np.hypot(grid[:, None, 0] - cells[None, :, 0], grid[:, None, 1] - cells[None, :, 1])
    nearest = distance.argmin(axis=1)
    band = (distance.min(axis=1) <= BAND_CELLS).reshape(rows.shape)
    along = completion[nearest].reshape(rows.shape)
    label[..., COMPLETION][band] = np.round(250 * along[band])
    label[..., RING] = band
    label[..., DRILL] = drill
    label[..., KERF] = completion_map > 0.02
    label[..., HOLE] = np.where(band, along >= 0.999, completion_map >= 0.999)
    return label


def _drifted(picture: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    gain = np.exp(rng.normal(0.0, 0.04) + rng.normal(0.0, 0.02, size=3))
    return np.asarray(cv2.convertScaleAbs(picture * gain[None, None, :].astype(np.float32)), dtype=np.uint8)


def _mean(values: npt.ArrayLike) -> float:
    values = np.asarray(values, dtype=np.float64)
    return float(values.mean()) if values.size else 1.0
