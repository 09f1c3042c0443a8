"""What the drill feels when it comes through: there is no bone below the inner surface."""

import numpy as np

from firmware_sim.machine import POWER_UP_TIP_MM, Machine
from firmware_sim.specimen import Rig, SkullShape, Specimen, SpindleSignal, Thickness, Tilt

QUIET = Specimen(
    skull=SkullShape(
        thickness_mm=Thickness(mean=0.3, min=0.3, max=0.3, waviness=0.0), tilt_deg=Tilt(pitch=0, roll=0, yaw=0)
    ),
    rig=Rig(backlash_mm=0.0, run_out_mm=0.0),
    spindle=SpindleSignal(torque_noise=0, torque_ripple=0, torque_drift=0),
)
BITE_MM = 0.013


def load_of_laps(depths_mm: list[float]) -> list[float]:
    """Mean cutting torque of each lap of a 2 mm ring at 5 mm/s, with the ball so deep below the outer surface."""
    machine = Machine(QUIET)
    machine.turn(0.0, 50_000)
    axis = np.array(QUIET.tool.axis)
    machine.carve(_ring(), depths_mm[0] - 3 * BITE_MM)
    angles = np.linspace(0, 2 * np.pi, 1250, endpoint=False)
    x, y = 5 + 2 * np.cos(angles), -10 + 2 * np.sin(angles)
    outer_z = machine.skull.surface.outer_z(x, y)
    now_s, loads = 0.0, []
    for depth in depths_mm:
        torque = []
        motors_mm = np.column_stack([x, y, outer_z - depth + 0.5]) - 0.5 * axis - np.array(POWER_UP_TIP_MM)
        for target_mm in motors_mm.tolist():
            now_s += 0.002
            machine.move_to(now_s, tuple(target_mm))
            torque.append(machine.torque_fraction(now_s, 50_000) - 0.08)
        loads.append(float(np.mean(torque[200:])))
    return loads


def _ring() -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    return np.column_stack([5 + 2 * np.cos(angles), -10 + 2 * np.sin(angles)])


def test_the_load_droops_within_a_bite_or_two_and_the_sides_go_on_cutting() -> None:
    steps = range(-14, 7)
    load = dict(zip(steps, load_of_laps([0.3 + BITE_MM * step for step in steps]), strict=True))
    whole = np.median([load[step] for step in range(-9, -3)])
    # The bone gives way under the ball, so the middle of the chord goes a bite or two after the commanded depth.
    assert load[0] > 0.9 * whole
    assert load[4] < 0.8 * whole
    assert 0.2 * whole < load[6] < 0.7 * whole
