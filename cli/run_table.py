"""A run as one row of a table, and its points as rows, for statistics. Column names carry units; None is not known."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property, partial
from pathlib import Path
from statistics import fmean
from typing import Any

from cli.study import study_told
from drivers.errors import ConfigError
from milling.job import Job
from milling.labels import MEANINGS, Label, newest, read_labels
from milling.record import Run, read_run

Row = dict[str, Any]


@dataclass(frozen=True)
class Told:
    """What a record and its labels tell, looked up once."""

    run: Run
    labels: Mapping[str, Label]
    """The newest of each name."""

    @classmethod
    def of_folder(cls, folder: Path) -> "Told":
        """Read them.

        Raises:
            ConfigError: no run there, or one that is damaged.
        """
        return cls(read_run(folder), newest(read_labels(folder)))

    @cached_property
    def kinds(self) -> dict[str, list[dict[str, Any]]]:
        """Events by kind, in order."""
        kinds: dict[str, list[dict[str, Any]]] = {}
        for event in self.run.events:
            kinds.setdefault(event["kind"], []).append(event)
        return kinds

    def of(self, kind: str, **wanted: Any) -> list[dict[str, Any]]:
        """Events of a kind with these fields."""
        return [each for each in self.kinds.get(kind, []) if all(each.get(key) == wanted[key] for key in wanted)]

    def last(self, kind: str) -> dict[str, Any]:
        """The last event of a kind; empty where there is none."""
        return (self.kinds.get(kind) or [{}])[-1]

    def header(self, *path: str) -> Any:
        """A value of the header; None where it is not there."""
        value: Any = self.run.header
        for key in path:
            value = value.get(key) if isinstance(value, dict) else None
        return value

    @cached_property
    def points(self) -> list[Row]:
        """One object a point, with its contact and what it was answered; of a run that was cut off, by its last lap."""
        points = list((self.run.result or {}).get("points") or [])
        if not points:
            lap = self.last("lap")
            known = {
                key: lap[key] for key in ("depth_mm", "completion", "upper", "load_ratio", "state") if lap.get(key)
            }
            points = [dict(zip(known, values, strict=True)) for values in zip(*known.values(), strict=True)]
        contacts = {event["point"]: event for event in self.kinds.get("contact", [])}
        answers: dict[int, Counter[str]] = {}
        for event in self.kinds.get("asked", []):
            answers.setdefault(event["point"], Counter())[event["reason"]] += 1
        told = []
        for number, point in enumerate(points, start=1):
            contact, counted = contacts.get(number, {}), answers.get(number, Counter())
            heights = {"contact_z_mm": contact.get("z_mm"), "predicted_z_mm": contact.get("predicted_mm")}
            told.append({**point, **heights, "answers": counted})
        return told


@dataclass(frozen=True)
class Column:
    """What it means, for people, and where it comes from."""

    meaning: str
    of: Callable[[Told], Any]


def _header(*path: str) -> Callable[[Told], Any]:
    return lambda told: told.header(*path)


def _study(key: str) -> Callable[[Told], Any]:
    return lambda told: study_told(told.run).get(key)


def _result(key: str) -> Callable[[Told], Any]:
    return lambda told: (told.run.result or {}).get(key)


def _last(kind: str, key: str) -> Callable[[Told], Any]:
    return lambda told: told.last(kind).get(key)


def _first(kind: str, key: str) -> Callable[[Told], Any]:
    return lambda told: (told.kinds.get(kind) or [{}])[0].get(key)


def _count(kind: str, **wanted: Any) -> Callable[[Told], Any]:
    return lambda told: len(told.of(kind, **wanted))


def _over(key: str, figure: Callable[[list[float]], float]) -> Callable[[Told], Any]:
    def of(told: Told) -> float | None:
        values = [point[key] for point in told.points if point.get(key) is not None]
        return figure(values) if values else None

    return of


def _state(state: str) -> Callable[[Told], Any]:
    def of(told: Told) -> int | None:
        states = [point["state"] for point in told.points if "state" in point]
        return states.count(state) if states else None

    return of


def _chain(told: Told, key: str) -> Any:
    return None if told.run.chain is None else getattr(told.run.chain, key)


def _off_surface_mm(told: Told) -> float | None:
    return max((abs(each["z_mm"] - each["predicted_mm"]) for each in told.of("contact")), default=None)


def _verified_off_mm(told: Told) -> float | None:
    error_mm = told.last("calibration.verified").get("error_mm")
    return None if error_mm is None else sum(value**2 for value in error_mm) ** 0.5


RUN_COLUMNS: Mapping[str, Column] = {
    "run": Column("name of the record's folder", lambda told: told.run.folder.name),
    "record": Column(
        "`whole`, `cut off` (the process was killed), or `damaged` (then the rest is empty)",
        lambda told: "cut off" if told.run.result is None else "whole",
    ),
    "date_utc": Column("start, ISO 8601", _header("date")),
    "command": Column("`run` or `resume`", _header("command")),
    "resumes": Column("the record that it went on from", _header("resumes")),
    "specimen_id": Column("as told on the command line or in the rig file", _study("specimen_id")),
    "protocol": Column("likewise", _study("protocol")),
    "operator": Column("likewise", _study("operator")),
    "rig": Column("name of the rig", _header("rig")),
    "mill_version": Column("version of mill", _header("version")),
    "seed": Column("of a virtual bench; empty on hardware", _header("seed")),
    "faults_planted": Column("on a virtual bench", _header("faults")),
    "outcome": Column("`complete`, `held` or `aborted`; empty where the run was cut off", _result("outcome")),
    "reason": Column("why, in words", _result("reason")),
    "milling_time_s": Column("from the first contact sought to the last look", _result("milling_time_s")),
    "record_time_s": Column(
        "time of the last event", lambda told: told.run.events[-1]["t"] if told.run.events else None
    ),
    "laps": Column("laps round the ring", _result("laps")),
    "looks": Column("looks with the drill aside", _count("stage", stage="look")),
    "pauses": Column("times that the drill left the bone for want of a fresh frame", _count("state", state="paused")),
    "points_done": Column("points that are through", _state("done")),
    "points_stopped": Column("points stopped before they were known to be through", _state("stopped")),
    "points_open": Column("points that might still have got a bite", _state("open")),
    "depth_max_mm": Column("deepest point below its own contact", _over("depth_mm", max)),
    "depth_mean_mm": Column("mean over the points", _over("depth_mm", fmean)),
    "completion_min": Column("least completion of a point, 0 to 1, as the eyes read it", _over("completion", min)),
    "completion_mean": Column("mean over the points", _over("completion", fmean)),
    "permissions_asked": Column("how often a bite was asked for", _count("asked")),
    "permissions_granted": Column("how often it was granted", _count("asked", reason="")),
    "first_fault": Column("what latched first, in words", _first("latched", "reason")),
    "first_fault_s": Column("when, on the clock of the record", _first("latched", "t")),
    "first_reaction": Column("`RETRACT`, `HOLD` or `KILL`", _first("latched", "reaction")),
    "bad_readings": Column("pictures that made no sense", _count("bad_reading")),
    "torque_idle": Column("in the air, as a share of rated", _last("idle", "torque")),
    "torque_max": Column(
        "the highest, as a share of rated",
        lambda told: max((event["torque"] for event in told.of("load")), default=None),
    ),
    "contact_off_surface_max_mm": Column("contact against fitted surface, the worst point", _off_surface_mm),
    "calibration_check_off_mm": Column("error at the one setpoint checked before the run", _verified_off_mm),
    "calibration_check_off_px": Column("the drill tip's, there", _last("calibration.verified", "error_px")),
    "calibration_model": Column("kind of calibration", _header("calibration", "model")),
    "calibration_rmse_mm": Column("its error on held-out setpoints", _header("calibration", "rmse_mm")),
    "calibration_date_utc": Column("when it was made, ISO 8601", _header("calibration", "date")),
    "weights_tip_sha256": Column("network that finds the drill tip", _header("weights", "tip")),
    "weights_landmarks_sha256": Column("network that finds bregma and lambda", _header("weights", "landmarks")),
    "weights_completion_sha256": Column("network that reads completion", _header("weights", "completion")),
    "device_motion": Column("motion controller, firmware, serial number", _header("identity", "motion")),
    "device_spindle": Column("drill", _header("identity", "spindle")),
    "device_camera": Column("cameras", _header("identity", "camera")),
    "camera_settings": Column("exposure and what else they were set to", _header("identity", "camera_settings")),
    "ring_center_mm": Column("x, y, z of the middle of the path of the ball's centre, in {R}", _result("center_mm")),
    "ring_radius_mm": Column("its mean radius", _result("radius_mm")),
    **{f"job_{each.name}": Column(f"`{each.name}` of the job", _header("job", each.name)) for each in fields(Job)},
    "events": Column("lines of the chain of events", partial(_chain, key="lines")),
    "events_head": Column("its head; a record that was made anew has another one", partial(_chain, key="head")),
}
"""Of one run. Columns of labels follow."""

POINT_COLUMNS: Mapping[str, str] = {
    "run": "name of the record's folder",
    "specimen_id": "as told on the command line or in the rig file",
    "point": "number on the ring, from 1",
    "angle_deg": "its place on the ring: 360 times its number by the number of points, from +x of {R} towards +y",
    "contact_z_mm": "height of the drill's tip where it touched the bone, in {R}",
    "predicted_z_mm": "the same, by the surface fitted to the pictures",
    "depth_mm": "depth reached below contact",
    "completion": "0 to 1, as the eyes read it last",
    "upper": "its upper bound",
    "load_ratio": "load of the last pass that was weighed, as a share of whole bone's",
    "left_probability": "that bone which would hold the flap is left here",
    "state": "`done`, `stopped` or `open`",
    "why": "in words",
    "permissions_asked": "how often a bite was asked for",
    "permissions_granted": "how often it was granted",
    "withheld_most": "why it was withheld most often",
}


def run_row(told: Told) -> Row:
    """One run, with its labels as ``label_NAME``."""
    row = {name: column.of(told) for name, column in RUN_COLUMNS.items()}
    return row | {f"label_{name}": label.value for name, label in told.labels.items()}


def damaged_row(folder: Path, error: ConfigError) -> Row:
    """One that cannot be read."""
    return {"run": folder.name, "record": "damaged", "reason": str(error)}


def point_rows(told: Told) -> Iterator[Row]:
    """One row a point."""
    points = told.points
    for number, point in enumerate(points, start=1):
        answers: Counter[str] = point["answers"]
        withheld = Counter({why: count for why, count in answers.items() if why})
        own: Row = {
            "run": told.run.folder.name,
            "specimen_id": study_told(told.run).get("specimen_id"),
            "point": number,
            "angle_deg": 360.0 * number / len(points),
            "permissions_asked": answers.total(),
            "permissions_granted": answers[""],
            "withheld_most": withheld.most_common(1)[0][0] if withheld else None,
        }
        yield {name: own.get(name, point.get(name)) for name in POINT_COLUMNS}


def label_columns(rows: list[Row]) -> list[str]:
    """Those that every table has, and those that these runs have."""
    found = {name for row in rows for name in row if name.startswith("label_")}
    return sorted(found | {f"label_{name}" for name in MEANINGS})
