"""What a page shows of a run: the newest of everything that its events have told. Live and from a record alike."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

MOST_ROWS = 1200
"""Of the curves; beyond it every other row goes."""
FAULTS = {
    "latched": "stopped",
    "error": "an error",
    "bad_reading": "a picture makes no sense",
    "calibration.missed": "the drill is not seen",
}
"""Kinds of event that tell of one, and what it is called where the event does not say."""
CHECK = ("name", "value", "unit", "limit", "verdict", "advice")
TIP_S = 0.3
"""From the newest place of the tip to a picture into which it is drawn, at most."""


class Optics(Protocol):
    """The part of a calibration that draws points."""

    def project(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Pixels in the left and the right picture of points in {R}."""


class Story:
    """Takes events as the record keeps them, and tells how things stand; everything is JSON."""

    def __init__(self) -> None:
        self._optics: Optics | None = None
        self._axis_mm = np.array([0.0, 0.0, 1.0])
        self._ball_mm = 0.5
        self._tips: list[tuple[float, Floats]] = []
        """The last three places of the tip."""
        self.now: dict[str, Any] = {
            "t": 0.0,
            "stage": "start",
            "detail": "",
            "state": "",
            "outcome": None,
            "tip_mm": None,
            "tip_px": None,
            "torque": None,
            "idle": None,
            "rpm": None,
            "spindle": "off",
            "age_s": None,
            "lap": None,
        }
        self.scene: dict[str, Any] = {
            "ring_px": None,
            "marks_px": [{}, {}],
            "limit_mm": None,
            "n": 0,
            "surface": None,
            "path_mm": None,
            "setpoints": [],
            "fit": None,
            "checks": [],
        }
        """What changes seldom; ``scene_number`` tells when it has."""
        self.scene_number = 0
        self.points: dict[str, list[Any]] = {}
        self.news: list[dict[str, Any]] = []
        self.rows: list[list[Any]] = []
        """Curves: t, depth (deepest, mean), torque, rpm, frame age."""
        self.contacts: list[list[float]] = []
        """t and height in mm, as they were found."""
        self.stopping = False
        """Whether the machine is being made safe, or has been."""

    def look_through(self, optics: Optics, center_from_tip_mm: Sequence[float]) -> None:
        """From now on places in mm are drawn into the pictures."""
        self._optics = optics
        self._axis_mm = np.asarray(center_from_tip_mm, dtype=np.float64)

    @property
    def over(self) -> bool:
        """Whether the run has told how it ended."""
        return self.now["outcome"] is not None

    def take(self, event: Mapping[str, Any]) -> None:
        """One event, in order. What is not known is passed over: the page of an older record lacks something."""
        now = self.now
        now["t"] = event.get("t", now["t"])
        match event["kind"]:
            case "state":
                self._state(event)
            case "stage":
                now["stage"], now["detail"] = event["stage"], event.get("detail", "")
            case "spindle":
                now["spindle"] = event["state"]
                self._tell(event, f"spindle {event['state']}", event.get("reason", ""))
            case "idle":
                now["idle"] = event["torque"]
            case "surface":
                self._surface(event)
            case "trajectory":
                self._trajectory(event)
            case "ring":
                self._ring(event)
            case "contact":
                self._point(event, contact=True)
                self.contacts.append([now["t"], event["z_mm"]])
            case "load":
                self._load(event)
            case "reading":
                self._reading(event)
            case "asked":
                self._point(event, permission=event["reason"])
            case "cut" | "left":
                self._point(event, depth=event["depth_mm"])
            case "stopped" | "done" | "reopened":
                state = "open" if event["kind"] == "reopened" else event["kind"]
                self._point(event, state=state, why=event["why"])
            case "lap":
                self._lap(event)
            case "outcome":
                self._outcome(event)
            case "calibration.setpoints":
                self._setpoints(event)
            case "calibration.sighting" | "calibration.missed":
                self._visited(event)
            case "calibration.fit":
                self._change(fit={name: event[name] for name in ("model", "rmse_mm", "predicted_rmse_mm")})
            case "check":
                self._change(checks=[*self.scene["checks"], {key: event[key] for key in CHECK if key in event}])
        self.stopping = self.stopping or self.over or event["kind"] == "latched"
        if event["kind"] in FAULTS:
            what = event.get("where") or event.get("reaction") or FAULTS[event["kind"]]
            self._tell(event, what, event["reason"])

    def pictured(self, t: float) -> None:
        """Pictures of both eyes were given at ``t``: draw the drill where it was then, by its last three places."""
        self.now["tip_px"] = None
        exposed_s = t - (self.now["age_s"] or 0.0)
        times = [tip_s for tip_s, _ in self._tips]
        if len(times) < 3 or self._optics is None or not 0.0 <= exposed_s - times[0] <= 3 * TIP_S:
            return
        # The parabola through them follows an arc of half a radian to a tenth of a millimetre.
        shares = [
            np.prod([(exposed_s - b) / (a - b) for b in times if b != a]) if times.count(a) == 1 else np.nan
            for a in times
        ]
        center = sum(share * tip for share, (_, tip) in zip(shares, self._tips, strict=True)) + self._axis_mm
        if not np.all(np.isfinite(center)):
            return
        self.now["tip_px"] = self._drawn([center, center + self._ball_mm * np.array([0.0, 1.0, 0.0])])

    def told_by_a_person(self, what: str, why: str) -> None:
        """A line of the news that no event tells."""
        self._tell({"kind": "person"}, what, why)

    def curve(self) -> list[Any]:
        """A row of the curves, as things stand; it is kept."""
        now = self.now
        depth = self.points.get("depth", [])
        deepest = max(depth, default=None)
        mean = sum(depth) / len(depth) if depth else None
        row = [now["t"], deepest, mean, now["torque"], now["rpm"], now["age_s"]]
        self.rows.append(row)
        if len(self.rows) > MOST_ROWS:
            del self.rows[1:-1:2]
        return row

    def told(self) -> dict[str, Any]:
        """How things stand, as JSON without NaN."""
        points = {name: list(values) for name, values in self.points.items()}
        told = {**self.now, "points": points}
        plain: dict[str, Any] = finite(told)
        return plain

    # One kind of event each.

    def _state(self, event: Mapping[str, Any]) -> None:
        state = event["state"]
        self.now["state"] = state
        if state == "start":
            job = event.get("job", {})
            self._ball_mm = job.get("ball_radius_mm", self._ball_mm)
            self._change(limit_mm=job.get("thickness_high_mm"))
            self._expect(int(job.get("n_points", 0)))
        elif state in ("paused", "lifted"):
            self._tell(event, f"drill {state}" if state == "lifted" else state, event.get("reason", ""))

    def _trajectory(self, event: Mapping[str, Any]) -> None:
        self._expect(len(event["fit_mm"]))
        marks = [
            {name: event[f"{name}{eye}_px"] for name in ("bregma", "lambda") if event.get(f"{name}{eye}_px")}
            for eye in ("", "_right")
        ]
        ring = self.scene["ring_px"] if self._optics is None else self._drawn(event["fit_mm"])
        self._change(marks_px=marks, ring_px=ring, path_mm=_rounded(event["fit_mm"]))

    def _ring(self, event: Mapping[str, Any]) -> None:
        drawn = None if self._optics is None else self._drawn(event["ring_mm"])[1]
        self._change(ring_px=[event["ring_px"], drawn])

    def _surface(self, event: Mapping[str, Any]) -> None:
        self._change(surface={axis: _rounded(event[f"{axis}_mm"]) for axis in ("x", "y", "z")})

    def _setpoints(self, event: Mapping[str, Any]) -> None:
        self._change(setpoints=[{"at_mm": place, "state": "waiting"} for place in event["targets_mm"]], fit=None)

    def _visited(self, event: Mapping[str, Any]) -> None:
        """The next setpoint that waits is the one: they are visited in order."""
        seen = event["kind"] == "calibration.sighting"
        visited = [dict(each) for each in self.scene["setpoints"]]
        for each in visited:
            if each["state"] == "waiting":
                each["state"] = "seen" if seen else "missed"
                break
        self._change(setpoints=visited)
        self.now["tip_mm"] = event["point_mm"] if seen else None
        # No circle: how large the ball is in a picture, only the calibration will tell.
        self.now["tip_px"] = [[event["left_px"]], [event["right_px"]]] if seen else None

    def _load(self, event: Mapping[str, Any]) -> None:
        now, tip = self.now, event.get("tip_mm")
        now["torque"], now["rpm"], now["tip_mm"] = event["torque"], event["rpm"], tip
        if tip is not None and len(tip) == 3:
            self._tips = [*self._tips[-2:], (now["t"], np.asarray(tip, dtype=np.float64))]

    def _reading(self, event: Mapping[str, Any]) -> None:
        self.now["age_s"] = event["age_s"]
        shown = event["shown"]
        self._expect(len(shown))
        self.points["shown"] = list(shown)
        for index, letter in enumerate(shown):
            if letter == "s":
                self.points["completion"][index] = event["completion"][index]
                self.points["upper"][index] = event["upper"][index]

    def _lap(self, event: Mapping[str, Any]) -> None:
        self.now["lap"] = event["lap"]
        self._expect(len(event["depth_mm"]))
        self.points["depth"] = list(event["depth_mm"])
        if event.get("state"):
            self.points["state"] = list(event["state"])

    def _outcome(self, event: Mapping[str, Any]) -> None:
        self.now["outcome"] = {"outcome": event["outcome"], "reason": event["reason"]}
        for index, point in enumerate(event.get("points") or []):
            self._expect(len(event["points"]))
            self.points["depth"][index] = point["depth_mm"]
            if "state" in point:
                self.points["state"][index], self.points["why"][index] = point["state"], point["why"]
        kind = "done" if event["outcome"] == "complete" else "latched"
        self._tell({"kind": kind}, event["outcome"], event["reason"])

    def _point(self, event: Mapping[str, Any], **fields: Any) -> None:
        index = event["point"] - 1
        self._expect(max(event["point"], self.scene["n"]))
        for name, value in fields.items():
            self.points[name][index] = value

    def _expect(self, n: int) -> None:
        """Room for so many points, of which nothing is known."""
        if n == self.scene["n"]:
            return
        self._change(n=n)
        unknown = {"contact": False, "depth": 0.0, "shown": "h", "state": "open", "why": ""}
        for name in ("contact", "depth", "completion", "upper", "shown", "state", "why", "permission"):
            self.points[name] = [unknown.get(name)] * n

    def _change(self, **fields: Any) -> None:
        """Something of the scene."""
        self.scene.update(fields)
        self.scene_number += 1

    def _tell(self, event: Mapping[str, Any], what: str, why: str) -> None:
        fault = event["kind"] in FAULTS
        line = {"t": self.now["t"], "kind": event["kind"], "what": what, "why": why, "fault": fault}
        self.news.append(line)

    def _drawn(self, points_mm: Any) -> list[list[list[float]]]:
        assert self._optics is not None
        left, right = self._optics.project(np.asarray(points_mm, dtype=np.float64))
        return [np.round(eye, 1).tolist() for eye in (left, right)]


def _rounded(places_mm: Any) -> Any:
    """To the micrometre."""
    return np.round(np.asarray(places_mm, dtype=np.float64), 3).tolist()


def finite(value: Any) -> Any:
    """The same without NaN and infinity, which JSON has not."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
