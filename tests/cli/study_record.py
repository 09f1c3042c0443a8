"""Records of runs as `mill run` writes them, made without a bench."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from firmware_sim.clock import SimClock
from milling.job import Job
from milling.record import RunRecorder

N = 8
STUDY = {"specimen_id": "M12", "protocol": "P-7", "operator": "AK"}
HEADER: dict[str, Any] = {
    "command": "run",
    "version": "0.1.0",
    "date": "2026-05-04T09:00:00+00:00",
    "rig": "bench 7",
    "seed": None,
    "faults": [],
    "identity": {"motion": "Grbl 1.1h", "spindle": "drive", "camera": "left, right", "camera_settings": "fps 30"},
    "weights": {"tip": "a" * 64, "landmarks": "b" * 64, "completion": "c" * 64},
    "calibration": {"model": "perspective", "rmse_mm": 0.062, "predicted_rmse_mm": 0.05, "date": "2026-05-03"},
    "study": STUDY,
}


def study_record(folder: Path, *, depth_mm: float = 0.3, ended: bool = True, **header: Any) -> Path:
    """A window of eight points; killed in its second lap, or whole."""
    clock, job = SimClock(), Job(n_points=N)
    with RunRecorder(folder, {**HEADER, "job": asdict(job), **header}, clock) as record:
        record.event("state", state="start", job=asdict(job))
        record.event("calibration.verified", error_mm=[0.03, 0.04, 0.0], error_px=1.5)
        record.event("idle", torque=0.08, sigma=0.01)
        angle = 2 * np.pi * np.arange(1, N + 1) / N
        ring_px = np.column_stack([480 + 50 * np.cos(angle), 270 + 50 * np.sin(angle)])
        record.event("ring", ring_px=ring_px, radius_px=50, ring_mm=np.zeros((N, 3)))
        for point in range(1, N + 1):
            record.event("contact", point=point, z_mm=-2.4, predicted_mm=-2.41 + 0.001 * point)
        record.event("stage", stage="mill", detail="")
        record.event("state", state="milling", lap=0)
        record.frame("left", np.full((540, 960, 3), 90, np.uint8))
        for lap in (1, 2):
            for point in range(1, N + 1):
                clock.sleep_s(0.04)
                why = "no fresh frame" if point == 3 and lap == 2 else ""
                record.event("asked", point=point, bite_mm=0.03, frame_age_s=0.03, depth_mm=0.1 * lap, reason=why)
            record.event("load", torque=0.1 * lap, rpm=50_000.0, tip_mm=[1.0, 2.0, -2.5])
            state, cut_mm = ["open"] * N, [depth_mm * lap / 2] * N
            record.event(
                "lap", lap=lap, depth_mm=cut_mm, completion=[0.4 * lap] * N, upper=[0.5 * lap] * N, state=state
            )
        if not ended:
            return folder
        record.event("stage", stage="look", detail="")
        points = [
            {"depth_mm": depth_mm + 0.01 * index, "completion": 1.0, "contact_mm": -2.4, "state": "done", "why": "seen"}
            for index in range(N)
        ]
        points[1] |= {"completion": 0.9, "state": "stopped", "why": "the load is lost"}
        result = {"outcome": "complete", "reason": 'it is, with a "quote", and a comma', "milling_time_s": 81.6}
        result |= {"laps": 2.0, "points": points, "center_mm": [5.0, -10.0, -2.5], "radius_mm": 2.0}
        record.event("outcome", **result)
        record.close(result)
    return folder
