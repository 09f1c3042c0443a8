"""Records as a run leaves them, small: what the quick test of a page puts where its reader's own run would be."""

from dataclasses import asdict
from math import cos, pi, sin
from pathlib import Path

from firmware_sim.clock import SimClock
from milling.job import Job
from milling.record import RunRecorder

JOB = Job()
WHY = "every point is through, judged again with the drill aside"


def record(folder: Path, outcome: str | None = "complete", reason: str = WHY) -> None:
    """A ring that was touched, seen, asked about once, and is through; without an outcome, of a killed process."""
    clock = SimClock()
    header = {"rig": "virtual bench, seed 0", "date": "2026-05-04T09:00:00+00:00", "seed": None, "job": asdict(JOB)}
    angles = [2 * pi * k / JOB.n_points for k in range(1, JOB.n_points + 1)]
    with RunRecorder(folder, header, clock) as recorder:
        recorder.event("state", state="start", job=asdict(JOB))
        ring = [(5 + 2 * cos(angle), -10 + 2 * sin(angle), -2.5) for angle in angles]
        sigma = [0.02] * JOB.n_points
        recorder.event(
            "trajectory",
            center_mm=[5, -10, -2.5],
            tip_mm=ring,
            ball_mm=ring,
            fit_mm=ring,
            sigma_mm=sigma,
            offset_mm=0.5,
        )
        for number in range(1, JOB.n_points + 1):
            recorder.event("contact", point=number, z_mm=-2.5, predicted_mm=-2.5)
        bone = [0.1] * JOB.n_points
        recorder.event("reading", age_s=0.05, completion=bone, upper=bone, shown="s" * JOB.n_points)
        recorder.event("asked", point=3, bite_mm=0.013, frame_age_s=0.05, depth_mm=0.013, reason="")
        clock.sleep_s(90.0)
        if outcome is None:
            return
        point = {"depth_mm": 0.38, "completion": 1.0, "contact_mm": -2.5, "state": "done", "why": "through"}
        result = {"outcome": outcome, "reason": reason, "milling_time_s": 90.0, "laps": 30.0}
        result["points"] = [point | {"upper": 1.0, "load_ratio": 0.1, "permissions": {}}] * JOB.n_points
        recorder.event("outcome", **result)
        recorder.close(result)
