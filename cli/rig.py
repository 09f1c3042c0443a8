"""Where devices get their concrete classes: from a rig file, or from a virtual bench in this process.

Everything past this file sees only the interfaces of `drivers`.
"""

import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import click

from cli.config import (
    BcapMotion,
    Cia402SpindleTable,
    GrblMotion,
    GrblSpindleTable,
    ModbusSpindleTable,
    OpenCvCamera,
    OtherBackend,
    RigConfig,
    TinyGMotion,
    load_rig,
)
from cli.emulate import sorted_faults
from cli.options import BenchChoice
from drivers.backends import load_backend
from drivers.camera.interface import StereoCamera
from drivers.clock import Clock, SystemClock
from drivers.errors import ConfigError, ConnectionLostError, DeviceTimeoutError
from drivers.motion.interface import MotionController
from drivers.motion.transport import SerialLine
from drivers.recorder import Recorder, TracedRecorder
from drivers.spindle.interface import Spindle
from drivers.trace_file import Trace
from drivers.traced_devices import TracedMotion, TracedSpindle

if TYPE_CHECKING:
    from drivers.motion.grbl.driver import GrblController

Board = TypeVar("Board", bound=MotionController)

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


def open_grbl(table: GrblMotion, clock: Clock, trace: Trace | None = None) -> "GrblController":
    """GRBL on its serial port."""
    from drivers.motion.grbl.driver import GrblController

    return _open_board(GrblController, table, clock, trace)


def open_tinyg(table: TinyGMotion, clock: Clock, trace: Trace | None = None) -> MotionController:
    """A g2core board on its serial port."""
    from drivers.motion.tinyg.driver import TinyGController

    return _open_board(TinyGController, table, clock, trace)


def _open_board(
    make: Callable[..., Board], table: GrblMotion | TinyGMotion, clock: Clock, trace: Trace | None
) -> Board:
    line = _serial_line(table.port, table.baud, trace)
    try:
        return make(
            line,
            clock,
            origin_mm=table.origin_mm,
            max_feed_mm_per_s=table.max_feed_mm_s,
            expected_settings=table.settings,
            expected_firmware=table.firmware,
            reply_s=table.reply_s,
        )
    except BaseException:
        line.close()
        raise


def open_bcap(table: BcapMotion, clock: Clock, trace: Trace | None = None, *, silence_s: float) -> MotionController:
    """A DENSO robot at its address, fed by a process of its own."""
    from drivers.motion.bcap.fed import FedRobot
    from drivers.motion.interface import Travel

    def noted(time_s: float, kind: str, datagram: bytes) -> None:
        assert trace is not None
        number, _ = trace.mark()
        trace.note((number, trace.seconds(time_s)), "motion", kind, datagram.decode("latin-1"))

    return FedRobot(
        table.host,
        table.port,
        clock,
        origin_mm=table.origin_mm,
        orientation_deg=table.orientation_deg,
        travel=Travel(table.travel_low_mm, table.travel_high_mm),
        max_feed_mm_per_s=table.max_feed_mm_s,
        reply_s=table.reply_s,
        silence_s=silence_s,
        noted=None if trace is None else noted,
    )


def _serial_line(
    port: str, baud: int, trace: Trace | None, *, wire: str = "motion", framing: str = "8N1"
) -> SerialLine:
    """A serial port, with a trace of what passes if one is asked for."""
    from drivers.motion.serial_line import open_serial

    line = open_serial(port, baud, framing=framing)
    if trace is None:
        return line
    from drivers.trace import TracedLine

    return TracedLine(line, trace, wire)


def open_cia402(table: Cia402SpindleTable, clock: Clock, trace: Trace | None = None) -> Spindle:
    """A CiA 402 drive on its bus."""
    from drivers.spindle.canbus import open_bus
    from drivers.spindle.cia402 import Cia402Spindle

    bus = open_bus(table.interface, table.channel, table.bitrate)
    if trace is not None:
        from drivers.trace import TracedBus

        bus = TracedBus(bus, trace, "spindle")
    try:
        return Cia402Spindle(
            bus, clock, node_id=table.node_id, max_speed_rpm=table.max_speed_rpm, heartbeat_s=table.heartbeat_s
        )
    except BaseException:
        bus.shutdown()
        raise


def open_modbus(table: ModbusSpindleTable, clock: Clock, trace: Trace | None = None) -> Spindle:
    """A Delta VFD on its serial line."""
    from drivers.spindle.modbus import ModbusSpindle

    return ModbusSpindle(
        _serial_line(table.port, table.baud, trace, wire="spindle", framing=table.framing),
        clock,
        station=table.station,
        baud=table.baud,
        max_speed_rpm=table.max_speed_rpm,
        rated_current_a=table.rated_current_a,
        poles=table.poles,
        frequency_unit_hz=10.0**-table.frequency_decimals,
        heartbeat_s=table.heartbeat_s,
    )


def open_opencv(table: OpenCvCamera, clock: Clock, trace: Trace | None = None) -> StereoCamera:
    """Two OpenCV sources as one stereo pair."""
    from drivers.camera.opencv import OpenCvSource
    from drivers.camera.stereo import FrameSource, StereoPair

    def source(device: str, wire: str) -> FrameSource:
        opened = OpenCvSource(
            device,
            clock,
            size_px=table.size_px,
            fps=table.fps,
            exposure=table.exposure,
            gain=table.gain,
            white_balance_k=table.white_balance_k,
        )
        if trace is None:
            return opened
        from drivers.trace import TracedSource

        return TracedSource(opened, trace, wire)

    left = source(table.left, "left")
    try:
        right = source(table.right, "right")
    except BaseException:
        left.close()
        raise
    return StereoPair(left, right, clock, size_px=table.size_px, max_skew_s=table.max_skew_s)


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
    if chosen.trace_file is None:
        yield rig
        return
    header = {
        "version": version("micromill"),
        "command": click.get_current_context().info_name,
        "seed": chosen.drawn_from,
        "faults": list(chosen.faults),
        "rig": rig.config.model_dump(mode="json", by_alias=True),
    }
    with Trace(chosen.trace_file, rig.clock, header, on_loss=lambda words: click.echo(words, err=True)) as trace:
        yield replace(rig, trace=trace)


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
