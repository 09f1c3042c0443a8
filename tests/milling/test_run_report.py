"""The report: one file, from the record alone, whatever is missing from it."""

import re
from pathlib import Path

import numpy as np
import pytest

from cli.reports.run_report import write_report
from drivers.errors import ConfigError
from firmware_sim.clock import SimClock
from milling.job import Job
from milling.record import RunRecorder

N = 8


def ring(z: float) -> list[list[float]]:
    theta = 2 * np.pi * np.arange(1, N + 1) / N
    return np.column_stack([5 + 2 * np.cos(theta), -10 + 2 * np.sin(theta), np.full(N, z)]).tolist()


def record(folder: Path, *, until: str = "outcome", text: str = "every point is through") -> None:
    clock = SimClock()
    recorder = RunRecorder(folder, {"seed": 1, "rig": "bench"}, clock)

    def stop_at(stage: str) -> bool:
        clock.sleep_s(1.0)
        return until == stage

    recorder.event("state", state="start", job=vars(Job(n_points=N)))
    if stop_at("start"):
        return recorder.close()
    recorder.frame("reference_left", np.full((540, 960, 3), 90, np.uint8))
    side = np.arange(-3.0, 3.1, 0.5)
    recorder.event("surface", x_mm=side + 5, y_mm=side - 10, z_mm=np.zeros((13, 13)) - 2.5, matches=9, measured=1.0)
    recorder.event(
        "trajectory",
        center_mm=[5, -10, -2.5],
        ball_mm=ring(-1.5),
        fit_mm=ring(-2.5),
        sigma_mm=[0.02] * N,
        offset_mm=0.5,
    )
    if stop_at("survey"):
        return recorder.close()
    theta = 2 * np.pi * np.arange(N) / N
    recorder.event(
        "ring",
        ring_px=np.column_stack([480 + 50 * np.cos(theta), 270 + 50 * np.sin(theta)]),
        radius_px=50,
        ring_mm=ring(-2.5),
    )
    for index in range(N):
        recorder.event("contact", point=index + 1, z_mm=-2.4, predicted_mm=-2.41)
    for lap in range(3):
        clock.sleep_s(2.5)
        recorder.event("load", torque=0.2, rpm=50_000, tip_mm=[5, -10, -2.5])
        recorder.event("lap", lap=lap, depth_mm=[0.1 * lap] * N, completion=[0.3 * lap] * N)
    if stop_at("laps"):
        return recorder.close()
    points = [
        {
            "depth_mm": 0.3,
            "completion": 1.0,
            "contact_mm": -2.4,
            "state": "done",
            "why": "x",
            "upper": None,
            "load_ratio": None,
            "permissions": {"bite": 3},
        }
    ] * N
    result = {"outcome": "complete", "reason": text, "milling_time_s": 80.0, "laps": 3.0, "points": points}
    recorder.event("outcome", **result)
    recorder.close(result)
    return None


@pytest.mark.parametrize("until", ["start", "survey", "laps", "outcome"])
def test_a_record_that_ends_anywhere_makes_a_page(tmp_path: Path, until: str) -> None:
    record(tmp_path / "run", until=until)
    page = write_report(tmp_path / "run").read_text()
    assert ("complete" if until == "outcome" else "not finished") in re.sub(r"<style.*?</style>", "", page, flags=re.S)
    assert "None" not in page
    assert "NaN" not in page


def test_it_is_one_small_file_that_fetches_nothing(tmp_path: Path) -> None:
    record(tmp_path / "run")
    path = write_report(tmp_path / "run")
    page = path.read_text()
    assert path.stat().st_size < 6_000_000
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!data:)""", page)
    assert "http" not in page.replace("http://www.w3.org", "")


def test_words_of_the_record_are_text_and_never_markup(tmp_path: Path) -> None:
    record(tmp_path / "run", text="<script>alert(1)</script>")
    page = write_report(tmp_path / "run").read_text()
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


def test_no_run_no_report(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no run here"):
        write_report(tmp_path)
