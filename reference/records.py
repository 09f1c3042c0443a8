"""The page about the record of a run: its files, and every event with its fields."""

import ast
from collections.abc import Iterator
from dataclasses import fields
from typing import Final

from milling.load import Feeling
from milling.point import PointState
from milling.record import SYNCED
from milling.result import RunResult
from reference.source import functions, keys_of, literal, modules

HEAD: Final = """\
# Records

`mill run` keeps a folder, by default `runs/DATE`:

| file | what it holds |
|---|---|
| `header.json` | what ran: written once, before anything moves |
| `events.jsonl` | what happened: one event a line, appended as it happens |
| `frames/*.jpg` | pictures, one in two seconds unless `--picture-every` says otherwise; a full disk costs them first |
| `calibration.toml` | the calibration that the run used |
| `result.json` | how it ended, as [`--json`](json.md#mill-run-mill-resume) tells; absent after a kill |
| `labels.jsonl` | what people found out afterwards (`mill runs label`) |
| `report.html` | the page about it, made from the rest; `mill runs report RUN` makes it anew |

A line of `events.jsonl` is a link (32 hex digits, [a chain over all lines](../records.md#is-it-still-what-was-written);
in older records a CRC32, eight digits) and a JSON object with `t`, the seconds since the
record began on the monotonic clock, `kind`, and the fields below. A kill costs at most the line that was being
written: it is dropped when the record is read, and named. Damage anywhere else is refused, with its line. Points
count from 1; lengths are mm, places are in {R}, `_px` are pixels of the left picture unless said.

"""

HEADER: Final = {
    "schema": "1; it grows when a field changes its meaning",
    "command": "run or resume",
    "version": "of mill",
    "date": "when it began, UTC",
    "rig": "its name",
    "identity": "of motion, spindle, camera and tool: what calibration and certificate are bound to",
    "seed": "what drew a virtual bench; null on hardware",
    "specimen": "its specimen file",
    "faults": "what was planted",
    "job": "the window that was asked for: [`[job]`](rig-file.md#job), whole",
    "weights": "SHA-256 of each network",
    "calibration": "model, held-out and predicted error, date",
    "study": "specimen_id, protocol and operator, those that were told",
}

RESUMED: Final = """
`mill resume` adds `resumes`, the record it goes on from, and `resumes_head`, the last link of its chain.

## events.jsonl

"""

WORDS: Final = {
    "state": "what the machine does: start (with the job), milling, paused, lifted",
    "stage": "the next stage of the job, as it is shown to people",
    "calibration.sighting": "the drill was seen at a setpoint",
    "calibration.hidden": "it was not seen there",
    "calibration.fit": "a calibration was fitted",
    "calibration.verified": "one setpoint, seen again before milling",
    "surface": "the skull's surface as a height field",
    "trajectory": "the ring on it, its uncertainty, and the path of the tip; where bregma and lambda were seen",
    "ring": "the ring in the pictures",
    "floor": "the lowest height that the controller will go to, written into its soft limits and read back",
    "spindle": "at speed; off, confirmed or not",
    "idle": "the torque in free air",
    "contact": "the drill felt the bone at this point: depth counts from here",
    "reading": "what a picture says of every point: completion, its upper bound, and how the point was shown "
    "(s seen, h hidden, b behind the drill)",
    "bad_reading": "a reading that makes no sense; five in a row hold the run",
    "frame": "a picture was kept; its SHA-256",
    "file": "another file of the folder, bound to the record by its SHA-256",
    "asked": "a point asked for a bite: what it got, and the reason where it got none",
    "cut": "the tip left a point deeper than it was: the journal that `mill resume` goes on from",
    "left": "the tip left a point as deep as it was",
    "pass": "how a pass felt: load as a share of what was expected; all that is known of the point since",
    "load": "torque, speed and place, a few times a second",
    "lap": "once round: depth, completion, load and state of every point",
    "voided": "these points lost their permissions: the visit ended before they were reached",
    "stalled": "no point got a bite for long; a look follows",
    "looked": "what was known of every point after a look with the drill aside",
    "reopened": "a look gave the point back to milling",
    "stopped": "the point gets no bite until a look",
    "done": "the point is finished, and stays so",
    "late": "the loop was silent longer than it should",
    "latched": "the first failure, and the reaction to it",
    "error": "something failed while the machine was being made safe",
    "outcome": "how it ended: the fields of `result.json`",
}
"""What each kind of event tells."""

_NOT_OF_A_RECORD: Final = {("cli", "record"), ("cli", "check")}
"""Events of a trace, by room."""
_OF_A_POINT: Final = {"reopened", *(state.value for state in PointState if state is not PointState.OPEN)}
_BEHIND: Final = {
    "outcome": [field.name for field in fields(RunResult)],
    "pass": [field.name for field in fields(Feeling)],
    "lap": ["lap", "depth_mm", "completion", "upper", "load_ratio", "left_probability", "state", "torque"],
    "trajectory": ["bregma_px", "lambda_px"],
}
"""Fields that stand behind `**` in the source."""


def told() -> dict[str, list[str]]:
    """By kind, the fields that the sources give it."""
    kinds: dict[str, list[str]] = {}
    for room, call in _calls():
        for kind in _kinds(call.args[0]):
            if (room, kind) in _NOT_OF_A_RECORD:
                continue
            names = kinds.setdefault(kind, [])
            given = [keyword.arg for keyword in call.keywords if keyword.arg is not None]
            more = _BEHIND.get(kind, []) if len(given) < len(call.keywords) else []
            names += [name for name in [*given, *more] if name not in names]
    return kinds


def header_keys() -> set[str]:
    """What `mill run` writes into the header."""
    for _, tree in modules(["cli"]):
        for function in functions(tree):
            if function.name == "mill_window":
                return (keys_of(ast.Name("header"), function, tree) or set()) | {"schema"}
    raise ValueError("no function mill_window in cli/: who writes the header now? say it in reference/records.py")


def page() -> str:
    """The files, the header, and the events in the order in which a run tells them."""
    keys = header_keys()
    ordered = [key for key in HEADER if key in keys] + sorted(keys - HEADER.keys())
    parts = [HEAD, "## header.json\n\n| key | what it is |\n|---|---|\n"]
    parts += [f"| `{key}` | {HEADER.get(key, '')} |\n" for key in ordered]
    parts.append(RESUMED)
    parts.append("Kinds marked * are on the disk before the run goes on.\n\n")
    parts.append("| kind | what it tells | fields |\n|---|---|---|\n")
    found = told()
    for kind in [kind for kind in WORDS if kind in found] + sorted(found.keys() - WORDS.keys()):
        mark = " *" if kind in SYNCED else ""
        names = ", ".join(f"`{name}`" for name in found[kind])
        parts.append(f"| `{kind}`{mark} | {WORDS.get(kind, '')} | {names} |\n")
    return "".join(parts)


def _calls() -> Iterator[tuple[str, ast.Call]]:
    """Calls of ``recorder.event``, whatever the recorder is called, with their room."""
    for path, tree in modules(["calib", "cli", "milling"]):
        room = path.parts[-2]
        for call in ast.walk(tree):
            if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr == "event"):
                continue
            if room == "milling" and path.stem == "standing":
                continue  # tells an earlier run's events once more
            if call.args:
                yield room, call


def _kinds(node: ast.expr) -> list[str]:
    """The kinds that this expression may be; a name stands for a point's next state."""
    if isinstance(node, ast.IfExp):
        return _kinds(node.body) + _kinds(node.orelse)
    word = literal(node)
    return [word] if word is not None else sorted(_OF_A_POINT)
