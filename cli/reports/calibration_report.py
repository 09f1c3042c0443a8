"""One calibration as one page: where the drill was seen and how far the fit is off there, then its figures."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calib.calibration_file import Calibration
from calib.procedure import RMSE_LIMIT_MM
from cli.reports.chart import Chart, Range
from cli.reports.template import filled

PAPER_RMSE_MM = 0.77
PAPER_TIP_RMSE_PX = 3.18
LONGER_PX, LONGER_MM = 40.0, 20.0
"""Residuals are drawn so many times as long as they are."""
ROOM_MM = 2.5
EYES = ("left", "right")

Floats = npt.NDArray[np.float64]


def write_calibration_report(path: Path, calibration: Calibration, file: Path, duration_s: float) -> None:
    """Write a self-contained page to ``path`` about the calibration that was saved as ``file``."""
    page = filled(
        "calibration_report.html",
        calibration=calibration,
        file=file,
        figures=_figures(calibration, duration_s),
        setpoints=[_row(calibration, index) for index in range(len(calibration.setpoints))],
        panels=_panels(calibration),
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
        ("where the drill was seen, off the fit (RMSE)", f"{error_px:.2f} px", "", f"{PAPER_TIP_RMSE_PX:g} px"),
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


def _panels(calibration: Calibration) -> list[dict[str, Any]]:
    """Both pictures, and the box from above and from the side; each setpoint with its residual, much enlarged."""
    left_px, right_px = _pixel_errors(calibration)
    points = np.array([setpoint.point_mm for setpoint in calibration.setpoints])
    residuals = np.array([setpoint.residual_mm for setpoint in calibration.setpoints])
    seen_left, seen_right = (np.array([getattr(s, f"{eye}_px") for s in calibration.setpoints]) for eye in EYES)
    center_px = calibration.pair.optics.center_px
    picture: tuple[Range, Range] = ((0.0, 2 * center_px[0]), (2 * center_px[1], 0.0))
    above, side = _room(points[:, :2]), _room(points[:, 1:])
    used = [setpoint.used for setpoint in calibration.setpoints]
    return [
        _panel("left picture, px", seen_left, left_px, LONGER_PX, picture, used),
        _panel("right picture, px", seen_right, right_px, LONGER_PX, picture, used),
        _panel("from above: x and y, mm", points[:, :2], residuals[:, :2], LONGER_MM, above, used),
        _panel("from the side: y and z, mm", points[:, 1:], residuals[:, 1:], LONGER_MM, side, used),
    ]


def _panel(
    title: str, start: Floats, off: Floats, longer: float, ranges: tuple[Range, Range], used: list[bool]
) -> dict[str, Any]:
    chart = Chart(*ranges, width=520.0, height=330.0, even=True)
    marks = []
    for place, end, good in zip(start.tolist(), (start + longer * off).tolist(), used, strict=True):
        x, y = chart.at(place[0], place[1])
        to_x, to_y = chart.at(end[0], end[1])
        marks.append({"x": x, "y": y, "to_x": to_x, "to_y": to_y, "used": good})
    return {"title": title, "chart": chart, "marks": marks, "longer": f"{longer:g}"}


def _room(points: Floats) -> tuple[Range, Range]:
    """Both ranges of points (n, 2), with some room for their lines."""
    low, high = points.min(axis=0) - ROOM_MM, points.max(axis=0) + ROOM_MM
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
