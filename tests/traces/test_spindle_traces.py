"""Captured sessions with a CiA 402 drive: the driver sends the same frames again, and the drive answers the same.

What is the same, for the drive: every SDO answer and every EMCY, in its order. TPDOs are as many; the drive is told
things at the times of a real clock, stamped a moment beside the truth, so that a state is that of this TPDO or of a
neighbour, a speed lies between the neighbours' with 1 % of the greatest speed to spare, and torque, which is noise and
control here, is not compared. Heartbeats may be one more or less.
"""

from pathlib import Path

import pytest
from playback import Playback, PlayedBus, fed_drive, play

from cli.config import Cia402SpindleTable
from drivers.spindle.cia402 import Cia402Spindle
from drivers.spindle.cia402_profile import DriveState
from drivers.spindle.cia402_setup import REPORT_LAYOUT
from drivers.trace_file import frame_of

HERE = Path(__file__).parent
TRACES = sorted(HERE.glob("spindle-*.jsonl"))
OF_RIGS = sorted(HERE.glob("rig-spindle-*.jsonl"))
"""Of devices: played to the driver alone."""
HOST_BEAT = "77F#05"


def named(path: Path) -> str:
    return path.stem


@pytest.mark.parametrize("file", [*TRACES, *OF_RIGS], ids=named)
def test_the_driver_sends_the_same_frames(file: Path) -> None:
    playback = Playback(file, "spindle", beat=HOST_BEAT)
    table = Cia402SpindleTable.model_validate(playback.header["rig"]["spindle"])
    play(
        playback,
        lambda clock: Cia402Spindle(
            PlayedBus(playback),
            clock,
            node_id=table.node_id,
            max_speed_rpm=table.max_speed_rpm,
            heartbeat_s=table.heartbeat_s,
        ),
    )
    assert not playback.entries


def of(frames: list[str], *functions: int) -> list[str]:
    return [text for text in frames if frame_of(text)[0] & 0x780 in functions]


def reports(frames: list[str]) -> list[tuple[DriveState | None, int]]:
    found = (REPORT_LAYOUT.unpack(frame_of(text)[2]) for text in of(frames, 0x180))
    return [(DriveState.of(statusword), speed_rpm) for statusword, speed_rpm, _ in found]


@pytest.mark.parametrize("file", TRACES, ids=named)
def test_the_emulated_drive_answers_the_same(file: Path) -> None:
    was, now = fed_drive(file)
    assert of(now, 0x580, 0x080) == of(was, 0x580, 0x080)
    assert abs(len(of(now, 0x700)) - len(of(was, 0x700))) <= 1
    assert set(of(now, 0x700)) == set(of(was, 0x700))
    assert len(reports(now)) == len(reports(was))
    for number, (state, speed_rpm) in enumerate(reports(now)):
        near = reports(was)[max(0, number - 1) : number + 2]
        assert state in {each for each, _ in near}, number
        speeds = [each for _, each in near]
        assert min(speeds) - 600 <= speed_rpm <= max(speeds) + 600, number
