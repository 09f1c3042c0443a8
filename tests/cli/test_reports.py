"""The pages that people look at: whole, self-contained, and saying what was measured."""

from pathlib import Path

import numpy as np
import pytest

from calib.calibration_file import Calibration, RigIdentity, Setpoint
from calib.camera_fit import fit_camera_pair
from cli.reports.calibration_report import write_calibration_report
from cli.reports.study_report import write_study_report
from studies import completion_trials


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    """Of a microscope that looks straight down; the eyes were far off at one setpoint, which is left out."""
    points_mm = np.random.default_rng(0).uniform((0.0, -20.0, 0.0), (10.0, 0.0, 10.0), (16, 3))
    across_px, down_px = 480.0 + (points_mm[:, 1] + 10.0) / 0.0395, 270.0 + (points_mm[:, 0] - 5.0) / 0.0395
    left, right = (
        np.column_stack([across_px + sign * 3.2 * points_mm[:, 2], down_px]).round(1) for sign in (1.0, -1.0)
    )
    left[3] += 9.0
    fit = fit_camera_pair(points_mm, left, right, size_px=(960, 540), detector_sigma_px=0.3)
    setpoints = tuple(
        Setpoint(
            point_mm=tuple(points_mm[k].tolist()),
            left_px=tuple(left[k].tolist()),
            right_px=tuple(right[k].tolist()),
            residual_mm=tuple(fit.residuals_mm[k].tolist()),
            leave_one_out_mm=float(fit.leave_one_out_mm[k]),
            used=bool(fit.used[k]),
        )
        for k in range(16)
    )
    rig = RigIdentity(motion="stage <7>", camera="eyes L1 R2")
    return Calibration(
        fit.pair, "default", fit.model, fit.candidates_mm, "right-handed", False, fit.rmse_mm, setpoints, rig
    )


def test_a_calibrations_page_names_what_was_left_out(calibration: Calibration, tmp_path: Path) -> None:
    file, page = tmp_path / "rig.toml", tmp_path / "rig.html"
    write_calibration_report(page, calibration, file, 31.4)
    text = page.read_text(encoding="utf-8")
    assert text.count("<td>left out</td>") == len(calibration.outliers) == 1
    assert "15 of 16" in text
    assert f"{calibration.rmse_mm:.3f} mm" in text
    assert "31 s" in text
    assert "stage &lt;7&gt;" in text, "names come from devices: they are text and never markup"
    assert 'src="http' not in text, "a page needs no network"


def test_a_studys_page_tells_simulation_from_the_paper(tmp_path: Path) -> None:
    shifts = {shift: {"mape": 0.12, "mape_low": 0.1, "mape_high": 0.15} for shift in completion_trials.SHIFTS[1:]}
    recipes = {"default": {"trials": 2, "mape": 0.1, "mape_low": 0.08, "mape_high": 0.12, "shifts": shifts}}
    page = tmp_path / "report.html"
    write_study_report(page, "completion", recipes, completion_trials.PUBLISHED, {"a": {"mape": 0.1, "recipe": "x"}})
    text = page.read_text(encoding="utf-8")
    assert "This is simulation" in text
    assert "0.1 (0.08 to 0.12)" in text
    assert "0.2432" in text
    assert all(f"<td>{shift}</td>" in text for shift in shifts)
    assert 'src="http' not in text
