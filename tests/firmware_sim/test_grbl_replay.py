"""Dialogues recorded from real firmware, replayed: the host's side at the recorded times, every reply compared.

Positions agree within 60 um (8 ms at the dialogue's 500 mm/min), speeds within one prepared segment, times within
35 ms, homing within 120 ms. What differs otherwise is listed here, and justified in grbl_board's docstring.
"""

import ast
from dataclasses import dataclass
from pathlib import Path

import pytest
from grbl_bench import Desk, Host

DIALOGUES = Path(__file__).parent.parent / "data" / "grbl_dialogues"
BOOTED_S = 2.1
"""Until then the recorded firmware starts up and fills its blank memory; the board's memory is never blank."""
TIME_S = 0.035
HOMING_TIME_S = 0.12
HOMING_S = (11.2, 11.36)
POSITION_MM = 0.06
SEGMENT_MM_PER_MIN = 130.0
"""The speed changes by 120 mm/min within one segment of 10 ms at 200 mm/s2."""


@dataclass(frozen=True)
class Difference:
    """Lines of the recording from ``time_s`` on, in place of which the board says ``board``."""

    time_s: float
    count: int
    board: tuple[str, ...]


GNEA_DIFFERENCES = [
    Difference(2.3231, 1, ()),
    Difference(13.7386, 1, ("<Run|MPos:-19.000,-20.000,-20.000|Bf:15,128|FS:0,0>",)),
    Difference(14.6639, 1, ("<Run|MPos:-15.168,-20.000,-20.000|Bf:14,128|FS:500,0>",)),
    Difference(17.0411, 1, ("<Jog|MPos:-8.416,-20.000,-20.000|Bf:14,128|FS:0,0>",)),
    Difference(28.9870, 6, ("ALARM:1", "[MSG:Reset to continue]")),
]
HAL_DIFFERENCES = [
    Difference(2.8024, 1, ("<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0|Ov:100,100,100|A:|TLR:0>",)),
    Difference(19.0478, 1, ("<Run|MPos:-13.772,-20.000,-20.000|Bf:99,1023|FS:500,0|A:>",)),
    Difference(30.0780, 1, ("<Alarm|MPos:0.000,-20.000,-16.000|Bf:100,1023|FS:0,0|Pn:X|Ov:100,100,100|A:|TLR:0>",)),
]


def recorded(name: str) -> list[tuple[float, str, bytes | str]]:
    rows = []
    for line in (DIALOGUES / name).read_text().splitlines():
        time_s, direction, literal = line.strip().split(" ", 2)
        rows.append((float(time_s), direction, ast.literal_eval(literal)))
    return rows


def replayed(dialect: str, rows) -> list[tuple[float, str]]:
    host = Host(dialect, desk=Desk(switches_mm=(12.0, 10.0, 10.0), probe_mm=-20.0))
    host.run_until(rows[0][0])
    host.lines.clear()
    for time_s, direction, data in rows:
        if direction == ">":
            host.run_until(time_s)
            host.board.receive(data)
    host.run(0.5)
    return host.lines


def same_numbers(one: str, other: str, tolerance: float) -> bool:
    pairs = zip(one.split(","), other.split(","), strict=True)
    return all(abs(float(a) - float(b)) <= tolerance for a, b in pairs)


def same(one: str, other: str) -> bool:
    """Equal, but for positions and speeds that are read a few milliseconds apart."""
    if one == other:
        return True
    if one.startswith("[G54:") and other.startswith("[G54:"):
        return same_numbers(one[5:-1], other[5:-1], 0.0041)
    if not (one.startswith("<") and other.startswith("<")):
        return False
    ones, others = one[1:-1].split("|"), other[1:-1].split("|")
    if len(ones) != len(others):
        return False
    for a, b in zip(ones, others, strict=True):
        name, _, numbers = a.partition(":")
        other_name, _, other_numbers = b.partition(":")
        tolerance = {"MPos": POSITION_MM, "WPos": POSITION_MM, "WCO": 0.0041, "FS": SEGMENT_MM_PER_MIN}.get(name)
        if name != other_name or (tolerance is None and numbers != other_numbers):
            return False
        if tolerance is not None and not same_numbers(numbers, other_numbers, tolerance):
            return False
    return True


def expected(rows, differences) -> list[tuple[float, str]]:
    lines = [(time_s, data) for time_s, direction, data in rows if direction == "<"]
    for difference in differences:
        at = next(i for i, (time_s, _) in enumerate(lines) if abs(time_s - difference.time_s) < 1e-6)
        times = [time_s for time_s, _ in lines[at : at + difference.count]]
        lines[at : at + difference.count] = list(zip(times, difference.board, strict=False))
    return lines


@pytest.mark.parametrize(
    ("dialect", "name", "differences"),
    [("gnea", "gnea-1.1h.txt", GNEA_DIFFERENCES), ("grblhal", "grblhal.txt", HAL_DIFFERENCES)],
)
def test_the_board_answers_as_the_firmware_did(dialect, name, differences):
    rows = recorded(name)
    was = [line for line in expected(rows, differences) if line[0] > BOOTED_S]
    now = [line for line in replayed(dialect, rows) if line[0] > BOOTED_S]
    for index, ((was_s, was_line), (now_s, now_line)) in enumerate(zip(was, now, strict=False)):
        assert same(was_line, now_line), f"line {index} at {was_s}: {was_line!r} recorded, {now_line!r} replayed"
        limit_s = HOMING_TIME_S if HOMING_S[0] < was_s < HOMING_S[1] else TIME_S
        assert abs(was_s - now_s) < limit_s, f"line {index}: {was_line!r} at {was_s} recorded, at {now_s:.4f} replayed"
    assert len(was) == len(now)
