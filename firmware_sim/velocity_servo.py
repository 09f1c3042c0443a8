"""The shaft of the emulated spindle and the controller that turns it.

Speed in rpm, torque as a fraction of the rated torque. A proportional-integral controller drives an inertia
against the load. Left out: cogging, the current loop (far faster than a cycle), noise of
the speed sensor, and winding temperature (a time limit stands in for it).
"""

import math
from dataclasses import dataclass

RATED_ACCELERATION_RPM_PER_S = 150_000.0
"""What the rated torque does to the unloaded shaft."""
COAST_RPM_PER_S = 25_000.0
"""What the bearings take from a shaft without current."""
_BANDWIDTH_PER_S = 150.0
_INTEGRAL_PER_S = 40.0


@dataclass
class VelocityServo:
    """State of shaft and controller; ``advance`` is one cycle."""

    speed_rpm: float = 0.0
    demand_rpm: float = 0.0
    torque: float = 0.0
    saturated: bool = False
    _integral: float = 0.0

    def ramp(
        self, target_rpm: float, acceleration_rpm_per_s: float, deceleration_rpm_per_s: float, step_s: float
    ) -> None:
        """Move the demand towards the target, by one ramp away from standstill and by the other towards it."""
        speeding_up = abs(target_rpm) > abs(self.demand_rpm) and target_rpm * self.demand_rpm >= 0
        rate = acceleration_rpm_per_s if speeding_up else deceleration_rpm_per_s
        change = target_rpm - self.demand_rpm
        self.demand_rpm += math.copysign(min(abs(change), rate * step_s), change)

    def advance(self, load: float, max_torque: float, step_s: float, *, powered: bool) -> None:
        """One cycle against ``load``, a torque that opposes the turning and cannot reverse it."""
        if powered:
            error_rpm = self.demand_rpm - self.speed_rpm
            gain = _BANDWIDTH_PER_S / RATED_ACCELERATION_RPM_PER_S
            wanted = gain * error_rpm + self._integral
            self.torque = max(-max_torque, min(max_torque, wanted))
            self.saturated = self.torque != wanted
            if not self.saturated:
                self._integral += gain * _INTEGRAL_PER_S * error_rpm * step_s
        else:
            self.torque, self.saturated, self._integral, self.demand_rpm = 0.0, False, 0.0, self.speed_rpm
        friction = max(load, 0.0 if powered else COAST_RPM_PER_S / RATED_ACCELERATION_RPM_PER_S)
        driven_rpm = self.speed_rpm + self.torque * RATED_ACCELERATION_RPM_PER_S * step_s
        lost_rpm = friction * RATED_ACCELERATION_RPM_PER_S * step_s
        self.speed_rpm = math.copysign(max(0.0, abs(driven_rpm) - lost_rpm), driven_rpm)
