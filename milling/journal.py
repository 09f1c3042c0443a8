"""What a lap and a run's end tell of every point: to the record, and to whoever watches."""

from typing import Any

from milling.laps import Laps, Permits
from milling.permission import Ledger
from milling.result import Progress


def lap_told(laps: Laps, n_points: int, elapsed_s: float) -> tuple[dict[str, Any], Progress]:
    """The event of a lap, and the same for people."""
    permits = laps.permits
    depth = tuple(permits.cut_mm(index) for index in range(n_points))
    completion = tuple(permits.completion(index) for index in range(n_points))
    points = permits.points if isinstance(permits, Ledger) else []
    state = tuple(point.state.value for point in points)
    told = {
        "lap": round(laps.laps, 3),
        "depth_mm": depth,
        "completion": completion,
        "upper": [point.upper for point in points],
        "load_ratio": [point.load_ratio for point in points],
        "left_probability": [point.left_probability for point in points],
        "state": state,
        "torque": laps.torque,
    }
    return told, Progress("mill", "", laps.laps, depth, completion, state, laps.torque, elapsed_s)


def points_told(permits: Permits, top_z_mm: list[float]) -> tuple[dict[str, Any], ...]:
    """One object per point: how deep, what was seen, and where it was guarded, everything that was known."""
    points: list[dict[str, Any]] = []
    for index, contact_mm in enumerate(top_z_mm):
        entry: dict[str, Any] = {"depth_mm": permits.cut_mm(index), "completion": permits.completion(index)}
        if isinstance(permits, Ledger):
            point = permits.points[index]
            entry |= {
                "contact_mm": float(contact_mm),
                "upper": point.upper,
                "load_ratio": point.load_ratio,
                "left_probability": point.left_probability,
                "state": point.state.value,
                "why": point.why,
                "permissions": dict(point.verdicts),
            }
        points.append(entry)
    return tuple(points)
