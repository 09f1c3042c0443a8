"""What somebody should know of a network before using it, on one page beside its weights."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cli.reports.template import filled

TOLD_FIRST = {
    "landmarks": (
        *("mean_mm", "median_mm", "worst_mm", "along_midline_mean_mm", "across_midline_mean_mm"),
        *("bregma_missed", "lambda_missed", "swapped"),
    ),
    "tip": ("tip_rmse_px", "tip_median_px", "tip_worst_px", "tip_missed", "tip_invented"),
    "completion": ("rmse", "upper_bound_coverage", "penetration_recall", "penetration_false_alarm"),
}
USED_FOR = {
    "landmarks": "Finds bregma and lambda in a picture of a mouse skull.",
    "tip": "Finds the centre of the drill's ball in a picture.",
    "completion": "Reads how far each point of a ring is milled, from the picture now and one before milling.",
}


def write_model_card(path: Path, name: str, entry: Mapping[str, Any]) -> None:
    """Write the card of the weights ``name``, of which the manifest beside them tells ``entry``."""
    task, figures = entry["task"], entry["held_out"]
    intervals = entry["held_out_95"]
    first = [key for key in TOLD_FIRST[task] if key in figures]
    data = entry.get("data", {})
    page = filled(
        "model_card.html",
        title=f"{name}: model card",
        used_for=USED_FOR[task],
        entry=entry,
        data=data,
        labels=data.get("train", {}).get("labels"),
        n=_judged_on(figures),
        figures=[(key, figures[key], intervals.get(key)) for key in [*first, *(k for k in figures if k not in first)]],
        first=len(first),
        limits=_limits(entry, name),
    )
    path.write_text(page, encoding="utf-8")


def _judged_on(figures: Mapping[str, float]) -> int:
    return int(figures.get("pictures", figures.get("rings", 0)))


def _limits(entry: Mapping[str, Any], name: str) -> list[str]:
    task, data, n = entry["task"], entry.get("data", {}), _judged_on(entry["held_out"])
    train = data.get("train", {})
    limits = []
    if train.get("source") == "photographs":
        limits.append(
            "Judged on pictures of the same album as it learnt from, a block of neighbours that was kept back. Other "
            "animals, microscopes, light and strains are not measured: "
            f"mill evaluate {task} --data OTHER --weights {name}"
        )
    else:
        limits.append(
            "Learnt from and judged on renderings of the virtual bench: this is simulation, and none of it says "
            "anything about tissue."
        )
    if n:
        unseen = 1 - 0.05 ** (1 / n)
        limits.append(
            f"What was not seen among {n} samples may still happen in up to {unseen:.0%} of others. The 95 % intervals "
            "are over samples as if each were by itself; neighbours of one animal make them too narrow."
        )
    if "mean_mm" in entry["held_out"]:
        limits.append("Millimetres take the distance from bregma to lambda for 4.2 mm in every picture.")
    if labels := train.get("labels"):
        limits += _of_labels(labels)
    elif train.get("source") == "photographs":
        limits.append("Who labelled the pictures, and how far people differ over them, is not known.")
    if task == "completion" and train.get("source") == "photographs":
        limits.append(
            "Completion was painted by eye along a circle; the kerf's outline was not, and its box is not measured."
        )
    limits.append("For research. Not a medical device.")
    return limits


def _of_labels(labels: Mapping[str, Any]) -> list[str]:
    limits = []
    if not labels["apart"]:
        limits.append("One person's labels, or none twice: how far people differ over these pictures is not known.")
    for row in labels["apart"]:
        far = f"{row['mean_px']:.1f} px" + (f" ({row['mean_mm']:.3f} mm)" if "mean_mm" in row else "")
        limits.append(
            f"{' and '.join(row['between'])} differ by {far} over {row['what']}, mean of {row['n']} pictures: a figure "
            "below that says nothing about the truth."
        )
    accepted, total = labels["origins"].get("accepted", 0), sum(labels["origins"].values())
    if accepted:
        limits.append(
            f"{accepted} of {total} labels are a network's suggestions, accepted as they were: as far as they go, "
            "networks agree with networks."
        )
    return limits
