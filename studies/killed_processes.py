"""The program that mills, its supervisor, or both are killed by SIGKILL while the tip runs: when tip and drill stand.

    python -m studies.killed_processes --kills 60 --json FILE

Real processes on the wires of a served bench: one runs the tip round a circle in short segments with the loop's own
hands and supervisor, in the air; the bench's own truth is read every millisecond. A third of the kills takes the
program, a third the supervisor, a third both. Where one survives it holds the motion and lifts the tip; where none
does, the motion board runs out of what is queued, and the drive misses its host.
"""

import argparse
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import cos, pi, sin
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.clock import SystemClock
from drivers.errors import MillError
from drivers.motion.grbl.driver import GrblController
from drivers.motion.serial_line import open_serial
from drivers.recorder import NullRecorder
from drivers.spindle.canbus import open_bus
from drivers.spindle.cia402 import Cia402Spindle
from firmware_sim.bench import MAX_FEED_MM_S, MAX_SPEED_RPM, MECHANICAL_SETTINGS, NODE_ID, ORIGIN_MM, Bench
from firmware_sim.cia402_drive import State
from firmware_sim.serve import BenchService
from firmware_sim.specimen import draw_specimen
from milling.guard import Guard
from milling.hands import QUEUED_S, Hands
from milling.latch import Latch, Reaction

VICTIMS: Final = ("program", "supervisor", "both")
BAUD: Final = 115_200
BITRATE: Final = 1_000_000
SPEED_RPM: Final = 45_000.0
FEED_MM_S: Final = 5.0
SEGMENT_S: Final = 0.04
RADIUS_MM: Final = 2.0
ABOVE_MM: Final = 4.0
"""Over the middle of the skull."""
WATCHED_S: Final = 1.5
MOVES_MM_S: Final = 0.5
STANDS_RPM: Final = 100.0
START_S: Final = 90.0


def run_circles(motion_port: str, spindle_port: str, center_mm: tuple[float, float, float]) -> None:
    """The program that is killed: circles until something fails, then a lift."""
    clock = SystemClock()
    with (
        Cia402Spindle(
            open_bus("slcan", spindle_port, BITRATE), clock, node_id=NODE_ID, max_speed_rpm=MAX_SPEED_RPM
        ) as spindle,
        GrblController(
            open_serial(motion_port, BAUD),
            clock,
            origin_mm=ORIGIN_MM,
            max_feed_mm_per_s=MAX_FEED_MM_S,
            expected_settings=MECHANICAL_SETTINGS,
        ) as motion,
    ):
        path = motion.stop_path
        assert path is not None
        with Guard(path, clock, alarm=spindle.alarm_path) as guard:
            motion.home()
            hands = Hands(motion, spindle, clock, NullRecorder(), lambda: False, guard)
            x, y, z = center_mm
            hands.go_high((x + RADIUS_MM, y, z), z)
            hands.start_spindle(SPEED_RPM)
            hands.into_the_bone()
            print(f"supervisor {guard.process_id}", flush=True)
            try:
                _circle(hands, x, y, z)
            except (MillError, OSError) as error:
                hands.make_safe(Latch(Reaction.RETRACT, str(error)))


def _circle(hands: Hands, x: float, y: float, z: float) -> None:
    began_s, written = hands.clock.now_s(), 0
    while True:
        hands.beat()
        while written * SEGMENT_S < hands.clock.now_s() - began_s + QUEUED_S - SEGMENT_S:
            written += 1
            angle = written * SEGMENT_S * FEED_MM_S / RADIUS_MM
            target = (x + RADIUS_MM * cos(angle), y + RADIUS_MM * sin(angle), z)
            hands.motion.start_move(target, feed_mm_per_s=FEED_MM_S)
        hands.motion.status()
        hands.clock.sleep_s(0.004)


@dataclass
class _Killer:
    """Looks at the bench between its ticks, and kills."""

    bench: Bench
    command: list[str]
    kills: int
    rng: np.random.Generator
    results: list[dict[str, Any]] = field(default_factory=list)
    ended_by_themselves: int = 0
    _program: "subprocess.Popen[str] | None" = None
    _supervisor: int = 0
    _kill_at_s: float | None = None
    _killed_s: float | None = None
    _track: list[tuple[float, float, float, float, float, bool]] = field(default_factory=list)
    _deadline_s: float = 0.0

    def look(self) -> bool:
        """Called about every millisecond; whether all is done."""
        now_s = self.bench.now_s
        if self._program is None:
            if len(self.results) == self.kills:
                return True
            self._program = subprocess.Popen(self.command, stdout=subprocess.PIPE, text=True)
            self._deadline_s = now_s + START_S
        elif self._kill_at_s is None:
            assert self._program.stdout is not None
            if select.select([self._program.stdout], [], [], 0.0)[0]:
                said = self._program.stdout.readline().split()
                if not said:
                    self._give_up()
                    return False
                self._supervisor = int(said[1])
                self._kill_at_s = now_s + float(self.rng.uniform(0.3, 0.3 + 2 * pi * RADIUS_MM / FEED_MM_S))
            elif now_s > self._deadline_s:
                raise RuntimeError(f"the program ran no circles within {START_S:g} s")
        elif self._killed_s is None:
            if self._program.poll() is not None:
                self._give_up()
            elif now_s >= self._kill_at_s:
                self._kill()
                self._killed_s = self.bench.now_s
        else:
            machine = self.bench.machine
            x, y, z = (float(value) for value in machine.tip_mm)
            powered = self.bench.drive.state is State.OPERATION_ENABLED
            self._track.append((now_s - self._killed_s, x, y, z, float(machine.spindle_rpm), powered))
            if now_s - self._killed_s > WATCHED_S:
                self._end()
        return False

    def _give_up(self) -> None:
        """Nobody has killed it: the load of this machine may have kept it from giving signs of life."""
        self.ended_by_themselves += 1
        if self.ended_by_themselves > self.kills:
            raise RuntimeError("the program ends by itself again and again; is the machine busy?")
        self._program, self._kill_at_s = None, None

    @property
    def _victim(self) -> str:
        return VICTIMS[len(self.results) % len(VICTIMS)]

    def _kill(self) -> None:
        assert self._program is not None
        if self._victim in ("supervisor", "both"):
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._supervisor, signal.SIGKILL)
        if self._victim in ("program", "both"):
            self._program.kill()

    def _end(self) -> None:
        program = self._program
        assert program is not None
        program.kill()
        program.wait()
        t, x, y, z, rpm, powered = (np.array(column) for column in zip(*self._track, strict=True))
        speed = np.hypot(np.diff(x), np.diff(y)) / np.maximum(np.diff(t), 1e-6)
        moving = t[1:][speed > MOVES_MM_S]
        self.results.append(
            {
                "killed": self._victim,
                "standstill_s": float(moving.max()) if len(moving) else 0.0,
                "lifted_mm": float(z[-1] - z[0]),
                "lower_mm": float(z[0] - z.min()),
                "spindle_off_s": float(t[~powered][0]) if (~powered).any() else None,
                "spindle_stands_s": float(t[np.abs(rpm) < STANDS_RPM][0]) if (np.abs(rpm) < STANDS_RPM).any() else None,
            }
        )
        print(f"{len(self.results)}/{self.kills} {self.results[-1]}", flush=True)
        self._program, self._kill_at_s, self._killed_s = None, None, None
        self._track.clear()


def measure(kills: int, seed: int) -> dict[str, Any]:
    """Serve a bench and kill what runs on it; the worst times by victim."""
    bench = Bench(draw_specimen(seed))
    x, y, z = bench.specimen.skull.center_mm
    with BenchService(bench) as service:
        where = [service.motion_port, service.spindle_port, *(f"{value:.6f}" for value in (x, y, z + ABOVE_MM))]
        command = [sys.executable, "-m", "studies.killed_processes", "--circles", *where]
        killer = _Killer(bench, command, kills, np.random.default_rng(seed))
        service.run(killer.look)
        skipped_s = service.skipped_s
    figures: dict[str, Any] = {"command": "killed processes", "kills": kills, "bench_skipped_s": skipped_s}
    figures["ended_by_themselves"] = killer.ended_by_themselves
    for victim in VICTIMS:
        mine = [result for result in killer.results if result["killed"] == victim]
        if mine:
            figures[victim] = {
                "kills": len(mine),
                "standstill_s_worst": max(result["standstill_s"] for result in mine),
                "lower_mm_worst": max(result["lower_mm"] for result in mine),
                "lifted_mm_least": min(result["lifted_mm"] for result in mine),
                "spindle_off_s_worst": max(result["spindle_off_s"] or WATCHED_S for result in mine),
                "spindle_stands_s_worst": max(result["spindle_stands_s"] or WATCHED_S for result in mine),
            }
    return figures


def main(words: Sequence[str] | None = None) -> None:
    """Print the figures, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--circles", nargs=5, help=argparse.SUPPRESS)
    given = parser.parse_args(words)
    if given.circles:
        x, y, z = (float(value) for value in given.circles[2:])
        run_circles(given.circles[0], given.circles[1], (x, y, z))
        return
    figures = measure(given.kills, given.seed)
    for name, value in figures.items():
        print(f"{name}: {value}")
    if given.json:
        given.json.write_text(json.dumps(figures), encoding="utf-8")


if __name__ == "__main__":
    main()
