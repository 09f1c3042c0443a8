"""G-code lines as the firmware reads them: which words it knows, in which order it finds fault, with which code."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

Point = tuple[float, float, float]

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)")
_SINGLE_MAX = 3.4e38
_MAX_LINE_NUMBER = 10_000_000

EXPECTED_LETTER, BAD_NUMBER, NEGATIVE, UNSUPPORTED, GROUP_CONFLICT, NO_FEED = 1, 2, 4, 20, 21, 22
NOT_INTEGER, AXIS_CONFLICT, REPEATED, NO_AXIS, BAD_LINE_NUMBER, VALUE_MISSING = 23, 24, 25, 26, 27, 28
NO_SUCH_COORDINATES, G53_MOTION, AXIS_WITHOUT_COMMAND, BAD_TARGET, NO_OFFSETS, UNUSED = 29, 30, 31, 33, 35, 36
TOOL_AXIS, TOO_LARGE, BAD_JOG = 37, 38, 16


class GcodeError(Exception):
    """A line that is refused, with the firmware's code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


@dataclass(frozen=True)
class Modal:
    """What stays in force from line to line. Feed in mm/min, or 1/min under G93."""

    motion: str = "G0"
    coordinates: int = 0
    plane: str = "G17"
    inches: bool = False
    incremental: bool = False
    inverse_time: bool = False
    tool_offset: bool = False
    spindle: str = "M5"
    flood: bool = False
    tool: int = 0
    feed: float = 0.0
    speed: float = 0.0


@dataclass
class Line:
    """One line, checked: what it asks for, in the order of ``do``."""

    modal: Modal
    action: str | None = None
    """``G0 G1 G38.x G10 G28 G28.1 G30 G30.1 G92 G43.1`` and so on, if axis words or the command ask for one."""
    target_mm: Point = (0.0, 0.0, 0.0)
    waypoint_mm: Point | None = None
    words: dict[str, float] = field(default_factory=dict)
    axes: frozenset[str] = frozenset()
    dwell_s: float | None = None
    program_flow: str | None = None
    clears_g92: bool = False
    cancels_tool_offset: bool = False
    speed_given: bool = False


@dataclass(frozen=True)
class Frame:
    """Where work coordinates lie: offsets in machine mm."""

    position_mm: Point
    coordinates: Callable[[int], Point]
    g92_mm: Point
    tool_mm: Point
    homes_mm: tuple[Point, Point]
    last_coordinates: int
    any_axis_tool_offset: bool
    knows_hal_words: bool


_GROUPS: dict[str, int] = {
    **dict.fromkeys(("G4", "G10", "G28", "G28.1", "G30", "G30.1", "G53", "G92", "G92.1"), 0),
    **dict.fromkeys(("G0", "G1", "G2", "G3", "G38.2", "G38.3", "G38.4", "G38.5", "G80"), 1),
    **dict.fromkeys(("G17", "G18", "G19"), 2),
    **dict.fromkeys(("G90", "G91"), 3),
    "G91.1": 4,
    **dict.fromkeys(("G93", "G94"), 5),
    **dict.fromkeys(("G20", "G21"), 6),
    "G40": 7,
    **dict.fromkeys(("G43.1", "G49"), 8),
    **dict.fromkeys(("G54", "G55", "G56", "G57", "G58", "G59"), 12),
    "G61": 13,
    **dict.fromkeys(("M0", "M1", "M2", "M30"), 104),
    **dict.fromkeys(("M3", "M4", "M5"), 107),
    **dict.fromkeys(("M8", "M9"), 108),
}
_HAL_GROUPS = {"G59.1": 12, "G59.2": 12, "G59.3": 12, "G98": 10, "G99": 10, "G50": 11}
_AXIS_COMMANDS = {"G10", "G28", "G30", "G92", "G0", "G1", "G2", "G3", "G38.2", "G38.3", "G38.4", "G38.5", "G43.1"}
_FRACTIONS = {28, 30, 38, 43, 61, 90, 91, 92}
"""G-codes that come with a fraction in some of their forms."""
_HIGHEST_CODE = 1000
_COOLANT = 108
_INCH_MM = 25.4


def read_words(text: str) -> list[tuple[str, float]]:
    """Letters with their numbers.

    Raises:
        GcodeError: where no letter, or no number, is found.
    """
    words = []
    at = 0
    while at < len(text):
        letter = text[at]
        if not "A" <= letter <= "Z":
            raise GcodeError(EXPECTED_LETTER)
        match = _NUMBER.match(text, at + 1)
        if match is None:
            raise GcodeError(BAD_NUMBER)
        value = float(match.group())
        words.append((letter, value if abs(value) < _SINGLE_MAX else math.copysign(math.inf, value)))
        at = match.end()
    return words


def _whole(value: float) -> int:
    """Without its fraction, within 32 bits."""
    return int(min(max(value, -(2.0**31)), 2.0**31 - 1))


def _command(letter: str, value: float, known: Mapping[str, int]) -> str:
    whole = _whole(value)
    hundredths = round(100 * (value - whole)) if value < _HIGHEST_CODE else 0
    command = f"{letter}{whole}.{hundredths:02d}".removesuffix("0") if hundredths else f"{letter}{whole}"
    if command in known:
        return command
    if hundredths and (letter == "M" or (f"G{whole}" in known and whole not in _FRACTIONS)):
        raise GcodeError(NOT_INTEGER)
    raise GcodeError(UNSUPPORTED)


@dataclass
class _Words:
    """A line's commands and values before they are understood."""

    commands: dict[int, str] = field(default_factory=dict)
    coolants: set[str] = field(default_factory=set)
    values: dict[str, float] = field(default_factory=dict)
    axis_command: str | None = None


def _sort_words(text: str, frame: Frame) -> _Words:
    sorted_words = _Words()
    groups = _GROUPS | _HAL_GROUPS if frame.knows_hal_words else _GROUPS
    for letter, value in read_words(text):
        if letter in "GM":
            command = _command(letter, value, groups)
            group = groups[command]
            if command in _AXIS_COMMANDS:
                if sorted_words.axis_command is not None:
                    raise GcodeError(AXIS_CONFLICT)
                sorted_words.axis_command = command
            if group in sorted_words.commands and group != _COOLANT:
                raise GcodeError(GROUP_CONFLICT)
            sorted_words.commands[group] = command
            if group == _COOLANT:
                sorted_words.coolants.add(command)
            continue
        if letter not in "FIJKLNPRSTXYZ":
            raise GcodeError(UNSUPPORTED)
        if letter == "T" and value > 255 and not frame.knows_hal_words:
            raise GcodeError(TOO_LARGE)
        if letter in sorted_words.values:
            raise GcodeError(REPEATED)
        if letter in "FNPTS" and value < 0:
            raise GcodeError(NEGATIVE)
        sorted_words.values[letter] = value
    return sorted_words


def read_line(text: str, modal: Modal, frame: Frame, *, jog: bool = False) -> Line:
    """Understand a line against what is in force; nothing is changed.

    Raises:
        GcodeError: with the firmware's code; the whole line is refused.
    """
    words = _sort_words(text, frame)
    values, commands = words.values, words.commands
    axes = frozenset(letter for letter in "XYZ" if letter in values)
    command = words.axis_command
    if axes and command is None and commands.get(0) not in {"G28.1", "G30.1", "G92.1"}:
        command = "modal"
    if _MAX_LINE_NUMBER < values.get("N", 0.0) < 2**31:
        raise GcodeError(BAD_LINE_NUMBER)
    values.pop("N", None)
    line = Line(_new_modal(words, modal, jog=jog), axes=axes)
    _feed(line, values, commands, modal, jog=jog)
    if not jog:
        line.speed_given = "S" in values
        line.modal = replace(line.modal, speed=values.pop("S", modal.speed), tool=_whole(values.pop("T", modal.tool)))
    zeroth = commands.get(0)
    if zeroth == "G4":
        if "P" not in values:
            raise GcodeError(VALUE_MISSING)
        line.dwell_s = values.pop("P")
    scale = _INCH_MM if line.modal.inches else 1.0
    given = {axis: values.pop(axis) * scale for axis in sorted(axes)}
    _offsets(line, command, commands, given, frame)
    _position(line, command, commands, given, values, frame)
    _motion(line, command, given, values, frame, jog=jog)
    line.program_flow = commands.get(104)
    line.clears_g92 = zeroth == "G92.1"
    line.cancels_tool_offset = commands.get(8) == "G49"
    if jog and any(group not in {0, 3, 6} for group in commands):
        raise GcodeError(BAD_JOG)
    if values:
        raise GcodeError(UNUSED)
    return line


def _new_modal(words: _Words, modal: Modal, *, jog: bool) -> Modal:
    commands = words.commands
    changes: dict[str, object] = {}
    if jog:
        changes["motion"] = "G1"
        changes["inverse_time"] = False
    if 1 in commands:
        changes["motion"] = commands[1]
    if 2 in commands:
        changes["plane"] = commands[2]
    if 3 in commands:
        changes["incremental"] = commands[3] == "G91"
    if 5 in commands:
        changes["inverse_time"] = commands[5] == "G93"
    if 6 in commands:
        changes["inches"] = commands[6] == "G20"
    if 8 in commands:
        changes["tool_offset"] = commands[8] == "G43.1"
    if 12 in commands:
        text = commands[12]
        changes["coordinates"] = int(text[1:3]) - 54 + (int(text[4:]) if "." in text else 0)
    if 107 in commands:
        changes["spindle"] = commands[107]
    if words.coolants:
        changes["flood"] = "M8" in words.coolants or (modal.flood and "M9" not in words.coolants)
    return replace(modal, **changes)  # type: ignore[arg-type]  # built from the names above


def _feed(line: Line, values: dict[str, float], commands: dict[int, str], modal: Modal, *, jog: bool) -> None:
    scale = _INCH_MM if line.modal.inches else 1.0
    if jog:
        if "F" not in values:
            raise GcodeError(NO_FEED)
        line.modal = replace(line.modal, feed=values.pop("F") * scale)
    elif line.modal.inverse_time:
        moves = line.modal.motion not in {"G0", "G80"} and (bool(line.axes) or 1 in commands)
        if moves and "F" not in values:
            raise GcodeError(NO_FEED)
        line.modal = replace(line.modal, feed=values.pop("F", 0.0))
    elif "F" in values:
        line.modal = replace(line.modal, feed=values.pop("F") * scale)
    elif modal.inverse_time:
        line.modal = replace(line.modal, feed=0.0)


def _offsets(line: Line, command: str | None, commands: dict[int, str], given: dict[str, float], frame: Frame) -> None:
    if command == "G43.1":
        if not frame.any_axis_tool_offset and set(given) != {"Z"}:
            raise GcodeError(TOOL_AXIS)
        line.action = "G43.1"
        line.words = dict(given)
    if commands.get(12, "").startswith("G59.") and line.modal.coordinates > frame.last_coordinates:
        raise GcodeError(NO_SUCH_COORDINATES)


def _position(
    line: Line,
    command: str | None,
    commands: dict[int, str],
    given: dict[str, float],
    values: dict[str, float],
    frame: Frame,
) -> None:
    """Targets, and the commands of the group that is not modal."""
    zeroth = commands.get(0)
    offset = frame.coordinates(line.modal.coordinates)
    target = list(frame.position_mm)
    for index, axis in enumerate("XYZ"):
        if axis not in given:
            continue
        if zeroth == "G53":
            target[index] = given[axis]
        elif line.modal.incremental:
            target[index] += given[axis]
        else:
            target[index] = given[axis] + offset[index] + frame.g92_mm[index] + frame.tool_mm[index]
    line.target_mm = (target[0], target[1], target[2])
    if command == "G10":
        if not given:
            raise GcodeError(NO_AXIS)
        if "P" not in values or "L" not in values:
            raise GcodeError(VALUE_MISSING)
        number, kind = _whole(values.pop("P")), _whole(values.pop("L"))
        if number > frame.last_coordinates + 1:
            raise GcodeError(NO_SUCH_COORDINATES)
        if kind not in {2, 20}:
            raise GcodeError(UNSUPPORTED)
        line.action = f"G10L{kind}"
        line.words = {"P": (number - 1) if number else line.modal.coordinates, **given}
    elif command == "G92":
        if not given:
            raise GcodeError(NO_AXIS)
        line.action = "G92"
        line.words = dict(given)
    elif command in {"G28", "G30"}:
        home = frame.homes_mm[0 if command == "G28" else 1]
        line.action = command
        line.waypoint_mm = line.target_mm if given else None
        line.target_mm = (
            home
            if not given
            else tuple(h if a in given else p for h, a, p in zip(home, "XYZ", frame.position_mm, strict=True))  # type: ignore[assignment]
        )
    elif zeroth in {"G28.1", "G30.1"}:
        line.action = zeroth
    elif zeroth == "G53" and line.modal.motion not in {"G0", "G1"}:
        raise GcodeError(G53_MOTION)


def _motion(
    line: Line, command: str | None, given: dict[str, float], values: dict[str, float], frame: Frame, *, jog: bool
) -> None:
    motion = line.modal.motion
    if command not in {"modal", "G0", "G1", "G2", "G3", "G38.2", "G38.3", "G38.4", "G38.5"}:
        if jog and line.action is None:
            raise GcodeError(NO_AXIS)
        return
    if motion == "G80":
        raise GcodeError(AXIS_WITHOUT_COMMAND)
    if motion == "G0":
        line.action = "G0" if given else None
        return
    if line.modal.feed == 0:
        raise GcodeError(NO_FEED)
    if motion == "G1":
        if jog and not given:
            raise GcodeError(NO_AXIS)
        line.action = "G1" if given else None
        return
    if not given:
        raise GcodeError(NO_AXIS)
    if motion in {"G2", "G3"}:
        if not {"I", "J", "K", "R"} & set(values):
            raise GcodeError(NO_OFFSETS)
        raise GcodeError(UNSUPPORTED)
    if line.target_mm == frame.position_mm:
        raise GcodeError(BAD_TARGET)
    line.action = motion
