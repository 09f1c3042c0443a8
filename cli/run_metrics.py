"""Figures of the newest run for Prometheus, brought up to date from its record when they are asked for.

Counters go on from run to run, as Prometheus wants them; gauges are the newest run's. Units are in the names.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from cli.runs import recorded
from drivers.errors import ConfigError
from milling.tail import Tail

PERIODS_S = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.15, 0.25, 0.5, 1.0)
AGES_S = (0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.25, 0.5, 1.0)
ACTIVE_S = 30.0
"""A record without result to which nothing was added for so long is one of a run that was killed."""
FAULTS = ("latched", "error", "bad_reading")
BREAKS = {"state", "stage", "latched", "outcome"}
"""After these, the next bite asked for says nothing about the loop's period."""


class RunMetrics:
    """Of the runs in a folder."""

    def __init__(self, folder: Path, *, now_s: Callable[[], float] = time.time) -> None:
        """Begin with the newest record there is.

        Args:
            folder: of the records; it may not exist yet.
            now_s: seconds since 1970, as files are dated.
        """
        self._folder, self._now_s = folder, now_s
        self._newest: tuple[float, Path] | None = None
        """When it began, and where."""
        self._tail: Tail | None = None
        self._asked_s: float | None = None
        self._registry = registry = CollectorRegistry()

        def gauge(name: str, help_: str, *labels: str) -> Gauge:
            return Gauge(f"mill_{name}", help_, labels, registry=registry)

        def counter(name: str, help_: str, *labels: str) -> Counter:
            return Counter(f"mill_{name}", help_, labels, registry=registry)

        self._active = gauge("run_active", "1 while a run goes on")
        self._quiet_s = gauge("record_quiet_seconds", "Since anything was added to the newest record")
        self._damaged = gauge("record_damaged", "1 where the newest record cannot be read on")
        self._info = gauge("run_info", "The newest run", "run", "rig", "version", "specimen_id", "protocol", "operator")
        self._state = gauge("state", "1 for the state of the newest run", "state")
        self._stage = gauge("stage", "1 for its stage", "stage")
        self._outcome = gauge("outcome", "1 for how it ended", "outcome")
        self._lap = gauge("lap", "Laps so far")
        self._torque = gauge("torque_share", "Of rated torque")
        self._speed = gauge("spindle_speed_rpm", "Of the drill")
        self._height = gauge("tip_height_mm", "Of the drill's tip, in {R}")
        self._depth = gauge("depth_mm", "Below contact, over the points", "of")
        self._completion = gauge("completion_share", "As the eyes read it, over the points", "of")
        self._points = gauge("points", "Points of the ring in each state", "state")
        self._runs = counter("runs", "Runs that ended, by outcome", "outcome")
        self._asked = counter("permissions", "Bites asked for, by the answer", "answer")
        self._faults = counter("faults", "Faults and what was latched", "kind")
        self._pauses = counter("pauses", "Times that the drill left the bone for want of a fresh frame")
        self._late_s = counter("loop_late_seconds", "Of silences of the loop in the bone longer than 50 ms, summed")
        self._period = Histogram(
            "mill_loop_period_seconds", "From one bite asked for to the next, while milling",
            buckets=PERIODS_S, registry=registry,
        )  # fmt: skip
        self._age = Histogram(
            "mill_frame_age_seconds", "Of the newest frame when a bite was asked for", buckets=AGES_S, registry=registry
        )

    def text(self) -> bytes:
        """What Prometheus reads, as things stand in the records now."""
        self._catch_up()
        return generate_latest(self._registry)

    def close(self) -> None:
        """Close the record; a second call does nothing."""
        if self._tail is not None:
            self._tail.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _catch_up(self) -> None:
        self._read()
        dated = sorted((path.joinpath("header.json").stat().st_mtime, path) for path in recorded(self._folder))
        new = [each for each in dated if self._newest is not None and each > self._newest]
        for newest in new or (dated[-1:] if self._newest is None else []):
            self._newest = newest
            self._turn_to(newest[1])
            self._read()
        if self._tail is not None:
            quiet_s = max(0.0, self._now_s() - (self._tail.folder / "events.jsonl").stat().st_mtime)
            ended = (self._tail.folder / "result.json").exists()
            self._quiet_s.set(quiet_s)
            self._active.set(not ended and quiet_s < ACTIVE_S)

    def _turn_to(self, folder: Path) -> None:
        self.close()
        for changing in (
            self._info,
            self._state,
            self._stage,
            self._outcome,
            self._depth,
            self._completion,
            self._points,
        ):
            changing.clear()
        for gauge in (self._lap, self._torque, self._speed, self._height, self._damaged):
            gauge.set(0)
        self._asked_s = None
        try:
            self._tail = Tail(folder)
        except ConfigError:
            self._tail = None
            self._damaged.set(1)
            return
        header = self._tail.header
        study = header.get("study") or {}
        ids = [str(study.get(name) or "") for name in ("specimen_id", "protocol", "operator")]
        self._info.labels(folder.name, str(header.get("rig", "")), str(header.get("version", "")), *ids).set(1)

    def _read(self) -> None:
        if self._tail is None:
            return
        try:
            for event in self._tail.news():
                self._take(event)
        except ConfigError:
            self._damaged.set(1)

    def _take(self, event: Mapping[str, Any]) -> None:
        kind = event["kind"]
        if kind in BREAKS:
            self._asked_s = None
        if kind in FAULTS:
            self._faults.labels(kind).inc()
        match kind:
            case "state":
                _only(self._state, event["state"])
                self._pauses.inc(event["state"] == "paused")
            case "stage":
                _only(self._stage, event["stage"])
            case "load":
                self._torque.set(event["torque"])
                self._speed.set(event["rpm"])
                if event.get("tip_mm"):
                    self._height.set(event["tip_mm"][2])
            case "asked":
                self._asked.labels(event["reason"] or "granted").inc()
                self._age.observe(event["frame_age_s"])
                if self._asked_s is not None:
                    self._period.observe(event["t"] - self._asked_s)
                self._asked_s = event["t"]
            case "late":
                self._late_s.inc(event["silent_s"])
            case "lap":
                self._lap.set(event["lap"])
                _over(self._depth, event["depth_mm"], "max", max)
                _over(self._completion, event["completion"], "min", min)
                self._count(event.get("state") or [])
            case "outcome":
                _only(self._outcome, event["outcome"])
                self._runs.labels(event["outcome"]).inc()
                self._count([point.get("state", "") for point in event.get("points") or []])

    def _count(self, states: list[str]) -> None:
        for state in ("open", "stopped", "done"):
            self._points.labels(state).set(states.count(state))


def _only(gauge: Gauge, value: str) -> None:
    """Of all labels, this one."""
    gauge.clear()
    gauge.labels(value).set(1)


def _over(gauge: Gauge, values: list[float | None], name: str, figure: Callable[[list[float]], float]) -> None:
    """A figure of all points and their mean, of what is known."""
    known = [value for value in values if value is not None]
    if known:
        gauge.labels(name).set(figure(known))
        gauge.labels("mean").set(sum(known) / len(known))
