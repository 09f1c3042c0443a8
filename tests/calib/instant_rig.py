"""A stage that arrives at once and two eyes on the synthetic microscope: the interfaces, with no wire behind them.

For the algorithm's own tests; on emulated boards and rendered pictures the procedure runs with the whole bench.
"""

from dataclasses import dataclass, field

import numpy as np
from synthetic_microscope import SIZE_PX, Microscope

from drivers.camera.interface import StereoCamera, StereoFrame
from drivers.motion.interface import MotionController, MotionState, MotionStatus, Travel


class StillClock:
    """Time passes by sleeping only."""

    def __init__(self):
        self.time_s = 0.0

    def now_s(self):
        return self.time_s

    def sleep_s(self, duration_s):
        self.time_s += duration_s


class InstantStage(MotionController):
    identity = "stage 7"
    travel = Travel((-10.0, -30.0, -8.0), (25.0, 10.0, 20.0))
    dead_time_s = 0.0

    def __init__(self):
        self.path = [(23.0, -10.0, -2.0)]
        self.slip_mm = 0.0

    def start_move(self, target_mm, *, feed_mm_per_s):
        assert self.travel.contains(target_mm)
        self.path.append(tuple(target_mm))

    def status(self):
        x, y, z = self.path[-1]
        return MotionStatus(MotionState.IDLE, (x + self.slip_mm, y, z), 0.0, 0.0)

    def wait_until_idle(self, timeout_s):
        return self.status()

    def close(self):
        pass

    home = hold = resume = halt = flush = close

    def set_floor(self, z_mm):
        pass


@dataclass(frozen=True)
class Tip:
    x_px: float
    y_px: float
    sigma_px: float
    visible: bool


@dataclass
class Eyes(StereoCamera):
    """Pictures of one pixel that say which eye took them; ``find_tip`` knows where the drill would be."""

    stage: InstantStage
    microscope: Microscope = field(default_factory=Microscope)
    offset_mm: tuple = (0.32, 0.0, 0.38)
    noise_px: float = 0.3
    seed: int = 0
    hidden_mm: tuple = ()
    hidden_within_mm: float = 2.0
    wild_mm: tuple = ()
    shift_px: float = 0.0
    frames: int = 0

    identity = "eyes L1 R2"
    size_px = SIZE_PX

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)

    def capture(self, timeout_s=2.0):
        self.frames += 1
        left, right = (np.full((1, 1, 3), side, np.uint8) for side in (0, 1))
        return StereoFrame(left, right, 0.0, self.frames)

    def latest(self):
        return None

    def close(self):
        pass

    def find_tip(self, image):
        side, at = int(image[0, 0, 0]), self.stage.path[-1]
        pixel = self.microscope.project(np.add([at], self.offset_mm))[side][0] + self.rng.normal(0, self.noise_px, 2)
        if at in self.wild_mm and side == 0:
            pixel += np.array([60.0, 5.0])
        visible = all(np.linalg.norm(np.subtract(at, place)) > self.hidden_within_mm for place in self.hidden_mm)
        return Tip(pixel[0] + self.shift_px, pixel[1], self.noise_px, visible)
