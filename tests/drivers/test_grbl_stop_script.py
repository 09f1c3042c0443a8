"""What another process writes to stop the motion, carried out by the board: hold, drop the queue, up."""

import numpy as np
import pytest

from drivers.motion.grbl.driver import GrblController
from drivers.motion.grbl.stop_script import STOP_SCRIPT
from drivers.motion.interface import StopPath
from firmware_sim.bench import MAX_FEED_MM_S, ORIGIN_MM, Bench, open_in_process
from firmware_sim.clock import SimClock
from firmware_sim.specimen import Specimen


def moving(dialect, feed_mm_per_s: float = 5.0) -> tuple[SimClock, Bench, object]:
    clock, bench = SimClock(), Bench(Specimen(seed=1), dialect=dialect)
    line, bus, _, _ = open_in_process(bench, clock)
    bus.shutdown()
    motion = GrblController(line, clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=MAX_FEED_MM_S)
    motion.home()
    motion.start_move((5.0, -10.0, 3.0), feed_mm_per_s=MAX_FEED_MM_S)
    motion.wait_until_idle(10.0)
    for step in range(1, 6):
        motion.start_move((5.0 + step, -10.0, 3.0 - 0.1 * step), feed_mm_per_s=feed_mm_per_s)
    clock.sleep_s(0.3)
    return clock, bench, line


@pytest.mark.parametrize("feed_mm_per_s", [5.0, 15.0])
@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_a_moving_tip_stands_at_once_and_then_goes_straight_up(dialect: str, feed_mm_per_s: float) -> None:
    clock, bench, line = moving(dialect, feed_mm_per_s)
    before = bench.machine.command_mm
    places = []
    for data, wait_s in STOP_SCRIPT:
        line.write(data)
        clock.sleep_s(wait_s)
        places.append(bench.machine.command_mm)
    assert np.linalg.norm(places[0] - before) < 0.12 * feed_mm_per_s, "what is prepared 50 to 90 ms ahead"
    assert places[0] == pytest.approx(places[1], abs=1e-6), "what was queued is dropped"
    clock.sleep_s(1.0)
    assert bench.machine.command_mm == pytest.approx(places[0] + [0.0, 0.0, 1.5], abs=2e-3)
    assert bench.board.state == "Idle"


def test_a_reset_in_motion_locks_the_board_and_nothing_is_lifted() -> None:
    clock, bench, line = moving("gnea")
    line.write(STOP_SCRIPT[1][0])
    clock.sleep_s(STOP_SCRIPT[1][1])
    stands = bench.machine.command_mm
    line.write(STOP_SCRIPT[2][0])
    clock.sleep_s(1.0)
    assert bench.machine.command_mm == pytest.approx(stands, abs=1e-6)
    assert bench.board.state == "Alarm"


def test_a_wire_that_no_other_process_can_reach_has_no_stop_path() -> None:
    clock, bench = SimClock(), Bench(Specimen(seed=1))
    line, bus, _, _ = open_in_process(bench, clock)
    bus.shutdown()
    with GrblController(line, clock, origin_mm=ORIGIN_MM, max_feed_mm_per_s=MAX_FEED_MM_S) as motion:
        assert motion.stop_path is None
        line.__class__ = type("Reachable", (line.__class__,), {"descriptor": property(lambda _: 7)})
        assert motion.stop_path == StopPath(7, STOP_SCRIPT)
