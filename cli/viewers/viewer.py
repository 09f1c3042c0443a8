"""What a viewer that people already have can show of a run, and what each figure means."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Color = tuple[int, int, int]
Level = Literal["info", "warning", "error"]
Eye = Literal["left", "right"]

FRAME = "robot_mm"
"""The frame {R} in millimetres: 3-D viewers take one unit for a metre, and cut away what is as small as a window."""

FIGURES: dict[str, dict[str, tuple[str, str]]] = {
    "spindle": {
        "torque_share": ("number", "torque as a share of the rated torque"),
        "speed_rpm": ("number", "revolutions per minute"),
    },
    "depth": {
        "deepest_mm": ("number", "the deepest point below its contact"),
        "mean_mm": ("number", "mean of all points"),
        "depth_mm": ("array", "every point below its own contact"),
    },
    "contact": {
        "point": ("integer", "number on the ring, from 1"),
        "height_mm": ("number", "height at which the drill felt bone"),
        "predicted_mm": ("number", "height that the fitted surface has there"),
    },
    "completion": {
        "completion": ("array", "of every point as last seen, 0 to 1; null where never seen"),
        "upper": ("array", "its upper bound"),
        "frame_age_s": ("number", "from exposure to reading"),
    },
    "permission": {
        "point": ("integer", "number on the ring, from 1"),
        "deeper": ("boolean", "whether the point may go deeper at this visit"),
        "depth_mm": ("number", "depth that is permitted"),
        "bite_mm": ("number", "depth that was asked for, beyond the last one"),
        "frame_age_s": ("number", "age of the newest picture"),
        "reason": ("string", "why no deeper; empty where it may"),
    },
    "state": {
        "state": ("string", "of the run"),
        "stage": ("string", "of the work"),
        "detail": ("string", "of the stage"),
        "spindle": ("string", "of the spindle"),
        "lap": ("number", "laps milled"),
    },
}
"""Topics of figures: each field's JSON type and meaning."""


@dataclass(frozen=True)
class Marks:
    """What is drawn into one eye's picture, in pixels."""

    ring_px: Sequence[Sequence[float]]
    colors: Sequence[Color]
    """Of every point of the ring, by its completion."""
    landmarks_px: dict[str, Sequence[float]]
    ball_px: tuple[Sequence[float], float] | None
    """Centre and radius of the drill's ball; None where it is not known for this picture."""


class Viewer(Protocol):
    """Takes what there is to show, in the order of its time; ``t_s`` counts from the beginning of the record."""

    def picture(self, t_s: float, eye: Eye, jpeg: bytes) -> None:
        """A picture as the record keeps it."""

    def marks(self, t_s: float, eye: Eye, marks: Marks) -> None:
        """What the machine believes of that picture."""

    def tip(self, t_s: float, tip_mm: Floats, axis: Floats) -> None:
        """The drill's tip (3,) in {R}, and the unit vector from it up the shank."""

    def surface(self, t_s: float, points_mm: Floats) -> None:
        """The surface as it was reconstructed, (n, 3)."""

    def ring(self, t_s: float, name: str, points_mm: Floats, colors: Sequence[Color]) -> None:
        """A closed line through the ring's points (n, 3), one colour each; it takes the place of one of this name."""

    def figures(self, t_s: float, topic: str, values: dict[str, Any]) -> None:
        """Values of a topic of ``FIGURES``."""

    def words(self, t_s: float, level: Level, where: str, text: str) -> None:
        """A line for people: what happened, and why."""
