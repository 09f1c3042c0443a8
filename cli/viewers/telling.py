"""A record's events told to a viewer: pictures, places, figures and reasons, as the page tells them."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cli.viewers.viewer import Color, Eye, Floats, Level, Marks, Viewer
from live.player import look_by
from live.story import Story, finite

EYES: tuple[Eye, Eye] = ("left", "right")
UNKNOWN: Color = (138, 143, 153)
APPROACH: Color = (74, 120, 208)
CONTACT: Color = (122, 127, 137)
_CIVIDIS = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_CIVIDIS)[0, :, ::-1]


class Telling:
    """Takes the events of one record in order."""

    def __init__(self, folder: Path, header: Mapping[str, Any], viewer: Viewer) -> None:
        """A calibration beside the record draws the ring and the drill into both pictures."""
        self.story = Story()
        look_by(self.story, folder / "calibration.toml")
        self.missing = 0
        """Pictures that the record names and that are not there."""
        self._folder, self._viewer = folder, viewer
        axis = np.asarray(header.get("identity", {}).get("center_from_tip_mm", [0.0, 0.0, 1.0]), dtype=np.float64)
        self._axis = axis / np.linalg.norm(axis)
        self._ring_mm: Floats | None = None
        self._reasons: dict[int, str] = {}
        self._told = 0
        self._of_kind: dict[str, Callable[[float, Mapping[str, Any]], None]] = {
            "frame": self._frame,
            "surface": self._surface,
            "trajectory": self._trajectory,
            "ring": self._ring,
            "load": self._load,
            "contact": self._contact,
            "reading": self._reading,
            "asked": self._asked,
            "cut": self._depth,
            "left": self._depth,
            "lap": self._lap,
            "outcome": self._lap,
            "stopped": self._point,
            "done": self._point,
            "reopened": self._point,
            "stage": self._stage,
            "state": self._state,
            "spindle": self._state,
        }

    def take(self, event: Mapping[str, Any]) -> None:
        """One event; what is not known is passed over."""
        self.story.take(event)
        t_s = self.story.now["t"]
        if (tell := self._of_kind.get(event["kind"])) is not None:
            tell(t_s, event)
        for line in self.story.news[self._told :]:
            self._viewer.words(t_s, _level(line), line["what"], line["why"])
        self._told = len(self.story.news)

    def _frame(self, t_s: float, event: Mapping[str, Any]) -> None:
        path = (self._folder / event["file"]).resolve()
        if not path.is_relative_to((self._folder / "frames").resolve()) or not path.is_file():
            self.missing += 1
            return
        eye = int(event["name"].endswith("right"))
        self._viewer.picture(t_s, EYES[eye], path.read_bytes())
        self.story.pictured(t_s)
        ring_px, tip_px = self.story.scene["ring_px"], self.story.now["tip_px"]
        drawn = None if ring_px is None else ring_px[eye]
        ball = None
        if tip_px is not None:
            center, beside = (np.asarray(place) for place in tip_px[eye])
            ball = (center.tolist(), float(np.linalg.norm(beside - center)))
        if drawn is not None or ball is not None:
            landmarks = self.story.scene["marks_px"][eye]
            colors = self._colors(len(drawn)) if drawn is not None else []
            self._viewer.marks(t_s, EYES[eye], Marks(drawn or [], colors, landmarks, ball))

    def _surface(self, t_s: float, event: Mapping[str, Any]) -> None:
        x, y = np.meshgrid(event["x_mm"], event["y_mm"])
        points = np.column_stack([x.ravel(), y.ravel(), np.array(event["z_mm"], dtype=np.float64).ravel()])
        self._viewer.surface(t_s, points[np.isfinite(points).all(axis=1)])

    def _trajectory(self, t_s: float, event: Mapping[str, Any]) -> None:
        self._ring_mm = np.array(event["fit_mm"], dtype=np.float64)
        for name, key, color in (("approach", "ball_mm", APPROACH), ("contact", "fit_mm", CONTACT)):
            places = np.array(event[key], dtype=np.float64)
            self._viewer.ring(t_s, name, places, [color] * len(places))

    def _ring(self, t_s: float, event: Mapping[str, Any]) -> None:
        self._ring_mm = np.array(event["ring_mm"], dtype=np.float64)
        self._viewer.ring(t_s, "contact", self._ring_mm, [CONTACT] * len(self._ring_mm))

    def _load(self, t_s: float, event: Mapping[str, Any]) -> None:
        self._figures(t_s, "spindle", torque_share=event["torque"], speed_rpm=event["rpm"])
        if event.get("tip_mm") is not None:
            self._viewer.tip(t_s, np.array(event["tip_mm"], dtype=np.float64), self._axis)

    def _contact(self, t_s: float, event: Mapping[str, Any]) -> None:
        heights = {"height_mm": event["z_mm"], "predicted_mm": event["predicted_mm"]}
        self._figures(t_s, "contact", point=event["point"], **heights)

    def _reading(self, t_s: float, event: Mapping[str, Any]) -> None:
        points = self.story.points
        self._figures(
            t_s, "completion", completion=points["completion"], upper=points["upper"], frame_age_s=event["age_s"]
        )

    def _asked(self, t_s: float, event: Mapping[str, Any]) -> None:
        point, reason = event["point"], event["reason"]
        given = {key: event.get(key) for key in ("depth_mm", "bite_mm", "frame_age_s")}
        self._figures(t_s, "permission", point=point, deeper=not reason, **given, reason=reason)
        if reason != self._reasons.get(point, ""):
            self._viewer.words(t_s, "info", f"point {point}", f"no deeper: {reason}" if reason else "may go deeper")
        self._reasons[point] = reason

    def _depth(self, t_s: float, event: Mapping[str, Any]) -> None:
        depth = self.story.points["depth"]
        self._figures(t_s, "depth", deepest_mm=max(depth), mean_mm=sum(depth) / len(depth), depth_mm=depth)

    def _lap(self, t_s: float, event: Mapping[str, Any]) -> None:
        self._state(t_s, event)
        depth = self.story.points.get("depth", [])
        if self._ring_mm is None or len(depth) != len(self._ring_mm):
            return
        self._depth(t_s, event)
        cut = self._ring_mm - np.outer(np.asarray(depth, dtype=np.float64), [0.0, 0.0, 1.0])
        self._viewer.ring(t_s, "depth", cut, self._colors(len(cut)))

    def _point(self, t_s: float, event: Mapping[str, Any]) -> None:
        self._viewer.words(t_s, "info", f"point {event['point']}", f"{event['kind']}: {event['why']}")

    def _stage(self, t_s: float, event: Mapping[str, Any]) -> None:
        self._state(t_s, event)
        if not self.story.over:
            self._viewer.words(t_s, "info", event["stage"], event.get("detail", ""))

    def _state(self, t_s: float, event: Mapping[str, Any]) -> None:
        now = self.story.now
        self._figures(t_s, "state", **{key: now[key] for key in ("state", "stage", "detail", "spindle", "lap")})

    def _figures(self, t_s: float, topic: str, **values: Any) -> None:
        self._viewer.figures(t_s, topic, finite(values))

    def _colors(self, n: int) -> list[Color]:
        """Of every point by its completion, dark to bright, and grey where nothing is known."""
        known = self.story.points.get("completion", [])
        return [color_of(known[index]) if index < len(known) else UNKNOWN for index in range(n)]


def color_of(completion: float | None) -> Color:
    """Cividis, which people who see red and green alike can read too; grey for None."""
    if completion is None:
        return UNKNOWN
    red, green, blue = _CIVIDIS[round(255 * min(max(completion, 0.0), 1.0))]
    return int(red), int(green), int(blue)


def _level(line: Mapping[str, Any]) -> Level:
    if line["what"] in ("paused", "held"):
        return "warning"
    if line["kind"] in ("latched", "error"):
        return "error"
    return "warning" if line["fault"] else "info"
