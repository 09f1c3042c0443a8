"""Figures that say how good a reading is, whatever read it."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

IOU_STEPS = tuple(np.arange(0.5, 0.96, 0.05).round(2).tolist())
"""COCO's thresholds."""
MAPE_FROM = 0.05
RECALL_STEPS = np.linspace(0.0, 1.0, 101)


def by_tenths(errors: Floats, truth: Floats) -> dict[str, float]:
    """RMSE in each tenth of the true completion, and RMSE and MAPE with equal weight for each tenth.

    A run spends little time near the end and a rendering much: equal weights make both say the same. MAPE leaves out
    what is less than 0.05, where a percentage means nothing. Tenths without a sample count for nothing.
    """
    tenth = np.clip((truth * 10).astype(int), 0, 9)
    squares, shares = [], []
    figures: dict[str, float] = {}
    for k in range(10):
        mine = tenth == k
        if mine.any():
            squares.append(float(np.mean(errors[mine] ** 2)))
            figures[f"rmse_tenth_{k}"] = float(np.sqrt(squares[-1]))
        begun = mine & (truth >= MAPE_FROM)
        if begun.any():
            shares.append(float(np.mean(np.abs(errors[begun]) / truth[begun])))
    return {
        "rmse_by_tenths": float(np.sqrt(np.mean(squares))) if squares else float("nan"),
        "mape_from_0.05_by_tenths": float(np.mean(shares)) if shares else float("nan"),
        **figures,
    }


def iou(one: tuple[float, float, float, float], two: tuple[float, float, float, float]) -> float:
    """Intersection over union of two boxes x0, y0, x1, y1."""
    width = min(one[2], two[2]) - max(one[0], two[0])
    height = min(one[3], two[3]) - max(one[1], two[1])
    if width <= 0 or height <= 0:
        return 0.0
    both = width * height
    return both / (area(one) + area(two) - both)


def area(box: tuple[float, float, float, float]) -> float:
    """Of a box x0, y0, x1, y1."""
    return (box[2] - box[0]) * (box[3] - box[1])


def average_precision(ious: Floats, scores: Floats, truths: int, threshold: float) -> float:
    """COCO's 101-point average precision of at most one box per picture.

    Args:
        ious: of each box found with its picture's true box; 0 where the picture has none.
        scores: how sure the finder was of each.
        truths: how many pictures have a box.
        threshold: IoU from which a box counts as found.
    """
    if truths == 0:
        return float("nan")
    hit = (ious >= threshold)[np.argsort(-scores, kind="stable")]
    recall = np.cumsum(hit) / truths
    precision = np.cumsum(hit) / np.arange(1, len(hit) + 1)
    best_from_here = np.maximum.accumulate(precision[::-1])[::-1]
    place = np.searchsorted(recall, RECALL_STEPS, side="left")
    return float(np.mean([best_from_here[i] if i < len(recall) else 0.0 for i in place]))
