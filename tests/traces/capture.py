"""Captures the sessions beside this file anew: `python tests/traces/capture.py`, from the repository's root.

The robot's is captured on the virtual clock: in real time a process of its own feeds it, which takes no calls.
"""

import tempfile
from contextlib import suppress
from pathlib import Path

import click

from cli.config import BcapMotion
from cli.options import BenchChoice
from cli.rig import rig_for
from drivers.clock import Clock
from drivers.errors import DeviceFaultError, OutOfTravelError
from drivers.motion.bcap.driver import BcapController
from drivers.motion.interface import Travel
from drivers.motion.transport import DatagramLine
from drivers.trace import TracedDatagrams
from drivers.trace_file import Trace
from drivers.traced_devices import TracedMotion
from firmware_sim.bench import (
    ROBOT_ORIENTATION_DEG,
    ROBOT_ORIGIN_MM,
    ROBOT_TRAVEL_HIGH_MM,
    ROBOT_TRAVEL_LOW_MM,
    Bench,
)
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessLine

HERE = Path(__file__).parent


def motion_session(folder: Path) -> Path:
    """Open, home, two moves, a hold and its end, a flush in the middle of a move, close."""
    file = folder / "motion-session.jsonl"
    with rig_for(BenchChoice(emulate=True, trace_file=file)) as rig, rig.open_motion() as motion:
        motion.home()
        motion.start_move((6.0, -4.0, 5.0), feed_mm_per_s=15.0)
        motion.wait_until_idle(10.0)
        motion.start_move((4.0, -4.0, 4.0), feed_mm_per_s=4.0)
        rig.clock.sleep_s(0.2)
        motion.hold()
        rig.clock.sleep_s(0.2)
        motion.resume()
        motion.wait_until_idle(10.0)
        motion.start_move((0.0, 0.0, 4.0), feed_mm_per_s=8.0)
        rig.clock.sleep_s(0.2)
        motion.flush()
        motion.status()
    return file


def robot(table: BcapMotion, line: DatagramLine, clock: Clock) -> BcapController:
    """The robot of a rig file, on any line."""
    return BcapController(
        line,
        clock,
        origin_mm=table.origin_mm,
        orientation_deg=table.orientation_deg,
        travel=Travel(table.travel_low_mm, table.travel_high_mm),
        max_feed_mm_per_s=table.max_feed_mm_s,
        reply_s=table.reply_s,
    )


def robot_session(folder: Path) -> Path:
    """Open, home, two moves, a hold that a flush ends, a move that would leave the box, a halt, home again, close."""
    file = folder / "robot-session.jsonl"
    table = BcapMotion(
        host="192.168.0.1",
        port=5007,
        origin_mm=ROBOT_ORIGIN_MM,
        orientation_deg=ROBOT_ORIENTATION_DEG,
        travel_low_mm=ROBOT_TRAVEL_LOW_MM,
        travel_high_mm=ROBOT_TRAVEL_HIGH_MM,
    )
    clock, bench = SimClock(), Bench(seed=0, motion="bcap")
    clock.attach(bench.advance_to)
    with Trace(file, clock, {"command": "capture", "seed": 0, "rig": {"motion": table.model_dump()}}) as trace:
        with trace.call("motion", "open"):
            arm = robot(table, TracedDatagrams(InProcessLine(bench, clock, name="trace"), trace, "motion"), clock)
        with TracedMotion(arm, trace) as motion:
            motion.home()
            x, y, z = motion.status().position_mm
            motion.start_move((x - 2.0, y - 1.0, z - 2.0), feed_mm_per_s=15.0)
            motion.wait_until_idle(10.0)
            motion.start_move((x - 4.0, y - 1.0, z - 2.0), feed_mm_per_s=4.0)
            for _ in range(8):
                motion.status()
            motion.hold()
            motion.flush()
            with suppress(OutOfTravelError):
                motion.start_move((x + 100.0, y, z), feed_mm_per_s=4.0)
            motion.start_move((x - 6.0, y - 1.0, z - 2.0), feed_mm_per_s=8.0)
            motion.status()
            motion.halt()
            with suppress(DeviceFaultError):
                motion.wait_until_idle(1.0)
            motion.home()
            motion.status()
    return file


def spindle_session(folder: Path) -> Path:
    """Open, run up, a few reports, another speed, stop, close."""
    file = folder / "spindle-session.jsonl"
    with rig_for(BenchChoice(emulate=True, trace_file=file)) as rig, rig.open_spindle() as spindle:
        spindle.start(30_000.0)
        spindle.wait_until_at_speed(3.0)
        for _ in range(10):
            spindle.status()
            rig.clock.sleep_s(0.02)
        spindle.start(45_000.0)
        spindle.wait_until_at_speed(3.0)
        spindle.stop()
        spindle.wait_until_at_speed(3.0)
    return file


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, click.Context(click.Command("capture"), info_name="capture"):
        for session in (motion_session, robot_session, spindle_session):
            captured = session(Path(folder))
            (HERE / captured.name).write_bytes(captured.read_bytes())
            print(HERE / captured.name)
