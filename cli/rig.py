"""Where devices get their concrete classes: from a rig file, or from a virtual bench in this process.

Everything past this file sees only the interfaces of `drivers`.
"""

import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import click

from cli.config import BcapMotion, Cia402SpindleTable, GrblMotion, OpenCvCamera, OtherBackend, RigConfig, load_rig
from cli.emulate import sorted_faults
from cli.options import BenchChoice
from drivers.backends import load_backend
from drivers.camera.interface import StereoCamera
from drivers.clock import Clock, SystemClock
from drivers.errors import ConfigError, ConnectionLostError, DeviceTimeoutError
from drivers.motion.interface import MotionController
from drivers.spindle.interface import Spindle

EMULATOR_START_S = 120.0
"""The first start of a virtual bench compiles its renderer."""
TRUTH_TIMEOUT_S = 5.0


class Rig(Protocol):
    """A bench whose devices can be opened, each on its own, and a clock that they share."""

    config: RigConfig
    clock: Clock

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

    def open_motion(self) -> MotionController:
        """Open the motion controller of the rig file."""
        table = self.config.motion
        if isinstance(table, OtherBackend):
            return cast(MotionController, load_backend("motion", table.backend)(_raw(table), self.clock))
        return open_bcap(table, self.clock) if isinstance(table, BcapMotion) else open_grbl(table, self.clock)

    def open_spindle(self) -> Spindle:
        """Open the spindle of the rig file."""
        table = self.config.spindle
        if isinstance(table, OtherBackend):
            return cast(Spindle, load_backend("spindle", table.backend)(_raw(table), self.clock))
        return open_cia402(table, self.clock)

    def open_camera(self) -> StereoCamera:
        """Open the stereo camera of the rig file."""
        table = self.config.camera
        if isinstance(table, OtherBackend):
            return cast(StereoCamera, load_backend("camera", table.backend)(_raw(table), self.clock))
        return open_opencv(table, self.clock)

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


def _raw(table: OtherBackend) -> Mapping[str, Any]:
    return table.model_dump(exclude={"backend"})


def open_grbl(table: GrblMotion, clock: Clock) -> MotionController:
    """GRBL on its serial port."""
    from drivers.motion.grbl.driver import GrblController
    from drivers.motion.serial_line import open_serial

    line = open_serial(table.port, table.baud)
    try:
        return GrblController(
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


def open_bcap(table: BcapMotion, clock: Clock) -> MotionController:
    """A DENSO robot at its address."""
    from drivers.motion.bcap.driver import BcapController
    from drivers.motion.interface import Travel
    from drivers.motion.udp_line import open_udp

    line = open_udp(table.host, table.port)
    try:
        return BcapController(
            line,
            clock,
            origin_mm=table.origin_mm,
            orientation_deg=table.orientation_deg,
            travel=Travel(table.travel_low_mm, table.travel_high_mm),
            max_feed_mm_per_s=table.max_feed_mm_s,
            reply_s=table.reply_s,
        )
    except BaseException:
        line.close()
        raise


def open_cia402(table: Cia402SpindleTable, clock: Clock) -> Spindle:
    """A CiA 402 drive on its bus."""
    from drivers.spindle.canbus import open_bus
    from drivers.spindle.cia402 import Cia402Spindle

    bus = open_bus(table.interface, table.channel, table.bitrate)
    try:
        return Cia402Spindle(
            bus, clock, node_id=table.node_id, max_speed_rpm=table.max_speed_rpm, heartbeat_s=table.heartbeat_s
        )
    except BaseException:
        bus.shutdown()
        raise


def open_opencv(table: OpenCvCamera, clock: Clock) -> StereoCamera:
    """Two OpenCV sources as one stereo pair."""
    from drivers.camera.opencv import OpenCvSource
    from drivers.camera.stereo import StereoPair

    def source(device: str) -> OpenCvSource:
        return OpenCvSource(
            device,
            clock,
            size_px=table.size_px,
            fps=table.fps,
            exposure=table.exposure,
            gain=table.gain,
            white_balance_k=table.white_balance_k,
        )

    left = source(table.left)
    try:
        right = source(table.right)
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
        if chosen.faults:
            raise click.UsageError("--fault belongs to --emulate or `mill emulate`; no fault is planted on a rig")
        yield WiredRig(load_rig(chosen.rig_file), SystemClock())
        return
    planted, own = sorted_faults(chosen.faults)
    if others := [fault for fault in own if fault.name.partition(".")[0] not in plants]:
        raise click.UsageError(f"--fault {others[0]}: belongs to `mill run --emulate`, which mills")
    with _served_bench(chosen.specimen, chosen.seed, [str(fault) for fault in planted]) as rig:
        yield rig


@contextlib.contextmanager
def _served_bench(specimen: Path | None, seed: int, faults: Sequence[str]) -> Iterator[WiredRig]:
    """Start `mill emulate` as its own process, on ptys and ports, for as long as the with-statement."""
    if specimen is not None and not specimen.is_file():
        raise ConfigError(f"{specimen}: no such specimen file; docs/specimen.md says how to write one")
    with tempfile.TemporaryDirectory(prefix="mill-bench-") as folder:
        rig_file, truth_file, log_file = (Path(folder) / name for name in ("rig.toml", "truth.json", "log.txt"))
        command = [sys.executable, "-m", "cli.main", "emulate", "--seed", str(seed), "--until-stdin-closes"]
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
