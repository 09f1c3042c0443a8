"""The world under the drill: cutting, pushing, torque, harm, and the truth about them."""

import numpy as np
import pytest

from firmware_sim.machine import POWER_UP_TIP_MM, Machine
from firmware_sim.specimen import Membrane, Rig, Specimen, SpindleSignal, Tool, draw_specimen

CLEAN = Specimen(
    rig=Rig(backlash_mm=0.0, run_out_mm=0.0), spindle=SpindleSignal(torque_noise=0, torque_ripple=0, torque_drift=0)
)


def bench(specimen: Specimen = CLEAN) -> Machine:
    return Machine(specimen)


def go(machine: Machine, time_s: float, ball_lowest_mm: tuple[float, float, float] | np.ndarray) -> None:
    """Motors such that the ball's lowest point is there."""
    tool = machine.specimen.tool
    tip = np.asarray(ball_lowest_mm) + np.array([0, 0, tool.ball_radius_mm]) - tool.ball_radius_mm * np.array(tool.axis)
    machine.move_to(time_s, tuple(tip - POWER_UP_TIP_MM))


def outer(machine: Machine, x: float, y: float) -> float:
    return float(machine.skull.surface.outer_z(x, y))


def lap(machine: Machine, start_s: float, depth_mm: float, torque: list[float] | None = None) -> float:
    """One turn at 4 mm/s and a depth below the surface; returns the time at its end."""
    radius_mm, speed = 2.0, 4.0
    for angle in np.linspace(0, 2 * np.pi, 630)[1:]:
        x, y = 5 + radius_mm * np.cos(angle), -10 + radius_mm * np.sin(angle)
        start_s += 2 * np.pi / 629 * radius_mm / speed
        go(machine, start_s, (x, y, outer(machine, x, y) - depth_mm))
        if torque is not None:
            torque.append(machine.torque_fraction(start_s, 50_000))
    return start_s


def plunge(machine: Machine, depth_mm: float, duration_s: float, start_s: float = 1.0) -> None:
    z = outer(machine, 5, -10)
    go(machine, start_s, (5, -10, z + 0.2))
    for share in np.linspace(0, 1, 400):
        go(machine, start_s + share * duration_s, (5, -10, z + 0.02 - share * (0.02 + depth_mm)))


def test_a_turning_ball_cuts_what_it_overlaps_and_springs_back() -> None:
    machine = bench()
    machine.turn(0.0, 50_000)
    plunge(machine, 0.2, 4.0)
    pressed = machine.deflection_mm
    assert 0.001 < pressed < 0.02
    machine.advance_to(8.0)
    assert machine.deflection_mm < 0.2 * pressed
    assert float(machine.skull.completion_at(5, -10)) * float(
        machine.skull.grid.sample(machine.skull.outer_z - machine.skull.inner_z, 5, -10)
    ) == pytest.approx(0.2, abs=0.004)
    # A sphere's profile: 0.3 mm beside the axis the ball is 0.1 mm higher.
    beside, below = (float(machine.skull.grid.sample(machine.skull.top_z, 5.0, y)) for y in (-9.7, -10.0))
    assert beside - below == pytest.approx(0.1, abs=0.004)


def test_a_ball_that_does_not_turn_pushes() -> None:
    machine = bench()
    machine.turn(0.0, 5_000)
    plunge(machine, 0.05, 1.0)
    assert machine.deflection_mm == pytest.approx(0.05, abs=0.002)
    assert machine.force_n == pytest.approx(1.0, abs=0.05)
    assert (machine.skull.top_z == machine.skull.outer_z).all()


def test_run_out_widens_the_cut() -> None:
    widths = []
    for run_out in (0.0, 0.05):
        machine = bench(CLEAN.model_copy(update={"rig": Rig(backlash_mm=0.0, run_out_mm=run_out)}))
        machine.turn(0.0, 50_000)
        plunge(machine, 0.2, 4.0)
        machine.advance_to(7.0)
        widths.append(int((machine.skull.top_z < machine.skull.outer_z - 0.005).sum()))
    assert widths[1] > 1.2 * widths[0]


def test_published_practice_takes_about_a_third_of_the_torque_and_breakthrough_takes_none() -> None:
    machine = bench()
    machine.turn(0.0, 50_000)
    time_s, torque = 0.0, list[float]()
    depth = float(machine.specimen.skull.thickness_mm.mean)
    machine.carve(_ring(), 0.2)
    # Deeper by one bite a lap, at 0.065 mm^2/s.
    for n in range(1, 4):
        time_s = lap(machine, time_s, 0.2 + 0.016 * n, torque=torque)
    assert np.mean(torque[-400:]) == pytest.approx(0.3, abs=0.05)
    machine.carve(_ring(), depth + 0.15)
    lap(machine, time_s, depth, torque=torque)
    assert np.mean(torque[-400:]) == pytest.approx(0.08, abs=0.01)


def test_too_much_feed_would_stall_the_spindle() -> None:
    machine = bench()
    machine.turn(0.0, 50_000)
    worst, start_s = 0.0, 0.0
    for angle in np.linspace(0, np.pi, 300):
        start_s += 0.002
        x, y = 5 + 2 * np.cos(angle), -10 + 2 * np.sin(angle)
        go(machine, start_s, (x, y, outer(machine, x, y) - 0.3))
        worst = max(worst, machine.torque_fraction(start_s, 50_000))
    assert worst > 1.0


def test_torque_noise_repeats_by_seed_and_has_the_size_asked() -> None:
    noisy = CLEAN.model_copy(update={"spindle": SpindleSignal(torque_noise=0.05, torque_ripple=0, torque_drift=0)})
    first, second = bench(noisy), bench(noisy)
    for machine in (first, second):
        machine.turn(0.0, 40_000)
    samples = [[m.torque_fraction(0.01 * k, 40_000) for k in range(2000)] for m in (first, second)]
    assert samples[0] == samples[1]
    assert np.std(samples[0]) == pytest.approx(0.05 * 0.22, rel=0.1)
    assert first.torque_fraction(0.0, 0.0) == 0.0


def test_the_membrane_remembers_when_and_where() -> None:
    machine = bench(CLEAN.model_copy(update={"membrane": Membrane(clearance_mm=0.1)}))
    machine.turn(0.0, 50_000)
    thickness = float(machine.skull.remaining_at(5, -10))
    plunge(machine, thickness + 0.08, 6.0)
    assert not machine.truth().membrane_touched
    z = outer(machine, 5, -10)
    go(machine, 9.0, (5, -10, z - thickness - 0.12))
    truth = machine.truth()
    assert truth.membrane_touched
    assert not truth.success
    assert truth.membrane_touched_at_s == pytest.approx(9.0, abs=2.0)
    assert truth.membrane_touched_mm is not None
    assert truth.membrane_touched_mm[:2] == pytest.approx((5, -10), abs=0.2)
    assert truth.membrane_overrun_mm == pytest.approx(0.02, abs=0.006)


def test_backlash_leaves_the_tip_behind() -> None:
    machine = bench(Specimen(rig=Rig(backlash_mm=0.02)))
    machine.move_to(0.1, (-1.0, 0.0, 0.0))
    assert machine.tip_mm - machine.command_mm == pytest.approx([0.01, 0, 0])
    machine.move_to(0.2, (-0.9, 0.0, 0.0))
    assert machine.tip_mm - machine.command_mm == pytest.approx([-0.01, 0, 0])


def test_home_switches_are_at_the_far_corner() -> None:
    machine = bench()
    assert machine.tip_mm == pytest.approx([20, 0, 15])
    assert machine.limit_switches() == (False, False, False)
    machine.move_to(1.0, (5.0, 9.99, 5.2))
    assert machine.limit_switches() == (True, False, True)
    assert not machine.probe_closed()


def _ring(radius_mm: float = 2.0) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 256, endpoint=False)
    return np.array([5, -10]) + radius_mm * np.column_stack([np.cos(angle), np.sin(angle)])


def test_a_carved_ring_is_found_and_judged() -> None:
    machine = bench()
    assert machine.truth().completion.max() == 0.0
    machine.carve(_ring(1.8), 0.2)
    truth = machine.truth()
    assert truth.center_mm == pytest.approx((5, -10), abs=0.01)
    assert truth.radius_mm == pytest.approx(1.8, abs=0.01)
    assert truth.depth_mm == pytest.approx(0.2, abs=0.03)
    assert not truth.flap_free
    machine.carve(_ring(1.8), 0.55)
    assert machine.truth().success
    assert machine.truth((5.05, -10.0), 1.8).flap_free
    machine.restore_bone()
    assert machine.truth().completion.max() == 0.0


def test_five_percent_of_the_ring_may_hold() -> None:
    for share, free in ((0.04, True), (0.07, False)):
        machine = bench()
        angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
        # The ball's own width frees 1/25 of the ring at each end of a bridge at most.
        depth = np.where(angle < 2 * np.pi * share, 0.2, 0.60)
        path = np.array([5, -10]) + 2 * np.column_stack([np.cos(angle), np.sin(angle)])
        machine.carve(path, depth)
        truth = machine.truth(n=720)
        assert truth.flap_free is (bool((truth.remaining_mm > 0.03).mean() <= 0.05))
        if not free:
            assert (truth.remaining_mm > 0.03).mean() < share


def test_completion_at_points_off_the_kerf_needs_a_search() -> None:
    machine = bench()
    machine.carve(_ring(), 0.3)
    aimed = _ring(2.3)
    assert machine.completion_at(aimed, search_mm=0.35).min() > 1.2 * machine.completion_at(aimed).max()


def test_a_free_flap_gives_way_more() -> None:
    forces = []
    for cut in (False, True):
        machine = bench()
        machine.turn(0.0, 50_000)
        if cut:
            machine.carve(_ring(), 0.6)
        plunge(machine, 0.05, 1.0)
        machine.turn(2.0, 0.0)
        z = outer(machine, 5, -10)
        go(machine, 3.0, (5, -10, z - 0.09))
        forces.append(machine.force_n / machine.deflection_mm)
    assert forces[1] == pytest.approx(0.4 * forces[0], rel=0.02)


def test_the_same_moves_leave_the_same_bone() -> None:
    results = []
    for _ in range(2):
        machine = Machine(draw_specimen(3))
        machine.turn(0.0, 50_000)
        lap(machine, 0.0, -machine.specimen.skull.center_mm[2] - 2.5 + 0.3)
        results.append(machine.skull.top_z.copy())
    assert (results[0] == results[1]).all()


def test_heat_rises_with_the_bone_removed() -> None:
    machine = bench()
    machine.turn(0.0, 50_000)
    lap(machine, 0.0, 0.1)
    assert 1.0 < machine.truth().heat_rise_c < 60.0


def test_the_tool_is_the_specimens() -> None:
    machine = bench(Specimen(tool=Tool(ball_radius_mm=0.4, axis=(0.0, 0.0, 2.0))))
    assert machine.ball_center_mm - machine.tip_mm == pytest.approx([0, 0, 0.4])
