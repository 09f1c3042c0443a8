"""Where devices get their concrete classes: from a rig file, or from a virtual bench in a process beside this one.

Everything past this file sees only the interfaces of `drivers`.
"""

import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import click

from cli.config import (
    BcapMotion,
    GrblSpindleTable,
    ModbusSpindleTable,
    OtherBackend,
    RigConfig,
    TinyGMotion,
    load_rig,
)
from cli.emulate import sorted_faults
from cli.makes import open_bcap, open_cia402, open_grbl, open_modbus, open_opencv, open_tinyg
from cli.options import BenchChoice
from drivers.backends import load_backend
from drivers.camera.interface import StereoCamera
from drivers.clock import Clock, SystemClock
from drivers.errors import ConfigError, ConnectionLostError, DeviceTimeoutError
from drivers.motion.interface import MotionController
from drivers.recorder import Recorder, TracedRecorder
from drivers.spindle.interface import Spindle
from drivers.trace_file import Trace
from drivers.traced_devices import TracedMotion, TracedSpindle

if TYPE_CHECKING:
    from drivers.motion.grbl.driver import GrblController

EMULATOR_START_S = 120.0
"""The first start of a virtual bench compiles its renderer."""
TRUTH_TIMEOUT_S = 5.0


class Rig(Protocol):
    """A bench whose devices can be opened, each on its own, and a clock that they share."""

    config: RigConfig
    clock: Clock
    trace: Trace | None

    def open_motion(self) -> MotionController:
        """Open the motion controller."""

    def open_spindle(self) -> Spindle:
        """Open the spindle."""

    def open_camera(self) -> StereoCamera:
        """Open both cameras."""

    def truth_now(self) -> dict[str, Any] | None:
        """What a virtual bench last said about itself, for scoring; None on hardware."""

    def truth(self) -> dict[str, Any] | None:
        """The same, of a moment after the call."""


@dataclass
class WiredRig:
    """Devices on the wires that a rig file names."""

    config: RigConfig
    clock: Clock
    truth_file: Path | None = None
    trace: Trace | None = None
    """Takes down what passes over the wires, what is asked of the devices, and what the program decides."""
    _drills_own: "GrblController | None" = None
    """A controller that was opened for its drill alone; it is closed with the drill unless its motion is opened too."""
    _controller: "GrblController | None" = None
    """The controller that is open, if a drill may hang on it."""

    def open_motion(self) -> MotionController:
        """Open the motion controller of the rig file; the one that was opened for its drill, where there is one."""
        if self.trace is None:
            return self._motion()
        with self.trace.call("motion", "open"):
            return TracedMotion(self._motion(), self.trace)

    def _motion(self) -> MotionController:
        if self._drills_own is not None:
            controller, self._drills_own = self._drills_own, None
            return controller
        table = self.config.motion
        if isinstance(table, OtherBackend):
            return cast(MotionController, load_backend("motion", table.backend)(_raw(table), self.clock))
        if isinstance(table, TinyGMotion):
            return open_tinyg(table, self.clock, self.trace)
        if isinstance(table, BcapMotion):
            return open_bcap(table, self.clock, self.trace, silence_s=silence_s(self.config))
        self._controller = open_grbl(table, self.clock, self.trace)
        return self._controller

    def open_spindle(self) -> Spindle:
        """Open the spindle of the rig file."""
        if self.trace is None:
            return self._spindle()
        with self.trace.call("spindle", "open"):
            return TracedSpindle(self._spindle(), self.trace)

    def _spindle(self) -> Spindle:
        table = self.config.spindle
        if isinstance(table, OtherBackend):
            return cast(Spindle, load_backend("spindle", table.backend)(_raw(table), self.clock))
        if isinstance(table, GrblSpindleTable):
            return self._open_on_controller(table)
        if isinstance(table, ModbusSpindleTable):
            return open_modbus(table, self.clock, self.trace)
        return open_cia402(table, self.clock, self.trace)

    def _open_on_controller(self, table: GrblSpindleTable) -> Spindle:
        from drivers.spindle.grbl import GrblSpindle

        if self._controller is None or self._controller.session.is_lost:
            self._motion()
            self._drills_own = self._controller
        controller = self._controller
        assert controller is not None
        try:
            return GrblSpindle(
                controller,
                self.clock,
                max_speed_rpm=table.max_speed_rpm,
                run_up_s=table.run_up_s,
                on_close=self._close_drills_own,
            )
        except BaseException:
            self._close_drills_own()
            raise

    def _close_drills_own(self) -> None:
        if self._drills_own is not None:
            controller, self._drills_own = self._drills_own, None
            controller.close()

    def open_camera(self) -> StereoCamera:
        """Open the stereo camera of the rig file."""
        table = self.config.camera
        if isinstance(table, OtherBackend):
            return cast(StereoCamera, load_backend("camera", table.backend)(_raw(table), self.clock))
        return open_opencv(table, self.clock, self.trace)

    def truth_now(self) -> dict[str, Any] | None:
        """The newest truth of a virtual bench; None on hardware."""
        if self.truth_file is None or not self.truth_file.is_file():
            return None
        return cast(dict[str, Any], json.loads(self.truth_file.read_text()))

    def truth(self) -> dict[str, Any] | None:
        """The truth of a virtual bench after the call; None on hardware.

        Raises:
            DeviceTimeoutError: the bench is silent.
        """
        if self.truth_file is None:
            return None
        asked_s = self.clock.now_s()
        while (truth := self.truth_now()) is None or truth["monotonic_s"] < asked_s:
            if self.clock.now_s() > asked_s + TRUTH_TIMEOUT_S:
                raise DeviceTimeoutError(f"virtual bench: no truth for {TRUTH_TIMEOUT_S:g} s; see `mill emulate`")
            self.clock.sleep_s(0.05)
        return truth


def traced(recorder: Recorder, bench: Rig) -> Recorder:
    """The recorder, and the bench's trace beside it if there is one."""
    return recorder if bench.trace is None else TracedRecorder(recorder, bench.trace)


def silence_s(config: RigConfig) -> float:
    """How long a supervisor waits for a sign of life.

    Between two of them the loop may wait for both wires in turn, as long as the rig file allows: three reports of the
    motion controller, and the drive.
    """
    from milling.guard import SILENCE_S

    reply_s: float = config.motion.model_dump().get("reply_s", 0.0)
    heartbeat_s: float = config.spindle.model_dump().get("heartbeat_s", 0.0)
    return max(SILENCE_S, 3 * reply_s + heartbeat_s)


def _raw(table: OtherBackend) -> Mapping[str, Any]:
    return table.model_dump(exclude={"backend"})


@contextlib.contextmanager
def rig_for(chosen: BenchChoice, *, plants: Collection[str] = ()) -> Iterator[Rig]:
    """The rig of a file, or a virtual bench that lives as long as the with-statement.

    ``plants`` names the families of faults that the command itself plants, on its own side.

    Raises:
        click.UsageError: neither or both were asked for.
        ConfigError: a file that cannot be used; nothing was opened.
    """
    if chosen.emulate == (chosen.rig_file is not None):
        raise click.UsageError("give either --emulate (a virtual bench) or --rig FILE (devices)")
    if chosen.rig_file is not None:
        if chosen.specimen is not None:
            raise click.UsageError("--specimen belongs to --emulate; with --rig the specimen is what lies on the bench")
        if chosen.motion != "grbl":
            raise click.UsageError("--motion belongs to --emulate; with --rig the rig file names the controller")
        if chosen.faults:
            raise click.UsageError("--fault belongs to --emulate or `mill emulate`; no fault is planted on a rig")
        with _traced(WiredRig(load_rig(chosen.rig_file), SystemClock()), chosen) as rig:
            yield rig
        return
    planted, own = sorted_faults(chosen.faults)
    if others := [fault for fault in own if fault.name.partition(".")[0] not in plants]:
        raise click.UsageError(f"--fault {others[0]}: belongs to `mill run --emulate`, which mills")
    with (
        _served_bench(chosen, [str(fault) for fault in planted]) as served,
        _traced(served, chosen) as rig,
    ):
        yield rig


@contextlib.contextmanager
def _traced(rig: WiredRig, chosen: BenchChoice) -> Iterator[WiredRig]:
    """The rig with a trace, if one is asked for."""
    about = {"seed": chosen.drawn_from, "faults": list(chosen.faults)}
    with trace_of(chosen.trace_file, rig.clock, rig.config, about) as trace:
        yield rig if trace is None else replace(rig, trace=trace)


@contextlib.contextmanager
def trace_of(
    path: Path | None, clock: Clock, config: RigConfig | None, about: Mapping[str, Any]
) -> Iterator[Trace | None]:
    """The file of ``--trace``; None where none is asked for."""
    if path is None:
        yield None
        return
    header = {
        "version": version("micromill"),
        "command": click.get_current_context().info_name,
        **about,
        "rig": None if config is None else config.model_dump(mode="json", by_alias=True),
    }
    with Trace(path, clock, header, on_loss=lambda words: click.echo(words, err=True)) as trace:
        yield trace


@contextlib.contextmanager
def _served_bench(chosen: BenchChoice, faults: Sequence[str]) -> Iterator[WiredRig]:
    """Start `mill emulate` as its own process, on ptys and ports, for as long as the with-statement."""
    specimen = chosen.specimen
    if specimen is not None and not specimen.is_file():
        raise ConfigError(f"{specimen}: no such specimen file; docs/specimen.md says how to write one")
    with tempfile.TemporaryDirectory(prefix="mill-bench-") as folder:
        rig_file, truth_file, log_file = (Path(folder) / name for name in ("rig.toml", "truth.json", "log.txt"))
        command = [sys.executable, "-m", "cli.main", "emulate", "--seed", str(chosen.seed), "--until-stdin-closes"]
        command += ["--motion", chosen.motion]
        command += ["--rig-out", str(rig_file), "--truth-out", str(truth_file)]
        command += ["--specimen", str(specimen)] if specimen else []
        command += [word for fault in faults for word in ("--fault", fault)]
        with log_file.open("w") as log:
            # A session of its own: Ctrl-C at the terminal is for the command, which still needs the bench to stop well.
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        try:
            _wait_for(rig_file, process, log_file)
            yield WiredRig(load_rig(rig_file), SystemClock(), truth_file)
        finally:
            _end(process)


def _wait_for(rig_file: Path, process: "subprocess.Popen[bytes]", log_file: Path) -> None:
    clock = SystemClock()
    deadline_s = clock.now_s() + EMULATOR_START_S
    while not rig_file.is_file():
        if process.poll() is not None:
            said = log_file.read_text().strip().splitlines()
            reason = said[-1].removeprefix("mill: ") if said else f"exit code {process.returncode}"
            raise ConfigError(reason) if process.returncode == 2 else ConnectionLostError(f"virtual bench: {reason}")
        if clock.now_s() > deadline_s:
            raise ConnectionLostError(f"virtual bench: not ready after {EMULATOR_START_S:.0f} s; see `mill emulate`")
        clock.sleep_s(0.05)


def _end(process: "subprocess.Popen[bytes]") -> None:
    if process.stdin is not None and not process.stdin.closed:
        process.stdin.close()
    try:
        process.wait(timeout=10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
