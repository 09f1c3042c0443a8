"""What the completion network learns from, and how it is judged.

The label of a place along the strip is the bone removed along the kerf's centre line there, wherever across the strip
the kerf lies: the reading must not hinge on a pixel.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.completion import (
    DRILL_NOT_EXCLUDED,
    HOLE_NOT_EXCLUDED,
    MARGIN,
    MISSING,
    THROUGH,
    bounded,
    box_of,
    probability,
)
from vision.completion_network import CompletionNet
from vision.runtime import Floats, Image, Network
from vision.samples import Arrays, Data, relit
from vision.scores import IOU_STEPS, average_precision, by_tenths, iou
from vision.strip import ACROSS_PX, ALONG_PX, CELL_PX, CELLS, unroll
from vision.training import Batch, Recipe, Worst

STORED_PX = 64
"""Rows of the stored strips: more than the network's, for rings that lie off the kerf."""
SPARE_PX = (STORED_PX - ACROSS_PX) // 2
OFF_PX = 2.0
"""How far rings lie off the kerf in training (standard deviation of each coordinate of the middle, in strip pixels)."""
BOUND = 0.975
"""Share of truths that the upper bound must cover."""
CAUTION = 0.98
"""Share it is calibrated for, so that another set of specimens still is covered."""
RELIT = 0.6
"""Share of the strips that are seen under another light than the one they were rendered in."""
GREY = 0.15
"""Share whose colours are faded, all the way to grey."""
LEAST_TRUTH = 0.05
"""Errors count in relation to the true completion, but to no less than this."""
KERF_FROM = 0.02
"""Completion from which there is a kerf."""
LEVELS = 250.0
HIDDEN = 255
"""In ``maps``: the value of completion 1, and that of a pixel that the drill hides."""
UNKNOWN = -1.0
"""Share of kerf in a cell of which the drill hides some."""
BETWEEN_PX = 8

_ARRAYS: Arrays = {
    "strips": ((STORED_PX, ALONG_PX, 6), "u"),
    "maps": ((STORED_PX, ALONG_PX), "u"),
    "completions": ((CELLS[1],), "f"),
    "hidden": ((CELLS[1],), "b"),
    "rings_px": ((CELLS[1], 2), "f"),
    "balls_px": ((), "f"),
    "boxes_px": ((4,), "f"),
}


class CompletionTask:
    """Read the ring.

    Data: ``strips`` (N, 64, 320, 6) uint8, now and before; ``maps`` (N, 64, 320) uint8, completion x 250, 255 under the
    drill; at the middle of each cell along the strip ``completions`` (N, 80), ``hidden`` (N, 80) bool and ``rings_px``
    (N, 80, 2) px of the picture; ``balls_px`` (N,); ``boxes_px`` (N, 4) of the kerf, NaN where there is none.
    """

    name = "completion"
    recipes: Mapping[str, Recipe] = {"default": Recipe(steps=4500, batch=24, learning_rate=3e-3)}

    arrays = _ARRAYS

    def network(self) -> nn.Module:
        """A fresh network."""
        return CompletionNet()

    def batch(self, data: Data, size: int, rng: np.random.Generator) -> Batch:
        """Strips that begin anywhere on the ring and lie off the kerf, under changed light, some without reference."""
        chosen = [_sample(data, int(index), rng) for index in rng.integers(len(data["strips"]), size=size)]
        names = ("strips", "kerfs", "maps", "completions", "hidden")
        return {
            name: torch.from_numpy(np.stack(values))
            for name, values in zip(names, zip(*chosen, strict=True), strict=True)
        }

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Completion, its quantile, what is drill and hole along the ring; kerf and completion across it."""
        line, maps = (answer.float() for answer in network(batch["strips"]))
        truth, shown = batch["completions"], 1.0 - batch["hidden"]
        weight = shown / (truth + LEAST_TRUTH)
        weight = weight / weight.sum()
        estimate = (functional.smooth_l1_loss(line[:, 0], truth, beta=0.01, reduction="none") * weight).sum()
        short = truth - (line[:, 0].detach() + line[:, 1] - line[:, 0])
        bound = (torch.maximum(BOUND * short, (BOUND - 1.0) * short) * weight).sum()
        drill = functional.binary_cross_entropy_with_logits(line[:, 2], batch["hidden"])
        hole = functional.binary_cross_entropy_with_logits(line[:, 3], (truth >= 0.999).float(), reduction="none")
        along = (hole * shown).sum() / shown.sum().clamp(min=1)
        seen = batch["kerfs"] != UNKNOWN
        kerf = batch["kerfs"] * seen
        drawn = functional.binary_cross_entropy_with_logits(maps[:, 0], kerf, reduction="none")
        drawn = (drawn * seen).sum() / seen.sum().clamp(min=1)
        depth = ((maps[:, 1] - batch["maps"]).abs() * kerf).sum() / kerf.sum().clamp(min=1)
        total: Tensor = 10.0 * estimate + 4.0 * bound + 2.0 * along + 0.5 * drill + 0.5 * drawn + 0.3 * depth
        return total

    def example(self, data: Data) -> dict[str, Tensor]:
        """A strip."""
        return {"strips": torch.from_numpy(data["strips"][:1, SPARE_PX:-SPARE_PX].copy())}

    def calibrate(self, network: Network, data: Data) -> dict[str, float]:
        """``upper_margin``: what must be added to the quantile head so that held-out truth stays below (conformal)."""
        read = self._read(network, data)
        seen = ~read["hidden"].astype(bool)
        short = np.where(read["hole"] >= HOLE_NOT_EXCLUDED, -1.0, read["truth"] - read["upper"])[seen]
        # Truth of 1 is bounded by 1 whatever is added, so a bound may fall short there only by missing the hole.
        return {MARGIN: float(np.quantile(short, CAUTION))}

    def judge(self, network: Network, data: Data) -> dict[str, float]:
        """Error, coverage of the bound, its tightness, penetration, visibility and the kerf's box.

        A share of nothing, as on a handful of rings, counts as 1.
        """
        return self.judge_draws(network, data, [np.arange(len(data["strips"]))])[0]

    def judge_draws(
        self, network: Network, data: Data, draws: Iterable[npt.NDArray[np.int64]]
    ) -> list[dict[str, float]]:
        """The same of each of several draws of the rings."""
        read, margin = self._read(network, data), network.constants.get(MARGIN, 0.0)
        return [_figures({name: values[chosen] for name, values in read.items()}, margin) for chosen in draws]

    def worst(self, network: Network, data: Data, count: int) -> list[Worst]:
        """The strip: each place's colour is its error, from green (none) to red (0.3 and more)."""
        read = self._read(network, data)
        seen = ~read["hidden"].astype(bool)
        estimate, _ = bounded(read["completion"], read["upper"], read["hole"])
        errors = np.where(seen, estimate - read["truth"], 0.0)
        squares = (errors**2).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        cases = []
        for index in np.argsort(squares)[::-1][:count]:
            share = np.minimum(np.abs(errors[index]) / 0.3, 1.0)
            colors = np.stack([255 * share, 255 * (1 - share), np.full_like(share, 60)], axis=1)
            colors[~seen[index]] = 128
            bar = np.repeat(np.repeat(colors.astype(np.uint8)[None], CELL_PX[1], axis=1), 8, axis=0)
            strip = np.asarray(data["strips"][index])
            picture = cv2.resize(np.concatenate([bar, strip[..., :3], strip[..., 3:]]), None, fx=2, fy=2)
            caption = f"ring {index}, now and before: RMSE {np.sqrt(squares[index]):.3f} (grey: hidden)"
            cases.append(Worst(picture.astype(np.uint8), caption))
        return cases

    def _read(self, network: Network, data: Data) -> dict[str, npt.NDArray[Any]]:
        names = ("completion", "upper", "drill", "hole")
        read: dict[str, list[Any]] = {name: [] for name in (*names, "box_iou", "box_score", "has_box")}
        for index in range(len(data["strips"])):
            strip = np.asarray(data["strips"][index, SPARE_PX:-SPARE_PX])
            (line,), (maps,) = network.run(strips=strip[None])
            for name, values in zip(names, line, strict=True):
                read[name].append(values)
            found = box_of(maps[0], unroll(data["rings_px"][index], float(data["balls_px"][index])))
            true = np.asarray(data["boxes_px"][index])
            has = bool(np.isfinite(true).all())
            read["has_box"].append(has)
            x0, y0, x1, y1 = (float(value) for value in true)
            read["box_iou"].append(iou(found, (x0, y0, x1, y1)) if has and found is not None else 0.0)
            # NaN: no box was found.
            read["box_score"].append(math.nan if found is None else float(probability(maps[0][maps[0] > 0]).mean()))
        result = {name: np.array(values, dtype=np.float64) for name, values in read.items()}
        return {
            **result,
            "drill": probability(result["drill"]),
            "hole": probability(result["hole"]),
            "truth": np.asarray(data["completions"]),
            "hidden": np.asarray(data["hidden"]),
        }


def _figures(read: Mapping[str, npt.NDArray[Any]], margin: float) -> dict[str, float]:
    """Of what was read of some rings."""
    seen = ~read["hidden"].astype(bool)
    covered = read["drill"] >= DRILL_NOT_EXCLUDED
    truth, estimate = read["truth"][seen], read["completion"][seen]
    estimate, upper = bounded(estimate, read["upper"][seen] + margin, read["hole"][seen])
    found = np.isfinite(read["box_score"])
    boxes = read["box_iou"][found], read["box_score"][found], int(read["has_box"].sum())
    hole, bone, begun = truth >= 0.999, truth <= 0.85, truth >= 0.05
    return {
        "rmse": float(np.sqrt(np.mean((estimate - truth) ** 2))) if truth.size else math.nan,
        "mape_from_0.05": _mean(np.abs(estimate - truth)[begun] / truth[begun]),
        "upper_bound_coverage": _mean(upper >= truth),
        "bite_permitted_up_to_0.85": _mean(upper[bone] < THROUGH),
        "penetration_recall": _mean(upper[hole] >= THROUGH),
        "penetration_false_alarm": _mean(estimate[bone] >= THROUGH),
        "hidden_recall": _mean(covered[~seen]),
        "hidden_false_alarm": _mean(covered[seen]),
        "box_ap50": average_precision(*boxes, 0.5),
        "box_ap50_95": float(np.mean([average_precision(*boxes, step) for step in IOU_STEPS])),
        **by_tenths(estimate - truth, truth),
        "rings": float(len(read["truth"])),
    }


def _sample(data: Data, index: int, rng: np.random.Generator) -> tuple[Image, Floats, Floats, Floats, Floats]:
    """One strip (48, 320, 6), and per cell its kerf, its completion, and along it completions and what is hidden."""
    stored, map_ = np.asarray(data["strips"][index]), np.asarray(data["maps"][index])
    angle = np.arange(ALONG_PX) * 2 * np.pi / ALONG_PX
    sigma = OFF_PX * rng.choice([1.0, 2.0], p=[0.8, 0.2])
    radius, x, y = rng.normal(0.0, sigma * np.array([0.5, 1.0, 1.0]))
    off = np.clip(radius + x * np.cos(angle) + y * np.sin(angle), -SPARE_PX, SPARE_PX)
    rows = (np.arange(ACROSS_PX)[:, None] + SPARE_PX + off[None]).astype(np.float32)
    columns = np.broadcast_to(np.arange(ALONG_PX, dtype=np.float32), rows.shape).copy()
    now, before = (cv2.remap(stored[..., part], columns, rows, cv2.INTER_LINEAR) for part in (_NOW, _BEFORE))
    now, before = _seen_otherwise(now.astype(np.uint8), before.astype(np.uint8), rng)
    nearest = cv2.remap(map_, columns, rows, cv2.INTER_NEAREST)
    depth, hidden = np.minimum(nearest / LEVELS, 1.0), _in_cells(nearest == HIDDEN) > 0
    kerf = np.where(hidden, UNKNOWN, _in_cells(depth > KERF_FROM))
    along = [data["completions"][index], data["hidden"][index]]
    begin, backwards = int(rng.integers(CELLS[1])), rng.random() < 0.5
    strip = np.roll(np.concatenate([now, before], axis=2), begin * CELL_PX[1], axis=1)
    turned = [np.roll(values, begin, axis=-1).astype(np.float32) for values in (kerf, _in_cells(depth), *along)]
    if backwards:
        strip, turned = strip[:, ::-1], [values[..., ::-1] for values in turned]
    return (np.ascontiguousarray(strip), *(np.ascontiguousarray(values) for values in turned))  # type: ignore[return-value]


_NOW, _BEFORE = slice(0, 3), slice(3, 6)


def _in_cells(plane: npt.NDArray[Any]) -> Floats:
    """Mean over the pixels of each cell."""
    across, along = CELL_PX
    return np.asarray(plane.reshape(CELLS[0], across, CELLS[1], along).mean(axis=(1, 3)))


def _seen_otherwise(now: Image, before: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Light that changes between the days changes both pictures; light that drifts, only one."""
    # Some rows between them, so that a blur leaves each by itself.
    both = np.concatenate([now, np.repeat(now[-1:], BETWEEN_PX, axis=0), before])
    if rng.random() < RELIT:
        both = relit(both, rng)
    if rng.random() < GREY:
        share = rng.uniform(0.3, 1.0)
        both = (both * (1.0 - share) + both.mean(axis=2, keepdims=True) * share).astype(np.uint8)
    now, before = both[:ACROSS_PX], both[-ACROSS_PX:]
    if rng.random() < 0.3:
        gain = np.exp(rng.normal(0.0, 0.04) + rng.normal(0.0, 0.02, size=3)).astype(np.float32)
        now = np.asarray(cv2.convertScaleAbs(now * gain), dtype=np.uint8)
    if rng.random() < 0.05:
        before = np.full_like(before, MISSING)
    return now, before


def _mean(values: npt.ArrayLike) -> float:
    values = np.asarray(values, dtype=np.float64)
    return float(values.mean()) if values.size else 1.0
