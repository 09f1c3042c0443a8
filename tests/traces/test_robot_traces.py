"""A captured session with a robot: the driver writes the same datagrams again, and the controller answers the same.

Driver and emulator both count time in set-points, and the session was captured on the virtual clock: nothing may differ
but the last digits of where the arm is, as a trace's times are whole microseconds.
"""

from dataclasses import replace
from pathlib import Path

import pytest
from capture import robot
from playback import Playback, PlayedLine, play

from cli.config import BcapMotion
from drivers.motion.bcap.packet import Value, decode
from drivers.trace_file import read_trace
from firmware_sim.bench import Bench

HERE = Path(__file__).parent
POSITION_MM = 1e-6
TRACES = sorted(HERE.glob("robot-*.jsonl"))


def table_of(playback: Playback) -> BcapMotion:
    return BcapMotion.model_validate(playback.header["rig"]["motion"])


def named(path: Path) -> str:
    return path.stem


@pytest.mark.parametrize("file", TRACES, ids=named)
def test_the_driver_writes_the_same_datagrams(file: Path) -> None:
    playback = Playback(file, "motion")
    play(playback, lambda clock: robot(table_of(playback), PlayedLine(playback), clock))
    assert not playback.entries


def test_another_datagram_is_told_with_its_line() -> None:
    """The playback itself can fail."""
    playback = Playback(HERE / "robot-session.jsonl", "motion")
    elsewhere = table_of(playback).model_copy(update={"origin_mm": (0.5, 0.0, 0.0)})
    with pytest.raises(AssertionError, match=r"line \d+ at .*the trace says out"):
        play(playback, lambda clock: robot(elsewhere, PlayedLine(playback), clock))


@pytest.mark.parametrize("file", TRACES, ids=named)
def test_the_emulated_controller_answers_the_same(file: Path) -> None:
    log = read_trace(file)
    entries = [entry for entry in log.entries if entry.wire == "motion"]
    bench = Bench(seed=log.header["seed"], motion="bcap")
    answers: list[bytes] = []
    was: list[bytes] = []
    for entry in entries:
        bench.advance_to(entry.t_s)
        while answer := bench.transmit():
            answers.append(answer)
        if entry.kind == "in":
            was.append(entry.data.encode("latin-1"))
            assert len(answers) >= len(was), f"line {entry.number} at {entry.t_s:.6f} s: not answered yet"
        elif entry.kind == "out":
            bench.receive(entry.data.encode("latin-1"))
    assert len(answers) == len(was)
    for now, before in zip(answers, was, strict=True):
        said, told = decode(now), decode(before)
        assert replace(said, arguments=()) == replace(told, arguments=())
        assert flat(said.arguments) == pytest.approx(flat(told.arguments), abs=POSITION_MM)


def flat(value: Value) -> list[object]:
    return [each for part in value for each in flat(part)] if isinstance(value, tuple) else [value]
