"""Contact on a bone that is a formula: where it is found, by how much it overruns, and what is refused."""

import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import PlanError, SafetyStop
from drivers.motion.interface import MotionController, MotionState, MotionStatus, Travel, Vector
from drivers.recorder import NullRecorder
from drivers.spindle.interface import Spindle, SpindleStatus
from firmware_sim.clock import SimClock
from milling.contact import STEP_MM, ContactFinder, measure_idle
from milling.hands import Hands
from milling.load import Idle

RPM = 50_000.0


class Stage(MotionController):
    """Arrives at once, in as much time as the way takes."""

    identity = "formula"
    dead_time_s = 0.0
    travel = Travel((-50.0, -50.0, -50.0), (50.0, 50.0, 50.0))

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.tip: Vector = (0.0, 0.0, 5.0)
        self.moved_from, self.moved_s = self.tip, 1.0

    def start_move(self, target_mm: Vector, *, feed_mm_per_s: float) -> None:
        self.moved_from, self.tip = self.tip, target_mm
        self.moved_s = max(float(np.linalg.norm(np.subtract(target_mm, self.moved_from))) / feed_mm_per_s, 1e-3)

    def status(self) -> MotionStatus:
        return MotionStatus(MotionState.IDLE, self.tip, 0.0, self.clock.now_s())

    def wait_until_idle(self, timeout_s: float) -> MotionStatus:
        return self.status()

    def flush(self, timeout_s: float = 1.0) -> MotionStatus:
        return self.status()

    def home(self) -> None: ...
    def hold(self) -> None: ...
    def resume(self) -> None: ...
    def halt(self) -> None: ...
    def set_floor(self, z_mm: float | None) -> None: ...
    def close(self) -> None: ...


class Drill(Spindle):
    """Feels how it goes down into bone whose height is a formula: at once, or by ``softness`` more at each mm."""

    identity = "formula"
    heartbeat_s = 0.25

    def __init__(self, stage: Stage, bone_z: float, *, noise: float = 0.01) -> None:
        self.stage, self.bone_z, self.noise = stage, bone_z, noise
        self.drift_per_s = 0.0
        self.softness: float | None = None
        self.whim_z_mm = (0.0, 0.0)
        """Where the torque has a whim of 0.009."""
        self.rng = np.random.default_rng(1)
        self.deepest = float("inf")

    def status(self) -> SpindleStatus:
        self.stage.clock.sleep_s(0.005)
        z = self.stage.tip[2]
        height = self.bone_z + 0.1 * self.stage.tip[0]
        going_down = self.stage.moved_from[2] > z
        touch = 0.05 if self.softness is None else self.softness * (height - z)
        load = touch if going_down and z < height else 0.0
        self.deepest = min(self.deepest, z - height)
        load += 0.009 if self.whim_z_mm[0] < z < self.whim_z_mm[1] else 0.0
        idle = 0.08 + self.drift_per_s * self.stage.clock.now_s()
        return SpindleStatus(RPM, idle + load + self.noise * self.rng.normal() / 4, None, self.stage.clock.now_s())

    def start(self, speed_rpm: float) -> None: ...
    def stop(self) -> None: ...
    def wait_until_at_speed(self, timeout_s: float) -> SpindleStatus:
        return self.status()

    def close(self) -> None: ...


def finder(bone_z: float, *, floor: float = -3.0) -> tuple[ContactFinder, Drill]:
    clock = SimClock()
    stage = Stage(clock)
    drill = Drill(stage, bone_z)
    hands = Hands(stage, drill, clock, NullRecorder(), lambda: False, speed_rpm=RPM)
    return ContactFinder(hands, Idle(0.08, 0.0025), floor), drill


XY = [(0.3 * k, 0.0) for k in range(6)]
BONE = [0.1 * x for x, _ in XY]


@pytest.mark.parametrize("error", [-0.3, -0.1, 0.0, 0.2, 0.4])
def test_contact_is_found_within_a_step_whatever_the_surface_is_off_by(error: float) -> None:
    search, drill = finder(0.0)
    predicted = [z - error for z in BONE]
    found = search.find_all(XY, [z + 0.5 for z in predicted], predicted, lambda *_: None)
    np.testing.assert_allclose(found, BONE, atol=STEP_MM)
    assert drill.deepest > -2 * STEP_MM - 1e-9


@pytest.mark.parametrize("drift", [-0.04, 0.04])
def test_a_torque_whose_zero_drifts_is_no_contact(drift: float) -> None:
    """40 % of the published cutting torque per minute, ten times what is usual, over twice the usual points."""
    search, drill = finder(0.0)
    drill.drift_per_s = drift * 0.22 / 6.0
    places = [(0.3 * k, 0.0) for k in range(64)]
    bone = [0.1 * x for x, _ in places]
    found = search.find_all(places, [z + 0.5 for z in bone], bone, lambda *_: None)
    np.testing.assert_allclose(found, bone, atol=1.5 * STEP_MM)
    assert search.idle.mean != pytest.approx(0.08, abs=0.004), "it drifted by more than a touch"


def test_what_air_takes_is_learned_on_the_way_down_as_well() -> None:
    """Believed too low by half of what a touch is, noise alone passes for a touch now and then."""
    search, drill = finder(0.0)
    sigma = 0.01
    search.idle, drill.noise = Idle(0.08 - 0.6 * sigma, sigma), 0.0
    search.find_all([(0.0, 0.0)], [0.1], [0.0], lambda *_: None)
    assert -0.1 <= (search.idle.mean - 0.08) / sigma <= 0.25, "by a part of the touch at most, too much"


@pytest.mark.parametrize(("sigma", "softness"), [(0.01, 0.8), (0.02, 0.8), (0.04, 0.8), (0.06, 5.3)])
def test_bone_that_is_met_softly_is_not_learned_as_air(sigma: float, softness: float) -> None:
    """As deep as where air is not learned at all, and a step or two more."""
    deepest_mm = []
    for follow in (False, True):
        search, drill = finder(0.0)
        drill.softness, drill.noise = softness, 4 * sigma
        search.idle = Idle(0.08, sigma)
        if not follow:
            search._follow_air = lambda *_: None  # type: ignore[method-assign]
        search.find_all([(0.0, 0.0)], [0.2], [0.0], lambda *_: None)
        deepest_mm.append(drill.deepest)
    assert deepest_mm[1] > deepest_mm[0] - 0.5 * sigma / softness - 3 * STEP_MM


@pytest.mark.parametrize("steps", [1, 2, 3, 4])
def test_a_whim_of_some_steps_in_the_air_is_no_contact_and_four_are(steps: int) -> None:
    search, drill = finder(0.0)
    drill.noise, drill.whim_z_mm = 0.0, (0.1 - (steps - 0.5) * STEP_MM, 0.105 + STEP_MM)
    found = search.find_all([(0.0, 0.0)], [0.2], [0.0], lambda *_: None)[0]
    assert found == pytest.approx(0.1 if steps == 4 else 0.0, abs=1.5 * STEP_MM)


def test_air_that_takes_ever_more_is_no_air() -> None:
    search, drill = finder(0.0)
    search.idle = search._first = Idle(0.08, 0.01)
    drill.drift_per_s = 0.01
    places = [(0.3 * k, 0.0) for k in range(64)]
    bone = [0.1 * x for x, _ in places]
    with pytest.raises(SafetyStop, match="bone cannot be felt"):
        search.find_all(places, [z + 0.5 for z in bone], bone, lambda *_: None)


def test_bone_met_on_the_way_across_hardly_moves_the_zero() -> None:
    search, drill = finder(-9.0)
    search.hands.on_torque.append(search._hear)
    drill.noise = 0.0
    for _ in range(8):
        drill.drift_per_s = 1.0
        search.hands.watch(0.05)
        search._follow_air()
    assert search.idle.mean - 0.08 <= 8 * 0.25 * search.idle.sigma + 1e-12


def test_what_the_first_points_teach_makes_the_later_ones_quick() -> None:
    search, _ = finder(0.0)
    clock, times = search.hands.clock, []
    predicted = [z + 0.3 for z in BONE]
    search.find_all(XY, [z + 0.5 for z in predicted], predicted, lambda *_: times.append(clock.now_s()))
    took = np.diff([0.0, *times])
    assert took[1:].max() < 0.4 * took[0]


def test_no_bone_down_to_the_floor_is_refused() -> None:
    search, _ = finder(-9.0, floor=-0.2)
    with pytest.raises(PlanError, match=r"point 1.*no bone felt"):
        search.find_all(XY, [0.5] * 6, [0.0] * 6, lambda *_: None)
    assert search.hands.motion.status().position_mm[2] >= -0.2


def test_bone_where_the_surface_promises_air_is_refused() -> None:
    search, _ = finder(0.7)
    with pytest.raises(PlanError, match=r"point 1.*bone at or above"):
        search.find_all(XY, [0.5] * 6, [0.0] * 6, lambda *_: None)


@pytest.mark.parametrize("at_step", [0, 1])
def test_a_whim_of_the_torque_at_the_very_start_is_no_bone(at_step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    search, drill = finder(0.0)
    felt, asked = search._felt, []

    def with_a_whim() -> bool:
        asked.append(search.hands.motion.status().position_mm[2])
        return felt() or len(asked) == at_step + 1

    monkeypatch.setattr(search, "_felt", with_a_whim)
    found = search.find_all(XY, [z + 0.5 for z in BONE], BONE, lambda *_: None)
    np.testing.assert_allclose(found, BONE, atol=STEP_MM)
    assert asked[at_step + 1] == pytest.approx(asked[0]), "no deeper before air was felt again"
    assert drill.deepest > -2 * STEP_MM - 1e-9


def test_an_idle_torque_that_wanders_is_no_baseline() -> None:
    search, drill = finder(-9.0)
    assert measure_idle(search.hands).mean == pytest.approx(0.08, abs=0.005)
    drill.noise = 2.0
    with pytest.raises(SafetyStop, match="cannot be felt"):
        measure_idle(search.hands)
