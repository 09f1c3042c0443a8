"""A recorded run decided once more, with other weights or another policy, up to the first difference and beyond.

Every reading of the ring, every question to the ledger, every pass and every look is in the record, in order. They are
put to a new ledger; what the drill did stays what it did, since nobody can know what bone would have answered to a
drill that went elsewhere. So the first difference is exact, and later ones tell how often the two would not agree.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from drivers.errors import ConfigError
from milling.eyes import RIGHT, SEEN
from milling.job import Job
from milling.limits import Limits
from milling.permission import Ledger
from milling.planner import Policy
from milling.published import Unguarded
from milling.record import Run
from milling.thickness import Thickness

EQUAL_MM = 3e-6
"""The record keeps nanometres, of the depth and of the bite."""

Reread = Callable[[str], dict[str, Any] | None]
"""What other weights read from a picture of the record, by its file: completion and upper bound, (n,) each."""


@dataclass(frozen=True)
class Difference:
    """A visit that was decided otherwise. ``point`` counts from 1; depths are below contact."""

    t: float
    point: int
    recorded_mm: float
    recorded_why: str
    now_mm: float
    now_why: str


@dataclass
class Replay:
    """How a record was decided again."""

    asked: int = 0
    readings: int = 0
    without_picture: int = 0
    """Readings that were left out of both decisions, as their picture was not kept."""
    differences: list[Difference] = field(default_factory=list)


def replay(
    run: Run, job: Job, pitch_mm: float, *, policy: Policy | None = None, reread: Reread | None = None
) -> Replay:
    """Decide again.

    Args:
        run: with policy ``default``, from its contacts on; not one that resumed another.
        job: of the record.
        pitch_mm: from point to point.
        policy: asks in place of the record's; an unguarded one decides by itself as well.
        reread: what other weights say; then only the readings whose pictures were kept count, on both sides.

    Raises:
        ConfigError: the record does not hold what is needed.
    """
    if run.header.get("resumes"):
        raise ConfigError(
            f"{run.folder}: goes on from {run.header['resumes']}; replay that run, or one that began anew"
        )
    if not any(event["kind"] == "asked" for event in run.events):
        raise ConfigError(f"{run.folder}: holds no decisions; only runs of policy default that milled can be replayed")
    # Without other weights the record itself is one side: nothing of this version is taken for granted.
    first = None if reread is None else _Side(job, pitch_mm, None)
    second = _Side(job, pitch_mm, policy)
    result = Replay()
    for event, picture in _with_pictures(run.events):
        if event["kind"] == "reading":
            result.readings += 1
            other = event
            if reread is not None:
                seen = None if picture is None else reread(picture)
                if seen is None:
                    result.without_picture += 1
                    continue
                other = event | seen
            second.read(other)
            if first is not None:
                first.read(event)
        elif event["kind"] == "asked":
            result.asked += 1
            index, t = event["point"] - 1, event["t"]
            before = (event["depth_mm"], event["reason"]) if first is None else first.ask(index, event)
            after = second.ask(index, event)
            if abs(before[0] - after[0]) > EQUAL_MM:
                _add(result.differences, Difference(t, index + 1, before[0], before[1], after[0], after[1]))
        else:
            second.take(event)
            if first is not None:
                first.take(event)
    return result


def _add(differences: list[Difference], new: Difference) -> None:
    """A visit is asked about at each of its segments, and told once."""
    if not differences or replace(differences[-1], t=new.t) != new:
        differences.append(new)


class _Side:
    """One ledger that follows the record."""

    def __init__(self, job: Job, pitch_mm: float, policy: Policy | None) -> None:
        limits: Limits = job.limits
        self._policy = policy
        self._ledger = Ledger(job.n_points, limits, Thickness(job.n_points, limits, pitch_mm=pitch_mm))
        self._unguarded: Unguarded | None = None
        if policy is not None and not policy.guarded:
            self._unguarded = Unguarded([float("inf")] * job.n_points)

    def read(self, event: dict[str, Any]) -> None:
        exposed_at_s = event["t"] - event["age_s"]
        for index, shown in enumerate(event["shown"]):
            if shown != SEEN or event["completion"][index] is None:
                continue
            for witness in (self._ledger, self._unguarded):
                if witness is not None:
                    witness.seen(
                        index,
                        completion=event["completion"][index],
                        upper=max(event["upper"][index], event["completion"][index]),
                        exposed_at_s=exposed_at_s,
                    )

    def ask(self, index: int, event: dict[str, Any]) -> tuple[float, str]:
        permits = self._ledger if self._unguarded is None else self._unguarded
        bite_mm = (
            event["bite_mm"]
            if self._policy is None
            else self._policy.bite_mm(permits.completion(index), depth_mm=permits.cut_mm(index))
        )
        t = event["t"]
        grant = permits.ask(index, bite_mm=bite_mm, now_s=t, frame_at_s=t - event["frame_age_s"])
        return grant.depth_mm, "" if grant.deeper else grant.reason

    def take(self, event: dict[str, Any]) -> None:
        """What the drill did and felt, whatever this side thinks of it."""
        ledger, index = self._ledger, event.get("point", 0) - 1
        match event["kind"]:
            case "contact":
                ledger.touched(index)
            case "cut" | "left":
                depth_mm, at_s = event["depth_mm"], event["t"] - event["age_s"]
                point = ledger.points[index]
                point.granted_mm = max(depth_mm, point.cut_mm)
                ledger.passed(index, depth_mm=depth_mm, now_s=at_s)
                if self._unguarded is not None:
                    self._unguarded.passed(index, depth_mm=depth_mm, now_s=at_s)
            case "pass" if "above_idle" in event:
                ledger.felt(index, ratio=event["ratio"], above_idle=event["above_idle"])
            case "voided":
                for left in event["points"]:
                    ledger.void(left - 1)
            case "stalled":
                ledger.stall()
            case "looked":
                for point_index in range(len(ledger.points)):
                    ledger.look(point_index)


def _with_pictures(events: list[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], str | None]]:
    """Every event, and with a reading the picture that it was read from, if that was kept."""
    for number, event in enumerate(events):
        following = events[number + 1] if number + 1 < len(events) else {}
        kept = event["kind"] == "reading" and following.get("kind") == "frame" and following["name"] in RIGHT
        yield event, following["file"] if kept else None
