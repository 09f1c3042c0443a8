"""One calibration as one page: where the drill was seen and how far the fit is off there, then its figures."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calib.calibration_file import Calibration
from calib.procedure import RMSE_LIMIT_MM
from cli.reports.template import filled

PAPER_RMSE_MM = 0.77
LONGER_PX, LONGER_MM = 40.0, 20.0
"""Residuals are drawn so many times as long as they are."""
INK, LEFT_OUT = "#2563a8", "#b3262e"

Floats = npt.NDArray[np.float64]


def write_calibration_report(path: Path, calibration: Calibration, file: Path, duration_s: float) -> None:
    """Write a self-contained page to ``path`` about the calibration that was saved as ``file``."""
    page = filled(
        "calibration_report.html",
        calibration=calibration,
        file=file,
        figures=_figures(calibration, duration_s),
        setpoints=[_row(calibration, index) for index in range(len(calibration.setpoints))],
        drawing=_drawing(calibration),
    )
    path.write_text(page, encoding="utf-8")


def _figures(calibration: Calibration, duration_s: float) -> list[tuple[str, str, str, str]]:
    """Name, value, what is allowed, and the paper's own."""
    used = [setpoint for setpoint in calibration.setpoints if setpoint.used]
    left_px, right_px = (error[[s.used for s in calibration.setpoints]] for error in _pixel_errors(calibration))
    error_px = float(np.sqrt((np.concatenate([left_px, right_px]) ** 2).sum(axis=1).mean()))
    candidates = ", ".join(f"{name} {value:.3f}" for name, value in calibration.candidates_mm.items())
    return [
        ("held-out error at the setpoints (RMSE)", f"{calibration.rmse_mm:.3f} mm", f"{RMSE_LIMIT_MM:g} mm", ""),
        ("predicted over the box (RMSE)", f"{calibration.predicted_rmse_mm:.3f} mm", "", f"{PAPER_RMSE_MM:g} mm"),
        ("where the drill was seen, off the fit (RMSE)", f"{error_px:.2f} px", "", ""),
        ("setpoints in use", f"{len(used)} of {len(calibration.setpoints)}", "", "5"),
        ("model, chosen by held-out error in mm", f"{calibration.model} ({candidates})", "", "linear"),
        ("handedness", calibration.handedness, "right-handed", ""),
        ("took", f"{duration_s:.0f} s", "", ""),
    ]


def _row(calibration: Calibration, index: int) -> dict[str, Any]:
    setpoint = calibration.setpoints[index]
    sigma = calibration.sigma_at(np.array([setpoint.point_mm]))[0]
    return {
        "point": ", ".join(f"{value:.2f}" for value in setpoint.point_mm),
        "residual": ", ".join(f"{1000 * value:.0f}" for value in setpoint.residual_mm),
        "sigma": ", ".join(f"{1000 * value:.0f}" for value in sigma),
        "left_out": f"{1000 * setpoint.leave_one_out_mm:.0f}",
        "used": setpoint.used,
    }


def _pixel_errors(calibration: Calibration) -> tuple[Floats, Floats]:
    """(n, 2) fitted minus seen, in the left and in the right picture."""
    points = np.array([setpoint.point_mm for setpoint in calibration.setpoints])
    left, right = calibration.project(points)
    seen_left = np.array([setpoint.left_px for setpoint in calibration.setpoints])
    seen_right = np.array([setpoint.right_px for setpoint in calibration.setpoints])
    return left - seen_left, right - seen_right


def _drawing(calibration: Calibration) -> str:
    """Both pictures, and the box from above and from the side; each setpoint with its residual, much enlarged."""
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    left_px, right_px = _pixel_errors(calibration)
    points = np.array([setpoint.point_mm for setpoint in calibration.setpoints])
    residuals = np.array([setpoint.residual_mm for setpoint in calibration.setpoints])
    seen = [np.array([getattr(s, key) for s in calibration.setpoints]) for key in ("left_px", "right_px")]
    titles = ("left picture, px", "right picture, px", "from above: x and y, mm", "from the side: y and z, mm")
    picture = make_subplots(rows=2, cols=2, subplot_titles=titles, vertical_spacing=0.12)
    panels = [
        (seen[0], left_px * LONGER_PX),
        (seen[1], right_px * LONGER_PX),
        (points[:, :2], residuals[:, :2] * LONGER_MM),
        (points[:, 1:], residuals[:, 1:] * LONGER_MM),
    ]
    colors = [INK if setpoint.used else LEFT_OUT for setpoint in calibration.setpoints]
    for index, (start, arrow) in enumerate(panels):
        at = {"row": index // 2 + 1, "col": index % 2 + 1}
        ends = start + arrow
        lines_x = [value for pair in zip(start[:, 0], ends[:, 0], strict=True) for value in (*pair, None)]
        lines_y = [value for pair in zip(start[:, 1], ends[:, 1], strict=True) for value in (*pair, None)]
        picture.add_trace(go.Scatter(x=lines_x, y=lines_y, mode="lines", line={"color": "#8a8f99"}), **at)
        mark = {"size": 8, "color": colors}
        picture.add_trace(go.Scatter(x=start[:, 0], y=start[:, 1], mode="markers", marker=mark), **at)
        picture.update_xaxes(constrain="domain", **at)
        picture.update_yaxes(scaleanchor=f"x{index + 1 if index else ''}", constrain="domain", **at)
    for column in (1, 2):
        picture.update_xaxes(range=[0, 2 * calibration.pair.optics.center_px[0]], row=1, col=column)
        picture.update_yaxes(range=[2 * calibration.pair.optics.center_px[1], 0], row=1, col=column)
    picture.update_layout(height=760, showlegend=False, template="plotly_white", margin={"t": 40, "b": 20})
    return str(picture.to_html(full_html=False, include_plotlyjs="inline", config={"displayModeBar": False}))
