"""One training as one page: worst cases, figures, and the losses on the way."""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from cli.reports.chart import Chart
from cli.reports.template import filled
from vision.training import History, Worst

PAPER = {
    "tip_rmse_px": "3.18 px",
    "bregma_rmse_px": "1.19 px",
    "lambda_rmse_px": "1.73 px",
    "mape_from_0.05_by_tenths": "24.32 %, of truths it does not name",
}
"""The paper's own figures, each beside ours of the same kind."""
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
    page = filled(
        "train_report.html", title=title, about=about, figures=figures, worst=cases, paper=PAPER, **_curves(history)
    )
    path.write_text(page, encoding="utf-8")


def _embedded(picture: npt.NDArray[np.uint8]) -> str:
    _, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _curves(history: History) -> dict[str, Any]:
    """Both curves on a logarithmic scale where the losses allow it."""
    losses = np.array(history.losses)
    parts = np.array_split(np.arange(len(losses)), min(DOTS, len(losses)))
    smooth = [(float(part.mean()) + 1.0, float(losses[part].mean())) for part in parts]
    checks = [(float(step), value) for step, value in history.checks]
    values = [value for _, value in smooth + checks]
    low, high = min(values), max(values)
    ends = (low, high if high > low else low + 1.0)
    chart = Chart((0.0, float(len(losses))), ends, width=520.0, height=300.0, logarithmic=low > 0.0)
    return {"chart": chart, "losses": chart.line(smooth), "checks": chart.line(checks)}
