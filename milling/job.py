"""What to mill: the paper's figures as defaults, every limit checked before anything moves."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import isfinite, pi
from pathlib import Path
from typing import Any, Literal, Self, get_args

from drivers.errors import ConfigError
from milling.limits import Limits

PolicyName = Literal["default", "paper", "previous"]

RANGES: dict[str, tuple[float, float]] = {
    "radius_mm": (2.0, 4.0),
    "n_points": (8, 128),
    "landmark_ratio": (0.0, 1.0),
    "ball_radius_mm": (0.1, 1.5),
    "safety_offset_mm": (0.1, 2.0),
    "max_safety_offset_mm": (0.1, 3.0),
    "feed_mm_s": (0.2, 5.0),
    "removal_rate_mm2_s": (0.005, 0.065),
    "bite_mm": (0.001, 0.05),
    "late_bite_mm": (0.001, 0.015),
    "late_margin_mm": (0.1, 1.0),
    "thickness_low_mm": (0.05, 1.0),
    "thickness_high_mm": (0.1, 1.0),
    "spindle_rpm": (1_000, 100_000),
    "completion_threshold": (0.5, 1.0),
    "detection_gate_px": (0.5, 10.0),
    "calibration_gate_mm": (0.05, 1.0),
    "segment_s": (0.02, 0.04),
    "max_laps": (1, 2000),
}


def _is_point(value: object) -> bool:
    return (
        isinstance(value, tuple)
        and len(value) == 3
        and all(isinstance(each, int | float) and not isinstance(each, bool) and isfinite(each) for each in value)
    )


@dataclass(frozen=True)
class Job:
    """One window. Lengths in mm, times in s; a value outside its range is refused by name, never clipped.

    Attributes:
        radius_mm: the ring that the ball's contact follows (the flap is narrower by the ball).
        n_points: trajectory points on the ring, at theta_i = 2 pi i / n for i = 1..n.
        landmark_ratio: the centre's place between bregma (0) and lambda (1).
        ball_radius_mm: the cutter's ball.
        safety_offset_mm: the gap between ball and fitted surface before contact is sought.
        max_safety_offset_mm: how far that gap may be raised where the predicted error asks for it.
        feed_mm_s: speed along the ring.
        removal_rate_mm2_s: feed times bite; what published practice allows the bone.
        bite_mm: the deepest bite of one visit.
        late_bite_mm: the same, once less than ``late_margin_mm`` of bone may remain.
        late_margin_mm: from here on bites are late ones.
        thickness_low_mm, thickness_high_mm: the thickness prior. Past its low end two cues must say "bone";
            its high end, measured from the point's own contact, is never passed.
        spindle_rpm: while milling; the rig file's `speed_rpm` unless told.
        completion_threshold: the upper bound of completion at which the picture says "through".
        detection_gate_px, calibration_gate_mm: the paper's gates before anything is milled.
        segment_s: the longest that one queued segment may take.
        max_laps: a run that needs more is held.
        center_mm: the ring's centre in {R}, its height near the surface, in place of bregma and lambda: where the tip
            stands over the middle of the window, say. For bone that has no landmarks.
        policy: how to go deeper; "paper" and "previous" ask nobody and are for comparison on a virtual bench.
    """

    radius_mm: float = 2.0
    n_points: int = 32
    landmark_ratio: float = 1 / 3
    ball_radius_mm: float = 0.5
    safety_offset_mm: float = 0.5
    max_safety_offset_mm: float = 1.5
    feed_mm_s: float = 5.0
    removal_rate_mm2_s: float = 0.065
    bite_mm: float = 0.05
    late_bite_mm: float = 0.015
    late_margin_mm: float = 0.1
    thickness_low_mm: float = 0.25
    thickness_high_mm: float = 0.6
    spindle_rpm: float = 50_000
    completion_threshold: float = 0.995
    detection_gate_px: float = 10.0
    calibration_gate_mm: float = 1.0
    segment_s: float = 0.04
    max_laps: int = 200
    center_mm: tuple[float, float, float] | None = None
    policy: PolicyName = "default"

    def __post_init__(self) -> None:
        for key, (low, high) in RANGES.items():
            value = getattr(self, key)
            whole = key in ("n_points", "max_laps")
            if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or not isfinite(value):
                kind = "a whole number" if whole else "a number"
                raise ConfigError(f"[job] {key}: found {value!r}, needs {kind} from {low:g} to {high:g}")
            if not low <= value <= high:
                raise ConfigError(f"[job] {key}: found {value:g}, allowed {low:g} to {high:g}")
        if self.policy not in get_args(PolicyName):
            raise ConfigError(f"[job] policy: found {self.policy!r}, allowed {', '.join(get_args(PolicyName))}")
        if self.center_mm is not None and not _is_point(self.center_mm):
            raise ConfigError(f"[job] center_mm: found {self.center_mm!r}, needs three numbers of mm: x, y, z")
        if self.thickness_low_mm >= self.thickness_high_mm:
            raise ConfigError(
                f"[job] thickness_low_mm: found {self.thickness_low_mm:g}, must be less than thickness_high_mm "
                f"({self.thickness_high_mm:g})"
            )
        if self.max_safety_offset_mm < self.safety_offset_mm:
            raise ConfigError(
                f"[job] max_safety_offset_mm: found {self.max_safety_offset_mm:g}, must be at least safety_offset_mm "
                f"({self.safety_offset_mm:g})"
            )

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        """A job from the [job] table of a rig file; what it does not name keeps its default.

        Raises:
            ConfigError: an unknown key, a wrong kind of value, or a value outside its range.
        """
        known = {field.name for field in fields(cls)}
        for key in table:
            if key not in known:
                raise ConfigError(f"[job] {key}: unknown key, allowed {', '.join(sorted(known))}")
        center = table.get("center_mm")
        return cls(**{**table, "center_mm": tuple(center)} if isinstance(center, list) else table)

    @classmethod
    def of_record(cls, header: Mapping[str, Any], folder: Path) -> Self:
        """The job that a record names; what was asked of the window stays what is asked of it.

        Raises:
            ConfigError: the header holds none, or one that is not allowed.
        """
        job = header.get("job")
        if not isinstance(job, dict):
            raise ConfigError(
                f"{folder}/header.json: key job: found {job!r}, a table is needed; restore it from a copy"
            )
        known = {field.name for field in fields(cls)}
        return cls.from_table({key: value for key, value in job.items() if key in known})

    @property
    def limits(self) -> Limits:
        """What permission enforces for this job."""
        return Limits(
            bite_mm=self.bite_mm,
            late_bite_mm=self.late_bite_mm,
            late_margin_mm=self.late_margin_mm,
            thickness_low_mm=self.thickness_low_mm,
            thickness_high_mm=self.thickness_high_mm,
            threshold=self.completion_threshold,
        )

    @property
    def circumference_mm(self) -> float:
        """Length of one lap."""
        return 2 * pi * self.radius_mm

    @property
    def lap_s(self) -> float:
        """Duration of one lap at full feed."""
        return self.circumference_mm / self.feed_mm_s
