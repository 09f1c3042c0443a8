"""Captured sessions with a GRBL board: the driver writes the same bytes again, and the board says the same.

What is the same, for the board: every line but the reports, in its order. Reports are as many; a board that is told
things at the times of a real clock, stamped a moment beside the truth, may be one report early or late: its state and
its planner's room are those of this report or of a neighbour, its position lies between the neighbours' and its speed
is not compared. A report that carries no position is held to nothing but its place.
"""

from pathlib import Path

import pytest
from playback import Playback, PlayedLine, fed_board, play

from cli.config import GrblMotion
from drivers.motion.grbl.driver import GrblController

HERE = Path(__file__).parent
TRACES = sorted(HERE.glob("motion-*.jsonl"))
OF_RIGS = sorted(HERE.glob("rig-motion-*.jsonl"))
"""Of devices: played to the driver alone."""
STEP_MM = 0.002


def named(path: Path) -> str:
    return path.stem


@pytest.mark.parametrize("file", [*TRACES, *OF_RIGS], ids=named)
def test_the_driver_writes_the_same_bytes(file: Path) -> None:
    playback = Playback(file, "motion")
    table = GrblMotion.model_validate(playback.header["rig"]["motion"])
    play(
        playback,
        lambda clock: GrblController(
            PlayedLine(playback),
            clock,
            origin_mm=table.origin_mm,
            max_feed_mm_per_s=table.max_feed_mm_s,
            expected_settings=table.settings,
            expected_firmware=table.firmware,
            reply_s=table.reply_s,
        ),
    )
    assert not playback.entries


def test_another_byte_is_told_with_its_line(tmp_path: Path) -> None:
    """The playback itself can fail."""
    file = HERE / "motion-session.jsonl"
    playback = Playback(file, "motion")
    table = GrblMotion.model_validate(playback.header["rig"]["motion"])
    with pytest.raises(AssertionError, match=r"line \d+ at .*the trace says out 'G53G1X-19"):
        play(
            playback,
            lambda clock: GrblController(
                PlayedLine(playback), clock, origin_mm=(-25.5, -10.0, -20.0), max_feed_mm_per_s=table.max_feed_mm_s
            ),
        )


class Report:
    """A line in angle brackets, field by field."""

    def __init__(self, line: str) -> None:
        state, *fields = line.strip("<>").split("|")
        self.state = state
        self.fields = dict(field.split(":", 1) for field in fields)

    @property
    def position_mm(self) -> list[float]:
        return [float(number) for number in self.fields["MPos"].split(",")]


def split(said: bytes) -> tuple[list[str], list[Report]]:
    lines = [line for line in said.decode("latin-1").splitlines() if line]
    return [line for line in lines if line[0] != "<"], [Report(line) for line in lines if line[0] == "<"]


@pytest.mark.parametrize("file", TRACES, ids=named)
def test_the_emulated_board_says_the_same(file: Path) -> None:
    was, now = fed_board(file)
    (was_lines, was_reports), (lines, reports) = split(was), split(now)
    assert lines == was_lines
    assert len(reports) == len(was_reports)
    for number, report in enumerate(reports):
        near = was_reports[max(0, number - 1) : number + 2]
        assert report.state in {each.state for each in near}, number
        assert report.fields["Bf"] in {each.fields["Bf"] for each in near}, number
        for axis, value in enumerate(report.position_mm):
            values = [each.position_mm[axis] for each in near]
            assert min(values) - STEP_MM <= value <= max(values) + STEP_MM, number
