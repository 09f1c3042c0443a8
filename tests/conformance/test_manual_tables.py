"""The GRBL tables typed from the manuals, run against the driver and against the emulated board."""

import dataclasses
import re
import runpy
from pathlib import Path
from typing import Any

import pytest

from drivers.motion.grbl import protocol
from drivers.motion.grbl.codes import ALARMS, ERRORS, alarm_meaning, alarm_words, error_words
from drivers.motion.grbl.protocol import Broken, Parser, Report, Setting
from firmware_sim.grbl_board import GrblBoard

TABLES: dict[str, list[Any]] = runpy.run_path(str(Path(__file__).parents[1] / "data" / "manual_tables.py"))
STEPS = {f"${first + axis}": value for first, value in ((100, 1000), (110, 1200), (120, 500)) for axis in range(3)}
HOMING = {"$22": 1, "$24": 600, "$25": 1200, "$26": 1, "$27": 0.5, "$130": 35, "$131": 40, "$132": 28}


def for_each_dialect(rows: list[Any]) -> list[Any]:
    """Rows that begin with dialects, one for each."""
    return [(dialect, *row[1:]) for row in rows for dialect in row[0]]


class Desk:
    """Axes whose switches are 1 mm up and whose probe is 6 mm down, if nothing is odd."""

    def __init__(self, odd: str = "") -> None:
        self.odd = odd
        self.axes_mm = (0.0, 0.0, 0.0)
        self.was_pressed = False

    def move_to(self, time_s: float, axes_mm: tuple[float, float, float]) -> None:
        self.axes_mm = axes_mm

    def limit_switches(self) -> tuple[bool, bool, bool]:
        if self.odd == "no switch":
            return False, False, False
        x, y, z = (value >= 1.0 for value in self.axes_mm)
        self.was_pressed |= z
        return x, y, z or (self.odd == "switch sticks" and self.was_pressed)

    def probe_closed(self) -> bool:
        return self.odd == "probe closed" or self.axes_mm[2] <= -6.0


class Host:
    """Writes bytes to a board that has just booted, and lets its time go on."""

    def __init__(self, dialect: Any, settings: dict[str, float], odd: str = "") -> None:
        self.board = GrblBoard(Desk(odd), dialect=dialect, settings=STEPS | settings)
        self._time_s = 0.0
        self.ask(b"", 0.1)

    def ask(self, data: bytes, wait_s: float = 0.1) -> bytes:
        self.board.receive(data)
        self._time_s += wait_s
        self.board.advance_to(self._time_s)
        return self.board.transmit()

    def prepare(self, data: bytes) -> None:
        """Lines as lines, real-time bytes one by one, each with time to take effect."""
        while data:
            end = data.index(b"\n") + 1 if data[0] in b"$GM" else 1
            # Moves of some millimetres at 10 mm/s are over after a second.
            self.ask(data[:end], 1.2 if data[:2] == b"G1" and b"X1" in data[:end] else 0.05)
            data = data[end:]


def grbl_board(dialect: str, mask: int | None = None) -> Host:
    return Host(dialect, {"$10": mask if mask is not None else 3 if dialect == "gnea" else 511})


@pytest.mark.parametrize(("dialects", "request_bytes", "reply", "values"), TABLES["GRBL"])
def test_replies_driver(dialects: Any, request_bytes: bytes, reply: bytes, values: list[Any]) -> None:
    understood = [(type(message).__name__, *dataclasses.astuple(message)) for message in Parser().feed(reply)]
    assert understood == values


@pytest.mark.parametrize(("dialect", "request_bytes", "reply", "values"), for_each_dialect(TABLES["GRBL"]))
def test_replies_board(dialect: str, request_bytes: bytes, reply: bytes, values: list[Any]) -> None:
    assert grbl_board(dialect).ask(request_bytes) == reply


@pytest.mark.parametrize(("code", "words", "ways"), TABLES["ERRORS"])
def test_errors_driver(code: int, words: str, ways: list[Any]) -> None:
    (message,) = Parser().feed(b"error:%d\r\n" % code)
    assert dataclasses.astuple(message) == (code,)
    assert words in error_words(code)


@pytest.mark.parametrize(
    ("dialect", "before", "line", "code"),
    for_each_dialect([(*way, code) for code, _, ways in TABLES["ERRORS"] for way in ways]),
)
def test_errors_board(dialect: str, before: bytes, line: bytes, code: int) -> None:
    host = grbl_board(dialect)
    assert b"error" not in host.ask(before)
    assert host.ask(line) == b"error:%d\r\n" % code


@pytest.mark.parametrize(("code", "words", "is_lost", "way"), TABLES["ALARMS"])
def test_alarms_driver(code: int, words: str, is_lost: bool, way: Any) -> None:
    (message,) = Parser().feed(b"ALARM:%d\r\n" % code)
    assert dataclasses.astuple(message) == (code,)
    assert words in alarm_words(code)
    assert alarm_meaning(code).position_lost is is_lost


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
@pytest.mark.parametrize(("code", "way"), [(row[0], row[3]) for row in TABLES["ALARMS"] if row[3] is not None])
def test_alarms_board(dialect: str, code: int, way: tuple[str, list[tuple[bytes, float]]]) -> None:
    odd, steps = way
    host = Host(dialect, HOMING | ({"$10": 3} if dialect == "gnea" else {}), odd)
    *before, last = [host.ask(data, wait_s) for data, wait_s in steps]
    assert b"ALARM" not in b"".join(before)
    assert last.count(b"ALARM:") == last.count(b"ALARM:%d\r\n" % code) == 1


def test_the_tables_of_codes_are_whole() -> None:
    """GRBL 1.1 knows the errors 1 to 17 and 20 to 38 and the alarms 1 to 9; the driver has all of grblHAL's alarms."""
    assert {row[0] for row in TABLES["ERRORS"]} >= {*range(1, 18), *range(20, 39)}
    assert {row[0] for row in TABLES["ERRORS"]} <= set(ERRORS)
    assert [row[0] for row in TABLES["ALARMS"]] == sorted(ALARMS)


def read_report(line: bytes) -> tuple[Any, ...] | None:
    (message,) = Parser().feed(line + b"\r\n")
    assert isinstance(message, Report | Broken)
    if not isinstance(message, Report):
        return None
    # FS is feed and spindle speed (1.1 interface, "Current feed and speed"); the tables' values do not hold it.
    speed = re.search(rb"\|FS:[^,|>]*,(\d+)", line)
    assert message.spindle_rpm == (None if speed is None else float(speed[1]))
    return dataclasses.astuple(dataclasses.replace(message, spindle_rpm=None))[:-1]


@pytest.mark.parametrize(("line", "values"), [row[3:] for row in TABLES["REPORTS"]] + TABLES["REPORTS_OF_OTHER_BOARDS"])
def test_reports_driver(line: bytes, values: tuple[Any, ...] | None) -> None:
    assert read_report(line) == values


@pytest.mark.parametrize(("dialect", "mask", "before", "line", "values"), for_each_dialect(TABLES["REPORTS"]))
def test_reports_board(dialect: str, mask: int, before: bytes, line: bytes, values: Any) -> None:
    host = grbl_board(dialect, mask)
    host.prepare(before)
    assert host.ask(b"?") == line + b"\r\n"


@pytest.mark.parametrize(("byte", "name"), [row[:2] for row in TABLES["REALTIME"] if row[1] is not None])
def test_realtime_driver(byte: bytes, name: str) -> None:
    assert getattr(protocol, name) == byte


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
@pytest.mark.parametrize(("byte", "name", "before", "start", "within"), TABLES["REALTIME"])
def test_realtime_board(dialect: str, byte: bytes, name: Any, before: bytes, start: bytes, within: bytes) -> None:
    host = grbl_board(dialect)
    host.prepare(before)
    reply = host.ask(byte, 0.8)
    report = reply if byte == b"?" else host.ask(b"?")
    assert b"ok" not in reply, "a real-time byte is no line"
    assert report.startswith(start)
    # What changed may come in the second report, behind a work offset.
    assert within in report + host.ask(b"?")


@pytest.mark.parametrize(("dialects", "request_bytes", "line", "number", "value"), TABLES["SETTINGS"])
def test_settings_driver(dialects: Any, request_bytes: bytes, line: bytes, number: int, value: float) -> None:
    (message,) = Parser().feed(line)
    assert isinstance(message, Setting)
    assert (message.number, message.value) == (number, value)


@pytest.mark.parametrize(("dialect", "request_bytes", "line", "number", "value"), for_each_dialect(TABLES["SETTINGS"]))
def test_settings_board(dialect: str, request_bytes: bytes, line: bytes, number: int, value: float) -> None:
    host = grbl_board(dialect)
    assert host.ask(request_bytes) == b"ok\r\n"
    lines = host.ask(b"$$\n", 0.5).splitlines(keepends=True)
    assert lines.count(line) == 1
    assert lines[-1] == b"ok\r\n"
