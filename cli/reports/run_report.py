"""One run as one page: a self-contained HTML file from the record alone."""

import base64
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from cli.reports.chart import BOTTOM, HEIGHT, axes
from cli.reports.template import filled
from cli.study import study_told
from milling.labels import newest, read_labels
from milling.record import Run, read_run

CROP_RADII = 1.7
"""Half the side of the picture shown, in ring radii."""


def write_report(folder: Path) -> Path:
    """Write ``report.html`` into a run's folder.

    Raises:
        ConfigError: no readable record there.
    """
    path = folder / "report.html"
    path.write_text(render(read_run(folder)), encoding="utf-8")
    return path


def render(run: Run) -> str:
    """The page."""
    return filled("run_report.html", **page(run))


def page(run: Run) -> dict[str, Any]:
    """Everything that the template shows."""
    result = run.result or _last(run, "outcome") or {}
    job = (_last(run, "state", state="start") or {}).get("job", {})
    points = list(result.get("points") or [])
    laps = list(run.of_kind("lap"))
    contacts = list(run.of_kind("contact"))
    return {
        "folder": run.folder.name,
        "header": run.header,
        "study": study_told(run),
        "labels": newest(read_labels(run.folder)).values(),
        "chain": run.chain,
        "outcome": result.get("outcome", "not finished"),
        "reason": result.get("reason", "the record ends before the run did"),
        "damage": run.damage,
        "job": job,
        "result": result,
        "points": [{"number": index + 1, **point} for index, point in enumerate(points)],
        "figures": _figures(run, result, job, points, contacts),
        "picture": _ring_picture(run, points),
        "before": _picture(run, ["reference_left"]),
        "depth": _lines(laps, "depth_mm", "depth below contact, mm", job.get("thickness_high_mm", 0.6)),
        "completion": _heat(laps),
        "torque": _torque(run),
        "scene": _scene(run, contacts, points),
        "stages": [next(events) for _, events in itertools.groupby(run.of_kind("stage"), key=itemgetter("stage"))],
        "happenings": [event for event in run.events if event["kind"] in ("latched", "error", "bad_reading")],
    }


@dataclass(frozen=True)
class Figure:
    """A number beside its limit."""

    name: str
    value: str
    limit: str
    good: bool | None = None


def _figures(
    run: Run, result: dict[str, Any], job: dict[str, Any], points: list[dict[str, Any]], contacts: list[dict[str, Any]]
) -> list[Figure]:
    # Only a virtual bench draws its specimen from a seed.
    time = "milling time" if run.header.get("seed") is None else "milling time, simulated"
    found = [Figure(time, f"{result.get('milling_time_s', 0.0):.0f} s", "published, in mice: 2.1 ± 1.8 min")]
    verified = _last(run, "calibration.verified")
    if verified and job:
        off = sum(value**2 for value in verified["error_mm"]) ** 0.5
        found.append(_against("calibration, verified at one setpoint", off, job["calibration_gate_mm"], "mm"))
        found.append(_against("drill tip, verified", verified["error_px"], job["detection_gate_px"], "px"))
    trajectory = _last(run, "trajectory")
    if trajectory and job:
        worst = 2 * max(trajectory["sigma_mm"])
        found.append(_against("predicted error of the ring (95 %)", worst, trajectory["offset_mm"], "mm"))
    if contacts and trajectory:
        off = max(abs(event["z_mm"] - event["predicted_mm"]) for event in contacts)
        found.append(_against("contact against fitted surface, worst", off, trajectory["offset_mm"], "mm"))
    if points and job:
        deepest = max(point["depth_mm"] for point in points)
        found.append(_against("deepest point below its contact", deepest, job["thickness_high_mm"], "mm"))
        rate = job["feed_mm_s"] * min(job["bite_mm"], job["removal_rate_mm2_s"] / job["feed_mm_s"])
        found.append(_against("removal rate, at most", rate, job["removal_rate_mm2_s"], "mm²/s"))
    floor = _last(run, "floor")
    if floor:
        lowest = min((event["tip_mm"][2] for event in run.of_kind("load") if event.get("tip_mm")), default=None)
        value = "-" if lowest is None else f"{lowest:.3f} mm"
        good = None if lowest is None else lowest >= floor["read_back_mm"]
        found.append(Figure("lowest tip", value, f"controller's floor {floor['read_back_mm']:.3f} mm", good))
    looks = sum(event["stage"] == "look" for event in run.of_kind("stage"))
    pauses = sum(event.get("state") == "paused" for event in run.of_kind("state"))
    found.append(Figure("laps", f"{result.get('laps', 0.0):.1f}", f"at most {job.get('max_laps', '-')}"))
    found.append(Figure("looks with the drill aside", str(looks), "at least 1"))
    found.append(Figure("pauses for want of a fresh frame", str(pauses), "frames at most 100 ms old"))
    return found


def _against(name: str, value: float, limit: float, unit: str) -> Figure:
    return Figure(name, f"{value:.3f} {unit}", f"at most {limit:g} {unit}", value <= limit + 1e-9)


def _last(run: Run, kind: str, **fields: Any) -> dict[str, Any] | None:
    found = [event for event in run.of_kind(kind) if all(event.get(key) == value for key, value in fields.items())]
    return found[-1] if found else None


# Pictures.


def _picture(run: Run, names: Iterable[str]) -> str | None:
    """The last picture of the first name that has one, as a data address."""
    for name in names:
        event = _last(run, "frame", name=name)
        if event and (file := run.folder / event["file"]).exists():
            return "data:image/jpeg;base64," + base64.b64encode(file.read_bytes()).decode()
    return None


def _ring_picture(run: Run, points: list[dict[str, Any]]) -> dict[str, Any] | None:
    data, ring = _picture(run, ["look", "left", "reference_left"]), _last(run, "ring")
    size = run.header.get("size_px", [960, 540])
    if data is None or ring is None:
        return None if data is None else {"data": data, "box": f"0 0 {size[0]} {size[1]}", "marks": [], "size": size}
    places = ring["ring_px"]
    x, y = (sum(place[k] for place in places) / len(places) for k in (0, 1))
    half = CROP_RADII * ring["radius_px"]
    marks = [
        {
            "x": place[0],
            "y": place[1],
            "label_x": x + 1.32 * (place[0] - x),
            "label_y": y + 1.32 * (place[1] - y),
            "number": index + 1,
            "color": _color(points[index]["completion"]) if points else "#888",
            "state": points[index].get("state", "") if points else "",
        }
        for index, place in enumerate(places)
    ]
    return {
        "data": data,
        "box": f"{x - half:.1f} {y - half:.1f} {2 * half:.1f} {2 * half:.1f}",
        "marks": marks,
        "size": size,
    }


def _lines(laps: list[dict[str, Any]], key: str, title: str, limit: float) -> dict[str, Any] | None:
    if len(laps) < 2:
        return None
    top = max(limit, *(max(lap[key]) for lap in laps))
    place, across, up = axes(laps[0]["t"], laps[-1]["t"], 0.0, top)
    n = len(laps[0][key])
    lines = [
        {
            "color": f"hsl({360 * index / n:.0f} 70% 50%)",
            "name": f"point {index + 1}",
            "points": " ".join("{},{}".format(*place(lap["t"], lap[key][index])) for lap in laps),
        }
        for index in range(n)
    ]
    bound = {"y": place(laps[0]["t"], limit)[1], "text": f"limit {limit:g} mm"}
    return {"title": title, "lines": lines, "across": across, "up": up, "bound": bound}


def _heat(laps: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Completion as colour: time across, points up."""
    if len(laps) < 2:
        return None
    n = len(laps[0]["completion"])
    place, across, _ = axes(laps[0]["t"], laps[-1]["t"], 0.0, float(n))
    cells = []
    for lap, following in itertools.pairwise(laps):
        x0, x1 = place(lap["t"], 0)[0], place(following["t"], 0)[0]
        for index, value in enumerate(lap["completion"]):
            y = place(0, index + 1)[1]
            height = (HEIGHT - BOTTOM - 8) / n
            cells.append(
                {"x": x0, "y": y, "w": round(x1 - x0 + 0.3, 1), "h": round(height + 0.3, 2), "color": _color(value)}
            )
    up = [{"at": place(0, value - 0.5)[1], "text": str(value)} for value in range(1, n + 1, max(1, n // 8))]
    return {"cells": cells, "across": across, "up": up}


def _torque(run: Run) -> dict[str, Any] | None:
    loads, idle = list(run.of_kind("load")), _last(run, "idle")
    if len(loads) < 2:
        return None
    top = max(event["torque"] for event in loads) * 1.1
    place, across, up = axes(loads[0]["t"], loads[-1]["t"], 0.0, top)
    line = " ".join("{},{}".format(*place(event["t"], event["torque"])) for event in loads)
    return {
        "line": line,
        "across": across,
        "up": up,
        "idle": None if idle is None else place(loads[0]["t"], idle["torque"])[1],
    }


def _color(completion: float) -> str:
    """Bone, then amber, then the red of the bed below."""
    stops = [(0.0, (232, 222, 200)), (0.6, (236, 170, 70)), (0.9, (214, 84, 60)), (1.0, (128, 20, 44))]
    value = min(max(completion, 0.0), 1.0)
    for (a, low), (b, high) in itertools.pairwise(stops):
        if value <= b:
            share = (value - a) / (b - a)
            red, green, blue = (round(p + share * (q - p)) for p, q in zip(low, high, strict=True))
            return f"rgb({red},{green},{blue})"
    return "rgb(128,20,44)"


def _scene(run: Run, contacts: list[dict[str, Any]], points: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The surface, the ring where the ball touched, and the ring at the depth reached; mm round the ring's centre."""
    surface, ring, trajectory = _last(run, "surface"), _last(run, "ring"), _last(run, "trajectory")
    if surface is None or trajectory is None:
        return None
    cx, cy, cz = trajectory["center_mm"]
    top = ring["ring_mm"] if ring else trajectory["fit_mm"]
    depth = [point["depth_mm"] for point in points] if len(points) == len(top) and contacts else [0.0] * len(top)

    def near(places: Iterable[Iterable[float]]) -> list[list[float]]:
        return [[round(x - cx, 3), round(y - cy, 3), round(z - cz, 3)] for x, y, z in places]

    return {
        "x": [round(x - cx, 3) for x in surface["x_mm"][::2]],
        "y": [round(y - cy, 3) for y in surface["y_mm"][::2]],
        "z": [[round(z - cz, 3) for z in row[::2]] for row in surface["z_mm"][::2]],
        "start": near([(x, y, z) for x, y, z in trajectory["ball_mm"]]),
        "top": near(top),
        "cut": near([(x, y, z - d) for (x, y, z), d in zip(top, depth, strict=True)]),
        "colors": [_color(point["completion"]) for point in points],
    }
