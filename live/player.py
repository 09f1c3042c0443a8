"""A record as the page plays it: how things stood at many moments, and the picture that was newest then."""

import json
import re
from pathlib import Path
from typing import Any

from calib.calibration_file import Calibration
from drivers.errors import MillError
from live.story import Story, finite
from milling.record import Run

MOMENT_S = 0.25
MOST_MOMENTS = 1500
AT_ONCE = {"state", "latched", "error", "outcome", "contact", "done", "stopped", "reopened", "stage", "frame"}
"""Kinds of event after which a moment is shown, however short the last one was."""
_PICTURE = re.compile(r"frames/(\d{5}-[a-z_]+\.jpg)")


class Player:
    """One run, told from beginning to end."""

    def __init__(self, run: Run) -> None:
        """Read it through once."""
        self._folder = run.folder
        self._pictures: set[str] = set()
        self.story = json.dumps(self._told(run), separators=(",", ":"), allow_nan=False)
        """JSON for the page."""

    def picture(self, name: str) -> Path | None:
        """The file of a picture that the record names; None for anything else."""
        if name not in self._pictures:
            return None
        path = (self._folder / "frames" / name).resolve()
        return path if path.is_relative_to(self._folder.resolve()) and path.is_file() else None

    def _told(self, run: Run) -> dict[str, Any]:
        story = Story()
        look_by(story, run.folder / "calibration.toml")
        scenes: list[dict[str, Any]] = []
        moments: list[dict[str, Any]] = []
        eyes: list[str | None] = [None, None]
        seen_s: list[float | None] = [None, None]
        last_s = run.events[-1]["t"] if run.events else 0.0
        every_s = max(MOMENT_S, last_s / MOST_MOMENTS)
        scene = -1
        for event in run.events:
            story.take(event)
            if event["kind"] == "frame" and (found := _PICTURE.fullmatch(str(event["file"]))):
                self._pictures.add(found[1])
                eye = int(event["name"].endswith("right"))
                eyes[eye], seen_s[eye] = found[1], event["t"]
                story.pictured(event["t"])
            if scene != story.scene_number:
                scene = story.scene_number
                scenes.append(finite(dict(story.scene)))
            since_s = story.now["t"] - moments[-1]["t"] if moments else every_s
            if since_s >= every_s or (event["kind"] in AT_ONCE and since_s > 0):
                story.curve()
                more = {"eyes": list(eyes), "seen_s": list(seen_s), "scene": len(scenes) - 1, "n_news": len(story.news)}
                moments.append({**story.told(), **more})
            elif moments and event["kind"] in AT_ONCE:
                more = {"eyes": list(eyes), "seen_s": list(seen_s), "scene": len(scenes) - 1, "n_news": len(story.news)}
                moments[-1] = {**story.told(), **more}
        return {
            "title": run.folder.name,
            "command": run.header.get("command", "run"),
            "rig": run.header.get("rig", ""),
            "damage": run.damage,
            "scenes": scenes,
            "moments": moments,
            "news": finite(story.news),
            "rows": finite(story.rows),
            "contacts": finite(story.contacts),
        }


def look_by(story: Story, calibration: Path) -> None:
    """Draw by a calibration, if there is one that can be read; the page does without otherwise."""
    try:
        known = Calibration.load(calibration, None)
    except MillError:
        return
    story.look_through(known, known.rig.center_from_tip_mm)
