"""A short record with everything that a viewer shows, written by the recorder itself on the virtual clock."""

from pathlib import Path

import numpy as np
from a_calibration import a_calibration

from firmware_sim.clock import SimClock
from milling.job import Job
from milling.record import RunRecorder

N = 8
DATE = "2026-03-01T12:00:00+00:00"
AXIS_MM = (0.3, 0.0, 0.4)
"""From the drill's tip to its ball's centre."""


def ring(z_mm: float) -> list[list[float]]:
    """(N, 3) in {R}."""
    theta = 2 * np.pi * np.arange(1, N + 1) / N
    return np.column_stack([5 + 2 * np.cos(theta), -10 + 2 * np.sin(theta), np.full(N, z_mm)]).tolist()


def begin(folder: Path, clock: SimClock) -> RunRecorder:
    """A record up to the first contact, with its calibration."""
    header = {"rig": "bench", "date": DATE, "seed": 1, "identity": {"center_from_tip_mm": AXIS_MM}}
    recorder = RunRecorder(folder, header, clock)
    calibration = a_calibration()
    calibration.save(folder / "calibration.toml")
    image = np.random.default_rng(1).integers(0, 255, (54, 96, 3), dtype=np.uint8)
    recorder.event("state", state="start", job=vars(Job(n_points=N)))
    recorder.event("stage", stage="verify", detail="one setpoint")
    clock.sleep_s(1.5)
    recorder.frame("reference_left", image)
    recorder.frame("reference_right", image)
    heights = np.full((3, 4), 2.5)
    heights[1, 1] = np.nan
    recorder.event(
        "surface", x_mm=[3.0, 4.5, 5.5, 7.0], y_mm=[-12.0, -10.0, -8.0], z_mm=heights, matches=9, measured=1.0
    )
    recorder.event(
        "trajectory",
        center_mm=[5, -10, 2.5],
        ball_mm=ring(3.5),
        fit_mm=ring(2.5),
        sigma_mm=[0.02] * N,
        offset_mm=0.5,
        bregma_px=[400.0, 270.0],
        lambda_px=[520.0, 270.0],
        bregma_right_px=[390.0, 271.0],
        lambda_right_px=[510.0, 271.0],
    )
    left_px, _ = calibration.project(np.array(ring(2.5)))
    recorder.event("ring", ring_px=left_px, radius_px=50.0, ring_mm=ring(2.5))
    return recorder


def go_on(recorder: RunRecorder, clock: SimClock) -> None:
    """Two laps, a reason to go no deeper, and an end."""
    for point in range(1, N + 1):
        clock.sleep_s(0.5)
        recorder.event("contact", point=point, z_mm=2.49, predicted_mm=2.5)
    image = np.random.default_rng(2).integers(0, 255, (54, 96, 3), dtype=np.uint8)
    for lap in (1, 2):
        for point in range(1, N + 1):
            clock.sleep_s(0.25)
            recorder.event("load", torque=0.2, rpm=50_000.0, tip_mm=[*ring(2.4)[point - 1]])
            seen = [0.1 * lap] * (N - 1)
            recorder.event(
                "reading", age_s=0.04, completion=[*seen, None], upper=[*seen, None], shown="s" * (N - 1) + "h"
            )
            reason = "no fresh frame" if point == N else ""
            recorder.event("asked", point=point, bite_mm=0.05, frame_age_s=0.05, depth_mm=0.05 * lap, reason=reason)
            recorder.event("cut", point=point, depth_mm=0.05 * lap, age_s=0.01)
        recorder.frame("left", image)
        recorder.frame("right", image)
        recorder.event("lap", lap=float(lap), depth_mm=[0.05 * lap] * N, completion=[0.1 * lap] * N)
    recorder.event("latched", reaction="HOLD", reason="a person said stop")
    result = {"outcome": "held", "reason": "a person said stop", "milling_time_s": 9.0, "laps": 2.0, "points": []}
    recorder.event("outcome", **result)
    recorder.close(result)


def a_record(folder: Path) -> Path:
    """A whole one."""
    clock = SimClock()
    go_on(begin(folder, clock), clock)
    return folder
