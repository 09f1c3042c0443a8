"""Carries out the faults of a bench's devices: on the wires, in the boards, in the world, and in the pictures.

Every draw comes from one seed, so that the same faults on the same bench give the same bytes again.
"""

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from firmware_sim.bcap_controller import RcController
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.faults import Fault
from firmware_sim.grbl_board import GrblBoard
from firmware_sim.machine import Machine
from firmware_sim.microscope import Image, Shot
from firmware_sim.modbus_drive import ModbusDrive
from firmware_sim.spindle_motor import SpindleMotor
from firmware_sim.tinyg_board import TinyGBoard

if TYPE_CHECKING:
    from firmware_sim.can_wire import Frame

TURNING_RPM: Final = 1000.0
"""Above this the drill turns, and the faults' time runs."""
OVERSPEED: Final = 1.5
PX_PER_MM: Final = 25.4
GLARE_PX: Final = 45
"""Radius of a reflection, and from the middle of the picture to its own."""
SLICE_S: Final = 0.004
_HISTORY_S: Final = 6.0
_BLUR_PX: Final = 6.0


class Parts(Protocol):
    """What of a bench can be broken."""

    machine: Machine
    board: GrblBoard | TinyGBoard | RcController

    @property
    def spindle_drive(self) -> Cia402Drive | ModbusDrive | SpindleMotor:
        """What turns the drill."""


class Sabotage:
    """The faults of one bench; ``advance_to`` before the boards', so that what is due has begun."""

    def __init__(self, parts: Parts, faults: tuple[Fault, ...], *, seed: int) -> None:
        if alien := [str(fault) for fault in faults if isinstance(parts.board, RcController) and _is_of_a_board(fault)]:
            raise ConfigError(f"fault {', '.join(alien)}: of a board on a serial port; this bench has a robot")
        self._parts = parts
        self._waiting = list(faults)
        self._begun: dict[str, Fault] = {}
        self._turning_since_s: float | None = None
        self._rng = np.random.default_rng([seed, 4711])
        self._late: deque[tuple[float, bytes]] = deque()
        self._shots: deque[tuple[float, Image, Image]] = deque()
        self._stuck: tuple[Image, Image] | None = None
        self._before: tuple[Image, Image] | None = None
        """The pictures before these, where they are torn."""
        self.now_s = 0.0
        self.advance_to(0.0)

    @property
    def port_held(self) -> bool:
        """Whether another program has the motion port."""
        return "port.held" in self._begun

    @property
    def unplugged(self) -> bool:
        """Whether the motion port is gone."""
        return "serial.unplug" in self._begun

    def advance_to(self, time_s: float) -> None:
        """Begin what is due."""
        self.now_s = time_s
        if self._turning_since_s is None and abs(self._parts.machine.spindle_rpm) > TURNING_RPM:
            self._turning_since_s = time_s
        for fault in [fault for fault in self._waiting if self._is_due(fault)]:
            self._waiting.remove(fault)
            self._begun[fault.name] = fault
            if fault.name == "motion.firmware":
                _board(self._parts).reflash(fault.word)
            elif (begin := _AT_ONCE.get(fault.name)) is not None:
                begin(self._parts, fault.value)

    def _is_due(self, fault: Fault) -> bool:
        if fault.after_s is None:
            return True
        return self._turning_since_s is not None and self.now_s - self._turning_since_s >= fault.after_s

    # The motion port.

    def from_host(self, data: bytes) -> bytes:
        """What of the host's bytes reaches the motion board."""
        return self._damaged(data)

    def to_host(self, data: bytes) -> bytes:
        """What of the board's bytes reaches the host by now."""
        data = self._damaged(data)
        late_s = self._value("serial.latency")
        if data and "serial.slice" in self._begun:
            cut = int(self._rng.integers(len(data) + 1))
            self._late.append((self.now_s + late_s, data[:cut]))
            late_s, data = late_s + SLICE_S, data[cut:]
        if data:
            # What was sent later never overtakes.
            earliest_s = self._late[-1][0] if self._late else 0.0
            self._late.append((max(self.now_s + late_s, earliest_s), data))
        arrived = b""
        while self._late and self._late[0][0] <= self.now_s:
            arrived += self._late.popleft()[1]
        return arrived

    def _damaged(self, data: bytes) -> bytes:
        if not data:
            return data
        if "serial.stall" in self._begun or self.unplugged:
            return b""
        kept: npt.NDArray[np.uint8] = np.frombuffer(data, np.uint8)
        if lost := self._value("serial.drop"):
            kept = kept[self._rng.random(len(kept)) >= lost]
        if flipped := self._value("serial.flip"):
            hit = self._rng.random(len(kept)) < flipped
            kept = np.where(hit, kept ^ (1 << self._rng.integers(0, 8, len(kept))).astype(np.uint8), kept)
        if doubled := self._value("serial.dup"):
            kept = np.repeat(kept, 1 + (self._rng.random(len(kept)) < doubled))
        if inserted := self._value("serial.insert"):
            before = np.flatnonzero(self._rng.random(len(kept)) < inserted)
            kept = np.insert(kept, before, self._rng.integers(0, 256, len(before))).astype(np.uint8)
        return kept.tobytes()

    # The CAN bus.

    def carried(self, frame: "Frame", from_node: bool) -> "Frame | None":
        """What of this frame the bus brings to anybody."""
        if "can.bus_off" in self._begun or (from_node and "can.silent" in self._begun) or self._hits("can.drop"):
            return None
        can_id, data = frame
        if data and self._hits("can.flip"):
            spoilt = bytearray(data)
            spoilt[self._rng.integers(len(data))] ^= 1 << int(self._rng.integers(8))
            data = bytes(spoilt)
        if data and self._hits("can.short"):
            data = data[:-1]
        return can_id, data

    def _hits(self, name: str) -> bool:
        """Whether a fault that comes by chance comes now; without the fault nothing is drawn."""
        share = self._value(name)
        return share > 0.0 and bool(self._rng.random() < share)

    # The pictures.

    def shoot(self, render: Callable[[], tuple[Image, Image]], time_s: float) -> Shot | None:
        """Both pictures of this moment; None where the cameras show nothing new."""
        if "camera.off" in self._begun or self._hits("camera.intermittent"):
            return None
        if "camera.stuck" in self._begun:
            self._stuck = self._stuck or render()
            return Shot(*self._stuck)
        left, right = (self._spoiled(picture) for picture in render())
        if "camera.torn" in self._begun:
            half = len(left) // 2
            whole, last = (left, right), self._before or (left, right)
            left, right = (np.concatenate([new[:half], old[half:]]) for new, old in zip(whole, last, strict=True))
            self._before = whole
        if "camera.mirrored" in self._begun:
            left = np.ascontiguousarray(left[:, ::-1])
        if "camera.swapped" in self._begun:
            left, right = right, left
        slow_s, skew_s = self._value("camera.slow"), self._value("camera.skew")
        if not (slow_s or skew_s):
            return Shot(left, right)
        self._shots.append((time_s, left, right))
        while time_s - self._shots[0][0] > _HISTORY_S:
            self._shots.popleft()
        before = self._shot_before(time_s - slow_s)
        before_right = self._shot_before(time_s - slow_s - skew_s)
        if before is None or before_right is None:
            return None
        return Shot(before[1], before_right[2], time_s - before[0], time_s - before_right[0])

    def _shot_before(self, time_s: float) -> tuple[float, Image, Image] | None:
        return next((shot for shot in reversed(self._shots) if shot[0] <= time_s), None)

    def _spoiled(self, picture: Image) -> Image:
        if "camera.black" in self._begun:
            return np.zeros_like(picture)
        if "camera.blur" in self._begun:
            picture = cv2.GaussianBlur(picture, (0, 0), _BLUR_PX).astype(np.uint8)
        if exposure := self._value("camera.exposure"):
            table = 255.0 * np.minimum(1.0, exposure * (np.arange(256) / 255.0) ** 2.2) ** (1 / 2.2)
            picture = table.round().astype(np.uint8)[picture]
        if "camera.glare" in self._begun:
            height, width = picture.shape[:2]
            picture = picture.copy()
            cv2.circle(picture, (width // 2 + GLARE_PX, height // 2), GLARE_PX, (255, 255, 255), -1)
        if "camera.size" in self._begun:
            picture = picture[1:]
        if moved_mm := self._value("camera.moved"):
            picture = np.roll(picture, round(moved_mm * PX_PER_MM), axis=1)
        return picture

    def _value(self, name: str) -> float:
        fault = self._begun.get(name)
        return 0.0 if fault is None else fault.value


def _is_of_a_board(fault: Fault) -> bool:
    place, _, what = fault.name.partition(".")
    return place in ("serial", "port") or (place == "motion" and what not in ("reset", "backlash", "scale_x", "slip"))


def _board(parts: Parts) -> GrblBoard | TinyGBoard:
    assert not isinstance(parts.board, RcController)
    return parts.board


def _lose_steps(parts: Parts, steps: float) -> None:
    parts.machine.lost_mm[2] -= steps / _board(parts).steps_per_mm[2]


def _slip(parts: Parts, slip_mm: float) -> None:
    parts.machine.lost_mm[0] += slip_mm


def _play(parts: Parts, play_mm: float) -> None:
    parts.machine.backlash_mm[:] = play_mm


def _stretch_x(parts: Parts, factor: float) -> None:
    parts.machine.axis_scale[0] = factor


def _block(parts: Parts, _value: float) -> None:
    parts.machine.blocked = True


def _overspeed(parts: Parts, _value: float) -> None:
    parts.spindle_drive.speed_factor = OVERSPEED


def _slow(parts: Parts, share: float) -> None:
    parts.spindle_drive.speed_factor = 1.0 - share


def _run_away(parts: Parts, _value: float) -> None:
    parts.spindle_drive.runs_by_itself = True


def _ignore_silence(parts: Parts, _value: float) -> None:
    parts.spindle_drive.minds_silence = False


_AT_ONCE: Final[dict[str, Callable[[Parts, float], None]]] = {
    "motion.alarm": lambda parts, code: _board(parts).raise_alarm(round(code)),
    "motion.reset": lambda parts, _: parts.board.restart(),
    "motion.slip": _slip,
    "motion.backlash": _play,
    "motion.scale_x": _stretch_x,
    "motion.lost_steps": _lose_steps,
    "motion.no_soft_limits": lambda parts, _: _board(parts).turn_soft_limits_off(),
    "motion.settings_changed": lambda parts, _: _board(parts).slow_x_down(),
    "spindle.stall": _block,
    "spindle.slow": _slow,
    "spindle.overspeed": _overspeed,
    "spindle.starts_by_itself": _run_away,
    "spindle.no_consumer": _ignore_silence,
    "spindle.emcy": lambda parts, code: parts.spindle_drive.fail(round(code)),
}
"""What happens in one moment and stays; the others are looked up where bytes, frames and pictures pass."""
