"""What a run tells while it goes on, and what it comes to."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

from drivers.motion.interface import Vector

Outcome = Literal["complete", "held", "aborted"]


@dataclass(frozen=True)
class Progress:
    """What a person sees while it goes on."""

    stage: str
    detail: str = ""
    lap: float = 0.0
    depth_mm: tuple[float, ...] = ()
    completion: tuple[float, ...] = ()
    state: tuple[str, ...] = ()
    torque_fraction: float = 0.0
    milling_time_s: float = 0.0


@dataclass(frozen=True)
class RunResult:
    """How it ended. ``points`` holds one object per point: depth, contact, completion, state, permission history."""

    outcome: Outcome
    reason: str
    milling_time_s: float
    laps: float
    points: tuple[dict[str, Any], ...] = ()
    center_mm: Vector | None = None
    radius_mm: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain JSON."""
        return asdict(self)
