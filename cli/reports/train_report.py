"""One training as one page: worst cases, figures, and the losses on the way."""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from cli.reports.template import filled
from vision.training import History, Worst

LEFT, RIGHT, TOP, BOTTOM = 56.0, 750.0, 10.0, 205.0
"""The chart's edges in the template's units."""
DOTS = 240


def write_train_report(
    path: Path,
    title: str,
    about: Mapping[str, Any],
    figures: Mapping[str, float],
    history: History,
    worst: Sequence[Worst],
) -> None:
    """Write a self-contained page to ``path``."""
    cases = [{"data": _embedded(case.picture), "caption": case.caption} for case in worst]
    page = filled("train_report.html", title=title, about=about, figures=figures, worst=cases, chart=_chart(history))
    path.write_text(page, encoding="utf-8")


def _embedded(picture: npt.NDArray[np.uint8]) -> str:
    _, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _chart(history: History) -> dict[str, Any]:
    """Both curves on a logarithmic scale where the losses allow it."""
    losses = np.array(history.losses)
    parts = np.array_split(np.arange(len(losses)), min(DOTS, len(losses)))
    smooth = [(float(part.mean()) + 1.0, float(losses[part].mean())) for part in parts]
    checks = [(float(step), value) for step, value in history.checks]
    values = np.array([value for _, value in smooth + checks])
    low, high = float(values.min()), float(values.max())
    high = high if high > low else low + 1.0
    logarithmic = low > 0.0

    def up(value: float) -> float:
        share = np.log(value / low) / np.log(high / low) if logarithmic else (value - low) / (high - low)
        return BOTTOM - float(share) * (BOTTOM - TOP)

    def across(step: float) -> float:
        return LEFT + (RIGHT - LEFT) * step / len(losses)

    def line(dots: list[tuple[float, float]]) -> str:
        return " ".join(f"{across(step):.1f},{up(value):.1f}" for step, value in dots)

    marks = np.geomspace(low, high, 5) if logarithmic else np.linspace(low, high, 5)
    return {
        "losses": line(smooth),
        "checks": line(checks),
        "across": [{"at": across(step), "text": round(step)} for step in np.linspace(0, len(losses), 6)],
        "up": [{"at": up(value), "text": f"{value:.3g}"} for value in marks],
    }
