"""One bench in real time, on wires that other processes can open: two ptys (or a UDP port and one), two camera streams.

The boards run in the thread that calls ``run``: every millisecond it takes what the hosts wrote, brings the bench to
the present and sends what the boards answer. Pictures are drawn in threads of their own, in compiled code that does
not hold the interpreter, and only while somebody watches. When this process was kept from running, the bench catches
up a little at a time and takes the wires' bytes in between; of a long gap (another program held both cores, the
computer slept) most is left out, so that a drive does not take its own sleep for a silent host.
"""

import contextlib
import gc
import json
import os
import select
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2

from drivers.camera.interface import Image
from drivers.clock import Clock, SystemClock
from firmware_sim.bench import Bench
from firmware_sim.cutting import LOOK_AT_FLAP
from firmware_sim.machine import Machine
from firmware_sim.microscope import Microscope
from firmware_sim.mjpeg_camera import MjpegCameras
from firmware_sim.ptys import SerialPty
from firmware_sim.specimen import Specimen
from firmware_sim.udp_port import UdpPort

POLL_S = 0.001
CATCH_UP_S = 0.01
"""The longest stretch of bench time between two looks at the wires."""
LONGEST_LAG_S = 0.1
ROBOTS_LAG_S = 0.002
"""A robot takes a set-point every 8 ms: between two of them its host must be heard some times, however slow we are."""
TRUTH_PERIOD_S = 0.5
STATUS_PERIOD_S = 0.2
JPEG_QUALITY = 90
_SWITCH_INTERVAL_S = 0.0005


@dataclass(frozen=True)
class ServiceStatus:
    """What a status line shows."""

    time_s: float
    motion: str
    tip_mm: tuple[float, float, float]
    spindle_rpm: float
    depth_mm: float
    skipped_s: float


class BenchService:
    """A bench on ptys and ports. Open from construction; ``close`` ends every wire."""

    def __init__(self, bench: Bench, *, fps: float = 20.0, clock: Clock | None = None) -> None:
        self.bench = bench
        self.fps = fps
        self.skipped_s = 0.0
        self._clock = SystemClock() if clock is None else clock
        # First uses compile, and the first picture shades the scene: nobody should wait for that on an open wire.
        _compile(bench.specimen)
        for picture in bench.microscope.render(bench.now_s):
            _jpeg(picture)
        bench.truth()
        self._motion: SerialPty | UdpPort = UdpPort() if bench.motion == "bcap" else SerialPty()
        self._occupy()
        self._longest_lag_s = ROBOTS_LAG_S if bench.motion == "bcap" else LONGEST_LAG_S
        self._spindle = SerialPty()
        self._cameras = MjpegCameras(serial_number=bench.serial_number)
        self._ending = threading.Event()
        self._renderer = threading.Thread(target=self._stream, name="renderer", daemon=True)

    @property
    def motion_port(self) -> str:
        """Path of the motion board's serial port, or host and port of the robot's controller."""
        return self._motion.path

    @property
    def spindle_port(self) -> str:
        """Path of the serial port of the CAN adapter, or of the inverter."""
        return self._spindle.path

    @property
    def camera_urls(self) -> tuple[str, str]:
        """Left and right stream."""
        return self._cameras.url("left"), self._cameras.url("right")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Hang up; a second call does nothing."""
        if self._ending.is_set():
            return
        self._ending.set()
        self._cameras.close()
        if self._renderer.is_alive():
            self._renderer.join(5.0)
        self._motion.close()
        self._spindle.close()

    def run(
        self,
        stopped: Callable[[], bool],
        *,
        on_status: Callable[[ServiceStatus], None] | None = None,
        truth_file: Path | None = None,
    ) -> None:
        """Serve until ``stopped()``; call it once."""
        # A full garbage collection would silence every wire for a tenth of a second.
        gc.collect()
        gc.freeze()
        switch_interval_s = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        self._renderer.start()
        truth = threading.Thread(target=self._tell_truth, args=(truth_file,), name="truth", daemon=True)
        if truth_file is not None:
            truth.start()
        try:
            self._serve(stopped, on_status)
        finally:
            sys.setswitchinterval(switch_interval_s)
            self.close()
            if truth_file is not None:
                truth.join(5.0)
                write_json_atomically(truth_file, self._truth())

    def _serve(self, stopped: Callable[[], bool], on_status: Callable[[ServiceStatus], None] | None) -> None:
        bench, clock, drive = self.bench, self._clock, self.bench.spindle_port
        started_s = clock.now_s() - bench.now_s
        status_at_s = clock.now_s()
        while not stopped():
            behind_s = clock.now_s() - started_s - bench.now_s
            wires = [] if self._motion.closed else [self._motion]
            wires += [] if drive is None else [self._spindle]
            readable, _, _ = select.select(wires, [], [], max(0.0, POLL_S - behind_s))
            if bench.unplugged:
                self._motion.close()
            elif self._motion in readable:
                self._take_in()
            if drive is not None and self._spindle in readable:
                drive.receive(self._spindle.read())
            lag_s = clock.now_s() - started_s - bench.now_s
            if lag_s > self._longest_lag_s:
                started_s += lag_s - self._longest_lag_s
                self.skipped_s += lag_s - self._longest_lag_s
            stretch_s = min(CATCH_UP_S, self._longest_lag_s)
            bench.advance_to(min(clock.now_s() - started_s, bench.now_s + stretch_s))
            self._occupy()
            if not bench.unplugged:
                # Also where there is nothing new: something may still wait for a host that reads slowly.
                self._motion.write(said := bench.transmit())
                while said:
                    self._motion.write(said := bench.transmit())
            if drive is not None:
                self._spindle.write(drive.transmit())
            if on_status is not None and clock.now_s() >= status_at_s:
                status_at_s = clock.now_s() + STATUS_PERIOD_S
                on_status(self._status())

    def _take_in(self) -> None:
        """What the host wrote: all bytes that are there, or all datagrams, of which many may be tries of one."""
        while data := self._motion.read():
            self.bench.receive(data)
            if isinstance(self._motion, SerialPty):
                return

    def _occupy(self) -> None:
        if self.bench.port_held and isinstance(self._motion, SerialPty) and not self._motion.closed:
            self._motion.occupy()

    def _status(self) -> ServiceStatus:
        machine = self.bench.machine
        x, y, z = (float(value) for value in machine.tip_mm)
        return ServiceStatus(
            time_s=self.bench.now_s,
            motion=self.bench.board.state,
            tip_mm=(x, y, z),
            spindle_rpm=machine.spindle_rpm,
            depth_mm=self.bench.depth_mm,
            skipped_s=self.skipped_s,
        )

    # --- cameras

    def _stream(self) -> None:
        period_s = 1.0 / self.fps
        due_s = self._clock.now_s()
        shown_s = -1.0
        # What drawing takes is latency of the stream, so the eyes are drawn side by side.
        with ThreadPoolExecutor(2, "eye") as eyes:
            while not self._ending.wait(max(0.0, due_s - self._clock.now_s())):
                exposed_at_s = self._clock.now_s()
                due_s = max(due_s + period_s, exposed_at_s)
                now_s = self.bench.now_s
                # A bench that was kept from running shows nothing new: the same picture twice is a frozen camera's.
                if self._cameras.watched and now_s > shown_s:
                    shown_s = now_s
                    shot = self.bench.shoot(now_s, each=eyes.map)
                    if shot is None:
                        continue
                    left, right = eyes.map(_jpeg, (shot.left, shot.right))
                    right_late_s = shot.right_late_s - shot.left_late_s
                    self._cameras.publish(left, right, exposed_at_s - shot.left_late_s, right_late_s=right_late_s)

    # --- truth

    def _tell_truth(self, path: Path) -> None:
        while not self._ending.wait(TRUTH_PERIOD_S):
            write_json_atomically(path, self._truth())

    def _truth(self) -> dict[str, object]:
        return {**self.bench.truth(), "monotonic_s": self._clock.now_s(), "skipped_s": self.skipped_s}


def _jpeg(picture: Image) -> bytes:
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def _compile(specimen: Specimen) -> None:
    """Cut and draw a little on a bench that nobody sees: whatever is compiled on first use is compiled now."""
    machine = Machine(specimen)
    scope = Microscope(machine)
    x, y, z = specimen.skull.center_mm
    machine.set_spindle(45_000.0)
    machine.set_tip((x, y, z + 1.0))
    scope.render(0.0)
    machine.carve([(x, y), (x + 0.2, y)], 0.05, closed=False)
    machine.set_tip((x, y, z - 0.1))
    machine.advance_to(0.01)
    machine.move_to(0.02, (0.0, 0.0, 0.0))
    machine.torque_fraction(0.03, 45_000.0)
    machine._let_go_on(LOOK_AT_FLAP)
    scope.render(0.03)
    machine.truth()


def write_json_atomically(path: Path, content: dict[str, object]) -> None:
    """A reader finds the old file or the new one, never half of one."""
    write_atomically(path, json.dumps(content))


def write_atomically(path: Path, text: str) -> None:
    """Replace ``path`` as a whole."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
