"""TinyG and g2core JSON as bytes and values: what the board says, and the lines it is told (g2core wiki).

Every line from the board is one JSON object. The kind of line must be known and its own fields whole; what else stands
inside a report is ignored, as the wiki asks of a host. Moves are written as G-code lines with number and checksum,
which the board verifies; it answers with the line as it received it.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from drivers.errors import ProtocolError
from drivers.motion.interface import Vector

BAUD = 115_200
"""What a board with a UART expects; USB boards take any."""
HOLD = b"\n!\n"
RESUME = b"\n~\n"
FLUSH = b"\n%\n"
KILL_JOB = b"\n!\x04\n"
"""Feed hold, then kill the job: the board comes to rest, and throws away its queue and all lines before it.

A single character counts at the start of a line only, so that each of these ends what may be half a line before it; the
board ignores an empty one."""

LONGEST_LINE = 2048
"""Bytes without an end of line after which the stream is not the board's; a group of settings stays below 1024."""
REPORT = ("stat", "qr", "vel", "mpox", "mpoy", "mpoz")
"""What mill has the board report: state, room in the planner, speed, machine position."""

INITIALIZING, READY, ALARM, STOP, END, RUN, HOLDING, PROBE, CYCLE, HOMING, JOG, INTERLOCK, SHUTDOWN, PANIC = range(14)
"""Machine states (g2core wiki, Status Reports, stat values)."""


@dataclass(frozen=True)
class Reply:
    """``{"r":{...},"f":[revision,status,room]}``: the answer to one line; a status above zero is a refusal."""

    body: Mapping[str, Any]
    status: int


@dataclass(frozen=True)
class Report:
    """A whole status report; machine coordinates in mm."""

    stat: int
    machine_mm: Vector
    speed_mm_per_min: float
    blocks_free: int


@dataclass(frozen=True)
class Trouble:
    """``{"er":{...}}``, or a refusal that answers no line: the board found something by itself."""

    status: int
    text: str


@dataclass(frozen=True)
class Welcome:
    """The system is ready: after a reset or at power-up."""


@dataclass(frozen=True)
class Notice:
    """Queue reports, filtered status reports, acknowledgements of an enquiry: nothing that mill asked for."""


@dataclass(frozen=True)
class Broken:
    """A line that no manual allows, kept for the error message."""

    line: str
    reason: str


Message = Reply | Report | Trouble | Welcome | Notice | Broken

_NOTICES = frozenset({"qr", "qi", "qo", "ack", "job", "rx", "tid", "msg", "txt"})


def parse_line(line: str) -> list[Message]:
    """One line without its end.

    Raises:
        ProtocolError: it is not JSON, no kind of line that the manual has, or a field that mill reads is malformed.
    """
    try:
        whole = json.loads(line, object_pairs_hook=_object, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"{line!r} is no JSON of a g2core board: {error}") from error
    if not isinstance(whole, dict):
        raise ProtocolError(f"{line!r} is no JSON object")
    if "r" in whole:
        return _parse_reply(line, whole)
    if "er" in whole:
        er = whole["er"]
        if not isinstance(er, dict) or not _is_status(er.get("st")):
            raise ProtocolError(f"exception report {line!r} has no status")
        return [Trouble(er["st"], str(er.get("msg", "")))]
    if "sr" in whole:
        report = whole["sr"]
        if not isinstance(report, dict):
            raise ProtocolError(f"status report {line!r} is no JSON object")
        return [parse_report(report)] if all(key in report for key in REPORT) else [Notice()]
    if whole and whole.keys() <= _NOTICES:
        return [Notice()]
    raise ProtocolError(f"{line!r} is no line of a g2core board: r, er, sr or qr is due")


def _parse_reply(line: str, whole: dict[str, Any]) -> list[Message]:
    body = whole["r"]
    footer = whole.get("f", body.get("f") if isinstance(body, dict) else None)
    if not isinstance(body, dict) or not isinstance(footer, list) or len(footer) not in (3, 4):
        raise ProtocolError(f"reply {line!r} has no body, or no footer of three numbers")
    if not all(type(number) is int for number in footer) or not _is_status(footer[1]):
        raise ProtocolError(f"reply {line!r}: footer {footer} is not revision, status and room")
    status: int = footer[1]
    if "msg" in body and "fb" in body:
        return [Welcome()] if status == 0 else [Notice()]
    if status and body.keys() == {"msg"}:
        return [Trouble(status, str(body["msg"]))]
    reply = Reply(body, status)
    if status == 0 and "sr" in body:
        if not isinstance(body["sr"], dict):
            raise ProtocolError(f"status report {line!r} is no JSON object")
        return [parse_report(body["sr"]), reply] if all(key in body["sr"] for key in REPORT) else [Notice(), reply]
    return [reply]


def parse_report(values: Mapping[str, Any]) -> Report:
    """The values of a status report.

    Raises:
        ProtocolError: a state that the manual does not have, or a value that is no number.
    """
    stat, room = values["stat"], values["qr"]
    if type(stat) is not int or not INITIALIZING <= stat <= PANIC:
        raise ProtocolError(f"status report: stat {stat!r} is no state from {INITIALIZING} to {PANIC}")
    if type(room) is not int or not 0 <= room <= 255:
        raise ProtocolError(f"status report: qr {room!r} is no count")
    x, y, z, speed = (_number(key, values[key]) for key in ("mpox", "mpoy", "mpoz", "vel"))
    return Report(stat, (x, y, z), speed, room)


class Parser:
    """Bytes in, in pieces of any size; messages out, in order. A line that does not parse becomes ``Broken``."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """The messages that ``data`` completes."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        messages = [message for line in lines for message in self._parse(line.strip(b"\r"))]
        if len(self._rest) > LONGEST_LINE:
            messages.append(Broken(self._rest[:40].decode("ascii", "backslashreplace"), "a line without an end"))
            self._rest = b""
        return messages

    @staticmethod
    def _parse(line: bytes) -> list[Message]:
        if not line:
            return []
        text = line.decode("ascii", "backslashreplace")
        try:
            return parse_line(text)
        except ProtocolError as error:
            return [Broken(text, str(error))]


def numbered(number: int, block: str) -> str:
    """A G-code line with number and checksum: the exclusive or of all characters before the asterisk."""
    line = f"N{number}{block}"
    checksum = 0
    for byte in line.encode("ascii"):
        checksum ^= byte
    return f"{line}*{checksum}"


def move_block(machine_mm: Vector, feed_mm_per_min: float) -> str:
    """One straight move in machine coordinates; it says all its modes, as the end of a job changes them."""
    x, y, z = machine_mm
    return f"G21G90G94G53G1X{x:.3f}Y{y:.3f}Z{z:.3f}F{feed_mm_per_min:.2f}"


def query(name: str) -> str:
    """What reads a setting, a group of settings, or the status report."""
    return f'{{"{name}":null}}'


def assignment(name: str, value: float | bool | Mapping[str, Any]) -> str:
    """What writes a setting."""
    return json.dumps({name: value}, separators=(",", ":"))


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key comes twice")
    return found


def _refuse(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


def _is_status(value: object) -> bool:
    return type(value) is int and 0 <= value <= 255


def _number(key: str, value: object) -> float:
    if type(value) not in (int, float) or not math.isfinite(value) or abs(value) > 1e6:  # type: ignore[arg-type]
        raise ProtocolError(f"status report: {key} {value!r} is no number")
    return float(value)  # type: ignore[arg-type]
