"""Eyes that are told the truth, so that the loop is tested by itself and not the networks. The wires stay real."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from calib.calibration_file import Calibration, RigIdentity
from calib.camera_fit import fit_camera_pair
from drivers.camera.interface import Image
from drivers.camera.stereo import StereoPair
from drivers.motion.interface import MotionController
from drivers.spindle.cia402 import Cia402Spindle
from firmware_sim.bench import MAX_SPEED_RPM, NODE_ID, PARK_MM, Bench, MotionMake, open_in_process
from firmware_sim.clock import SimClock
from firmware_sim.faults import Fault, parse_faults
from firmware_sim.faulty_disk import FaultyDisk
from firmware_sim.faulty_reader import FaultyReader
from firmware_sim.specimen import SkullShape, Specimen, Thickness, Tilt
from milling import loop
from milling.job import Job
from milling.record import RunRecorder
from milling.standing import Standing
from studies.virtual_runs import open_motion
from vision.completion import CompletionReading
from vision.disparity import match
from vision.keypoints import Keypoint
from vision.strip import CELLS, unroll

Array = npt.NDArray[np.float64]

THIN = Specimen(
    seed=5,
    skull=SkullShape(
        thickness_mm=Thickness(mean=0.15, min=0.13, max=0.17, waviness=0.005),
        tilt_deg=Tilt(pitch=2.0, roll=-1.0, yaw=3.0),
    ),
)
"""A skull that is milled in a few laps."""
SHORT_JOB = Job(n_points=16, thickness_low_mm=0.1, thickness_high_mm=0.3)


class TrueReader:
    """Completion as the bone is, seen where no drill stands in front of it."""

    def __init__(self, bench: Bench, calibration: Calibration) -> None:
        self._bench = bench
        self._calibration = calibration
        self._ring_mm = np.zeros((0, 3))
        self.fails: Callable[[CompletionReading], CompletionReading] = lambda reading: reading

    def over(self, ring_px: Array, ball_px: float, *, reference: Image | None) -> Self:
        self._ring_mm = self._on_the_bone(ring_px)
        self._strip = unroll(ring_px, ball_px)
        return self

    def read(self, image: Image) -> CompletionReading:
        completion = np.nan_to_num(self._bench.machine.completion_at(self._ring_mm, search_mm=0.15))
        upper = np.where(completion >= 0.999, 1.0, np.minimum(completion + 0.05, 0.96))
        nothing = np.zeros(CELLS, np.float32)
        visible = np.ones(len(self._ring_mm), dtype=bool)
        return self.fails(
            CompletionReading(
                np.minimum(completion, upper), upper, visible, nothing, nothing, self._strip, image.shape[:2]
            )
        )

    def _on_the_bone(self, ring_px: Array) -> Array:
        """Where the left eye's rays meet the bone."""
        x, y, z = (float(value) for value in self._bench.specimen.skull.center_mm)
        points = np.tile([x, y, z], (len(ring_px), 1))
        for _ in range(10):
            here = self._calibration.project(points)[0]
            dx = (self._calibration.project(points + np.array([0.1, 0.0, 0.0]))[0] - here) / 0.1
            dy = (self._calibration.project(points + np.array([0.0, 0.1, 0.0]))[0] - here) / 0.1
            slope = np.stack([dx, dy], axis=2)
            points[:, :2] += np.linalg.solve(slope, (ring_px - here)[:, :, None])[:, :, 0]
            points[:, 2] = self._bench.machine.skull.surface.outer_z(points[:, 0], points[:, 1])
        return points


@dataclass
class VirtualRig:
    """A bench on the virtual clock, its drivers, and eyes that are told the truth."""

    bench: Bench
    clock: SimClock
    rig: loop.Rig
    calibration: Calibration
    finders: loop.Finders
    reader: TrueReader
    motion: MotionController
    spindle: Cia402Spindle
    camera: StereoPair
    host_faults: Sequence[Fault] = ()

    def run(
        self,
        folder: Path,
        job: Job = SHORT_JOB,
        *,
        progress: Callable[[loop.Progress], None] = lambda _: None,
        stop_requested: Callable[[], bool] = lambda: False,
        standing: Standing | None = None,
    ) -> loop.RunResult:
        with RunRecorder(folder, {"seed": self.bench.specimen.seed}, self.clock) as recorder:
            result = loop.run(
                self.rig,
                self.calibration,
                self.finders,
                job,
                FaultyDisk(recorder, self.host_faults, self.clock),
                progress=progress,
                stop_requested=stop_requested,
                standing=standing,
            )
            recorder.close(result.to_json())
        return result

    def close(self) -> None:
        with ExitStack() as all_of_them:
            for device in (self.camera, self.spindle, self.motion):
                all_of_them.callback(device.close)


def virtual_rig(
    specimen: Specimen = THIN, *, make: MotionMake = "grbl", dialect: str = "gnea", faults: Sequence[str] = ()
) -> VirtualRig:
    """A bench that was just switched on, with faults planted."""
    bench = Bench(
        specimen,
        motion=make,
        dialect="grblhal" if dialect == "grblhal" else "gnea",
        faults=parse_faults(faults, place="bench"),
    )
    clock = SimClock()
    line, bus, left, right = open_in_process(bench, clock)
    controller = open_motion(bench, line, clock)
    spindle = Cia402Spindle(bus, clock, node_id=NODE_ID, max_speed_rpm=MAX_SPEED_RPM)
    camera = StereoPair(left, right, clock, size_px=(960, 540), max_skew_s=0.02)
    x, y, z = (specimen.tool.ball_radius_mm * value for value in specimen.tool.axis)
    calibration = true_calibration(bench, (x, y, z))
    reader = TrueReader(bench, calibration)
    own = parse_faults(faults, place="host")
    spoiled = FaultyReader(reader, own, clock, seed=0)
    finders = loop.Finders(_Tip(bench), _Landmarks(bench), spoiled, match)
    rig = loop.Rig(controller, spindle, camera, clock, (x, y, z), PARK_MM)
    return VirtualRig(bench, clock, rig, calibration, finders, reader, controller, spindle, camera, own)


def true_calibration(bench: Bench, center_from_tip_mm: tuple[float, float, float]) -> Calibration:
    points = np.random.default_rng(0).uniform([0.0, -20.0, -5.0], [10.0, 0.0, 10.0], (60, 3))
    left, right = bench.microscope.project(points)
    fit = fit_camera_pair(points, left, right, size_px=(960, 540), detector_sigma_px=0.5)
    identity = RigIdentity(motion="", camera="", spindle="", center_from_tip_mm=center_from_tip_mm)
    return Calibration(
        fit.pair, "default", fit.model, fit.candidates_mm, fit.handedness, False, fit.rmse_mm, (), identity
    )


class _TwoEyes:
    """Callers look at the left picture, then at the right one."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._right = True

    def _seen(self, points_mm: Array) -> list[Keypoint]:
        self._right = not self._right
        pixels = self._bench.microscope.project(points_mm)[int(self._right)]
        return [Keypoint(float(x), float(y), 0.5, 0.99, True) for x, y in pixels]


class _Tip(_TwoEyes):
    def __call__(self, image: Image) -> Keypoint:
        return self._seen(self._bench.machine.ball_center_mm[None])[0]


class _Landmarks(_TwoEyes):
    def __call__(self, image: Image) -> tuple[Keypoint, Keypoint]:
        skull = self._bench.machine.skull
        bregma, lambda_ = self._seen(np.stack([skull.bregma_mm, skull.lambda_mm]))
        return bregma, lambda_
