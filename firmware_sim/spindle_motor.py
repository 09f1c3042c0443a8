"""A drill on an analog speed input, as GRBL's spindle output is: it follows, and tells nobody how it fares.

Left out: the drive's own lower limit and its fault output.
"""

from firmware_sim.mechanics import SpindleLoad
from firmware_sim.velocity_servo import VelocityServo

CYCLE_S = 0.002
RAMP_RPM_PER_S = 120_000.0
MOST_TORQUE = 1.5
OWN_SPEED_RPM = 5_000.0
"""Of a drill that turns without being told."""
_STANDING_RPM = 30.0


class SpindleMotor:
    """Turns the load as its input says; a cycle of 2 ms at a time."""

    def __init__(self, load: SpindleLoad) -> None:
        self._load = load
        self._servo = VelocityServo()
        self._cycles = 0
        self.speed_factor = 1.0
        """What the shaft does of what it is told; a healthy drill does all."""
        self.runs_by_itself = False
        self.minds_silence = False
        """There is nobody to listen to."""
        self._failed = False

    def fail(self, _code: int) -> None:
        """The drill's own electronics give up: the shaft coasts, and nobody is told."""
        self._failed = True

    @property
    def speed_rpm(self) -> float:
        """The true speed of the shaft."""
        return self._servo.speed_rpm

    def advance_to(self, time_s: float, told_rpm: float) -> None:
        """Let the shaft go on, with its input at ``told_rpm``."""
        servo = self._servo
        while (cycle_s := (self._cycles + 1) * CYCLE_S) <= time_s:
            self._cycles += 1
            wanted_rpm = told_rpm * self.speed_factor
            if self.runs_by_itself and not told_rpm:
                wanted_rpm = OWN_SPEED_RPM
            servo.ramp(wanted_rpm, RAMP_RPM_PER_S, RAMP_RPM_PER_S, CYCLE_S)
            load = self._load.torque_fraction(cycle_s, servo.speed_rpm)
            powered = not self._failed and (bool(wanted_rpm) or abs(servo.speed_rpm) > _STANDING_RPM)
            servo.advance(load, MOST_TORQUE, CYCLE_S, powered=powered)
            self._load.turn(cycle_s, servo.speed_rpm)
