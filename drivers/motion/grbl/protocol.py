"""GRBL 1.1 as bytes and values: what the controller says, and the lines it is told.

Strict outside brackets, open inside: a field of a report or a feedback message that is not known is ignored, as the
manual asks of a host; a line that is none of the manual's kinds is refused. The wire has no checksum, so that a line
that does not parse is all there is to tell a broken one.
"""

import re
from dataclasses import dataclass

from drivers.errors import ProtocolError
from drivers.motion.interface import Vector

BAUD = 115_200
STATUS = b"?"
HOLD = b"!"
RESUME = b"~"
RESET = b"\x18"
SPINDLE_STOP = b"\x9e"
"""A toggle, and heard in a hold only: off, and by the second one on again."""

LONGEST_LINE = 512
"""Bytes without an end of line after which the stream is not GRBL's; grblHAL's longest lines stay below 256."""

STATES = frozenset({"Idle", "Run", "Hold", "Jog", "Home", "Alarm", "Check", "Door", "Sleep", "Tool"})


@dataclass(frozen=True)
class Ok:
    """A line was taken: planned, not executed."""


@dataclass(frozen=True)
class Refused:
    """``error:N``: a line was refused and nothing of it happens."""

    code: int


@dataclass(frozen=True)
class Alarm:
    """``ALARM:N``: the controller stopped itself and is locked."""

    code: int


@dataclass(frozen=True)
class Welcome:
    """The banner after a reset or at power-up."""

    version: str
    is_hal: bool


@dataclass(frozen=True)
class Setting:
    """One line of ``$$``; grblHAL has settings that are text."""

    number: int
    text: str

    @property
    def value(self) -> float | None:
        """The setting as a number, None where it is text."""
        try:
            return float(self.text)
        except ValueError:
            return None


@dataclass(frozen=True)
class Feedback:
    """``[KIND:text]``: build info, modal state, messages for people."""

    kind: str
    text: str


@dataclass(frozen=True)
class Startup:
    """A stored startup line: as listed by ``$N``, or as executed at a reset, ``>line:ok``."""

    text: str


@dataclass(frozen=True)
class Report:
    """A status report; machine coordinates in mm."""

    state: str
    substate: int | None
    machine_mm: Vector
    blocks_free: int | None
    """Room in the planner, None where ``$10`` does not ask for it."""
    spindle_rpm: float | None = None
    """The speed that the spindle's output asks for, measured where grblHAL has an encoder; None where not reported."""


@dataclass(frozen=True)
class Broken:
    """A line that no manual allows, kept for the error message."""

    line: str
    reason: str


Message = Ok | Refused | Alarm | Welcome | Setting | Feedback | Startup | Report | Broken

_BANNER = re.compile(r"(grbl|grblhal) (\d+\.\d+\w?) \[.*\]", re.IGNORECASE)
_SETTING = re.compile(r"\$(\d{1,4})=(.*)")
_CODE = re.compile(r"(error|ALARM):(\d{1,3})")
_FEEDBACK = re.compile(r"\[([^:\]]+)(?::(.*))?\]")
_STARTUP = re.compile(r"\$N\d=(.*)|>(.*):(?:ok|error:\d{1,3})")
_STATE = re.compile(r"([A-Z][a-z]+)(?::(\d{1,2}))?")
_NUMBER = re.compile(r"-?\d{1,5}\.\d{1,4}")
_SPEEDS = re.compile(r"\d{1,6}(?:\.\d{1,3})?(?:,-?\d{1,6}(?:\.\d{1,3})?){1,2}")


def parse_line(line: str) -> Message:
    """One line without its end.

    Raises:
        ProtocolError: the manual has no such line, or a field that mill reads is malformed.
    """
    if line == "ok":
        return Ok()
    if line.startswith("<"):
        return _parse_report(line)
    if found := _CODE.fullmatch(line):
        code = int(found[2])
        return Alarm(code) if found[1] == "ALARM" else Refused(code)
    if found := _SETTING.fullmatch(line):
        return Setting(int(found[1]), found[2])
    if found := _FEEDBACK.fullmatch(line):
        return Feedback(found[1], found[2] or "")
    if found := _BANNER.fullmatch(line):
        return Welcome(found[2], is_hal=found[1].lower() == "grblhal")
    if found := _STARTUP.fullmatch(line):
        return Startup(found[1] or found[2] or "")
    raise ProtocolError(f"{line!r} is no line of GRBL 1.1")


def _parse_report(line: str) -> Report:
    if not line.endswith(">"):
        raise ProtocolError(f"status report {line!r} has no end")
    head, *fields = line[1:-1].split("|")
    state = _STATE.fullmatch(head)
    if state is None or state[1] not in STATES:
        raise ProtocolError(f"status report {line!r}: state {head!r} is none of {', '.join(sorted(STATES))}")
    machine_mm: Vector | None = None
    blocks_free: int | None = None
    spindle_rpm: float | None = None
    for field in fields:
        key, _, text = field.partition(":")
        if key == "MPos":
            values = text.split(",")
            if len(values) < 3 or not all(_NUMBER.fullmatch(value) for value in values):
                raise ProtocolError(f"status report {line!r}: MPos {text!r} is not three numbers")
            machine_mm = (float(values[0]), float(values[1]), float(values[2]))
        elif key == "Bf":
            counts = text.split(",")
            if len(counts) != 2 or not all(count.isdecimal() for count in counts):
                raise ProtocolError(f"status report {line!r}: Bf {text!r} is not two counts")
            blocks_free = int(counts[0])
        elif key == "FS":
            if not _SPEEDS.fullmatch(text):
                raise ProtocolError(f"status report {line!r}: FS {text!r} is not feed and speed")
            spindle_rpm = float(text.rpartition(",")[2])
    if machine_mm is None:
        raise ProtocolError(f"status report {line!r} has no MPos; mill needs $10 with bit 0 set")
    return Report(
        state=state[1],
        substate=None if state[2] is None else int(state[2]),
        machine_mm=machine_mm,
        blocks_free=blocks_free,
        spindle_rpm=spindle_rpm,
    )


class Parser:
    """Bytes in, in pieces of any size; messages out, in order. A line that does not parse becomes ``Broken``."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """The messages that ``data`` completes."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        messages = [message for line in lines if (message := self._parse(line.rstrip(b"\r"))) is not None]
        if len(self._rest) > LONGEST_LINE:
            messages.append(Broken(self._rest[:40].decode("ascii", "backslashreplace"), "a line without an end"))
            self._rest = b""
        return messages

    @staticmethod
    def _parse(line: bytes) -> Message | None:
        if not line:
            return None
        text = line.decode("ascii", "backslashreplace")
        try:
            return parse_line(text)
        except ProtocolError as error:
            return Broken(text, str(error))


@dataclass(frozen=True)
class BuildInfo:
    """What ``$I`` says about the firmware."""

    version: str
    user_text: str
    """Free text that the owner may store with ``$I=``; the only serial number that GRBL has."""
    options: str
    """Letters of what was chosen when the firmware was built."""
    is_hal: bool
    buffer_bytes: int | None = None
    """Of its serial port, where the firmware tells it."""

    @property
    def identity(self) -> str:
        """Firmware, version and serial number, as far as known."""
        return f"{'grblHAL' if self.is_hal else 'Grbl'} {self.version}" + (
            f" {self.user_text}" if self.user_text else ""
        )


def build_info(feedback: list[Feedback]) -> BuildInfo:
    """The answer to ``$I``.

    Raises:
        ProtocolError: VER or OPT is missing, or the firmware does not speak 1.1.
    """
    texts = {message.kind: message.text for message in feedback}
    version, _, user_text = texts.get("VER", "").partition(":")
    if not version.startswith("1.1"):
        raise ProtocolError(f"firmware version {version!r} found in $I; mill speaks GRBL 1.1 only")
    if "OPT" not in texts:
        raise ProtocolError("no build options found in $I; [OPT:...] is due")
    # [OPT:letters,blocks,bytes], and more behind it on grblHAL.
    options = texts["OPT"].split(",")
    return BuildInfo(
        version=version,
        user_text=user_text,
        options=options[0],
        buffer_bytes=int(options[2]) if len(options) > 2 and options[2].isdecimal() else None,
        is_hal=texts.get("FIRMWARE") == "grblHAL",
    )


def move_line(machine_mm: Vector, feed_mm_per_min: float) -> str:
    """One straight move in machine coordinates, which no work offset can bend."""
    x, y, z = machine_mm
    return f"G53G1X{x:.3f}Y{y:.3f}Z{z:.3f}F{feed_mm_per_min:.2f}"
