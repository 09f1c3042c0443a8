"""Captures the two sessions beside this file anew: `python tests/traces/capture.py`, from the repository's root."""

import tempfile
from pathlib import Path

import click

from cli.options import BenchChoice
from cli.rig import rig_for

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
        for session in (motion_session, spindle_session):
            captured = session(Path(folder))
            (HERE / captured.name).write_bytes(captured.read_bytes())
            print(HERE / captured.name)
