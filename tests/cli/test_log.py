"""`--log FILE`: JSON lines with the run's id, of what happens and of how a command fails; never a reason to fail."""

import json
import logging
import math
from pathlib import Path
from typing import Any

import pytest
from mill_command import mill

from cli.log import Logged, logged
from drivers.errors import ConfigError, DeviceError
from drivers.recorder import NullRecorder


def lines(path: Path) -> list[dict[str, Any]]:
    def no_constant(text: str) -> float:
        raise ValueError(text)

    return [json.loads(line, parse_constant=no_constant) for line in path.read_text().splitlines()]


def nothing_lost(words: str) -> None:
    pytest.fail(words)


def test_events_that_a_person_would_be_told_are_lines_with_the_run(tmp_path: Path) -> None:
    path = tmp_path / "mill.log"
    with logged(path, nothing_lost, run="first", command="run"):
        told = Logged(NullRecorder())
        told.event("stage", stage="mill", detail="")
        told.event("load", torque=0.1, rpm=50_000.0, tip_mm=(1.0, 2.0, 3.0))
        told.event("lap", lap=1.0, torque=math.nan, depth_mm=[0.1, 0.2])
        told.event("latched", reaction="RETRACT", reason="stopped by a person")
        told.event("outcome", outcome="held", reason="why", points=({"depth_mm": 0.1},))
        logging.getLogger("pymodbus").warning("a frame of %d bytes", 3)
    found = lines(path)
    assert [(each["level"], each["message"]) for each in found] == [
        ("INFO", "begins"),
        ("INFO", "stage: mill"),
        ("INFO", "lap"),
        ("ERROR", "latched: RETRACT: stopped by a person"),
        ("WARNING", "outcome: held: why"),
        ("WARNING", "a frame of 3 bytes"),
    ]
    assert all(each["run"] == "first" and each["time"].endswith("+00:00") for each in found)
    assert (found[2]["lap"], found[2]["torque"], "depth_mm" in found[2]) == (1.0, None, False)


def test_runs_share_a_file_and_errors_are_told(tmp_path: Path) -> None:
    path = tmp_path / "mill.log"
    for run, error in (
        ("first", DeviceError("spindle: it is off")),
        ("second", KeyboardInterrupt()),
        ("third", ZeroDivisionError()),
    ):
        with pytest.raises(type(error)), logged(path, nothing_lost, run=run):
            raise error
    found = [(each["run"], each["level"]) for each in lines(path) if each["message"] != "begins"]
    assert found == [("first", "ERROR"), ("second", "WARNING"), ("third", "ERROR")]
    assert "ZeroDivisionError" in lines(path)[-1]["traceback"]
    logging.getLogger("mill").error("outside")
    assert len(lines(path)) == 6


def test_a_file_that_takes_no_more_ends_the_log_and_says_so_once() -> None:
    lost: list[str] = []
    with logged(Path("/dev/full"), lost.append, run="first"):
        told = Logged(NullRecorder())
        told.event("stage", stage="mill", detail="")
        told.event("stage", stage="look", detail="")
    assert len(lost) == 1
    assert "the log ends here" in lost[0]
    assert "No space left" in lost[0]


def test_without_a_file_nothing_is_touched() -> None:
    before = logging.getLogger().handlers[:]
    with logged(None, nothing_lost, run="first"):
        assert logging.getLogger().handlers == before


def test_a_file_that_cannot_be_opened_is_one_line_before_anything_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ConfigError, match="name another --log file"), logged(tmp_path, nothing_lost):
        pass
    assert mill("run", "--emulate", "--log", str(tmp_path / "no" / "such.log")) == 2
    said = capsys.readouterr().err
    assert "--log" in said
    assert said.count("\n") == 1
