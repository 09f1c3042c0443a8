"""What a status report of GRBL says of the motion."""

from drivers.motion.grbl import protocol
from drivers.motion.interface import MotionState

_STATES = {
    "Run": MotionState.MOVING,
    "Jog": MotionState.MOVING,
    "Home": MotionState.HOMING,
    "Alarm": MotionState.ALARM,
}


def motion_state(report: protocol.Report, planner_blocks: int, *, waits: bool) -> MotionState:
    """The state that a report tells, of a planner of so many blocks; ``waits`` where a line was not yet taken."""
    if report.state == "Hold":
        return MotionState.HELD if report.substate == 0 else MotionState.HOLDING
    if report.state == "Idle":
        # A block that is planned already starts a moment later.
        planned = report.blocks_free is not None and report.blocks_free < planner_blocks
        return MotionState.MOVING if planned or waits else MotionState.IDLE
    return _STATES.get(report.state, MotionState.OTHER)
