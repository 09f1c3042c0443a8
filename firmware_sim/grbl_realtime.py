"""What the firmware does with its real-time flags: alarms, reports, holds, doors, cancels, and going on."""

from typing import TYPE_CHECKING

from firmware_sim.grbl_states import Aborted, Alarm, Flag, State, Suspend, Waits

if TYPE_CHECKING:
    from firmware_sim.grbl_program import Program

_SPINDLE_RESTORE_S = 4.0
_STOPS = frozenset({Flag.HOLD, Flag.DOOR, Flag.MOTION_CANCEL, Flag.SLEEP})
_PLAYS = frozenset({State.RUN, State.HOLD, State.DOOR, State.JOG, State.SLEEP})


def look_at_flags(program: "Program") -> None:
    """Act on each flag, and keep the segment buffer full.

    Raises:
        Aborted: a reset was asked for.
    """
    flags = program.flags
    if flags:
        if Flag.RESET in flags:
            raise Aborted
        if Flag.STATUS in flags:
            flags.discard(Flag.STATUS)
            if program.dialect.name == "grblhal":
                program.overrides.apply(program)
            program.report.status()
        _stops(program)
        if Flag.CYCLE_START in flags:
            flags.discard(Flag.CYCLE_START)
            _cycle_start(program)
        if Flag.CYCLE_STOP in flags:
            flags.discard(Flag.CYCLE_STOP)
            _cycle_stop(program)
    program.overrides.apply(program)
    keep_prepared(program)


def keep_prepared(program: "Program") -> None:
    """The segment buffer full, where segments are being played."""
    if program.stepper.running and program.state in _PLAYS:
        program.stepper.prepare()


def report_alarm(program: "Program") -> Waits:
    """Say it; after some alarms, wait for a reset."""
    alarm = program.alarm
    assert alarm is not None
    program.state = State.ALARM
    program.say(f"ALARM:{alarm.value}")
    yield from program.delay(program.dialect.alarm_pause_s)
    if alarm in {Alarm.HARD_LIMIT, Alarm.SOFT_LIMIT}:
        program.say("[MSG:Reset to continue]")
        program.flags.discard(Flag.RESET)
        while Flag.RESET not in program.flags:
            if program.dialect.name == "grblhal" and Flag.STATUS in program.flags:
                program.flags.discard(Flag.STATUS)
                program.report.status()
            yield None
    program.alarm = None


def _stops(program: "Program") -> None:
    flags, suspend = program.flags, program.suspend
    asked = flags & _STOPS
    if not asked:
        return
    flags -= asked
    if program.state in {State.ALARM, State.CHECK} and asked != {Flag.SLEEP}:
        return
    if asked != {Flag.MOTION_CANCEL}:
        flags.discard(Flag.CYCLE_START)
    if program.state in {State.RUN, State.JOG} and not (suspend.motion_cancel or suspend.jog_cancel):
        if program.dialect.drops_segments and Flag.MOTION_CANCEL in asked:
            program.stepper.drop_prepared()
        program.stepper.hold()
        suspend.active = True
        if program.state is State.JOG and Flag.SLEEP not in asked:
            suspend.jog_cancel = True
    elif program.state in {State.IDLE, State.ALARM}:
        suspend.active = True
        suspend.complete = True
    if Flag.MOTION_CANCEL in asked and program.state is not State.JOG:
        suspend.motion_cancel = True
    if Flag.HOLD in asked and program.state not in {State.DOOR, State.JOG, State.SLEEP}:
        program.state = State.HOLD
    if Flag.DOOR in asked:
        program.say("[MSG:Check Door]")
        suspend.restoring = False
        if not suspend.jog_cancel and program.state is not State.SLEEP:
            program.state = State.DOOR
    if Flag.SLEEP in asked:
        program.state = State.SLEEP


def _cycle_start(program: "Program") -> None:
    suspend = program.suspend
    if program.state is State.DOOR and suspend.complete:
        suspend.restoring = True
    elif program.state is State.IDLE or (program.state is State.HOLD and suspend.complete):
        resumed = program.state is State.HOLD
        _resume(program)
        if resumed and program.dialect.name == "grblhal":
            program.say("[MSG:]")


def _resume(program: "Program") -> None:
    """Let motion begin, or go on."""
    if program.spindle_stopped:
        program.spindle_stopped = False
        program.set_spindle(program.spindle, program.modal.speed)
        program.report.overrides_changed(accessories=True)
    program.stepper.release()
    program.suspend = Suspend()
    if program.planner.blocks:
        program.state = State.RUN
        program.planner.recalculate(program.stepper.speed)
        program.stepper.prepare()
        program.stepper.wake_up(program.now_s)
    else:
        program.state = State.IDLE


def _cycle_stop(program: "Program") -> None:
    suspend = program.suspend
    held = program.state in {State.HOLD, State.DOOR, State.SLEEP}
    if held and not suspend.jog_cancel and not program.soft_limit_hit:
        suspend.active = True
        suspend.complete = True
        program.stepper.release()
        program.planner.recalculate(0.0)
        if program.dialect.name == "grblhal":
            program.report.held_feed = program.planner.blocks[0].nominal_speed if program.planner.blocks else 0.0
        return
    if suspend.jog_cancel:
        program.jog_cancels += 1
        program.planner.reset()
        program.stepper.reset()
        program.idle_motors()
        program.planner_mm_from_motors()
    program.stepper.release()
    program.suspend = Suspend()
    program.state = State.DOOR if program.state is State.DOOR else State.IDLE
    if program.state is State.DOOR:
        program.suspend.active = program.suspend.complete = True


def while_suspended(program: "Program") -> Waits:
    """The spindle stops while the door is open, and is back at speed before motion goes on."""
    if program.state is State.HOLD and program.suspend.complete and program.spindle_toggle_due:
        program.spindle_toggle_due = False
        if program.spindle != "M5":
            program.spindle_stopped = not program.spindle_stopped
            program.set_spindle(program.spindle, program.modal.speed)
            program.report.overrides_changed(accessories=True)
    if program.state is State.SLEEP and program.suspend.complete and not program.suspend.told:
        program.suspend.told = True
        program.say("[MSG:Sleeping]")
        program.set_spindle("M5", 0.0)
    if program.state is State.DOOR and program.suspend.complete:
        if not program.suspend.restoring:
            if not program.suspend.told:
                program.suspend.told = True
                program.spindle_stopped = program.spindle != "M5"
                program.set_spindle(program.spindle, program.modal.speed)
                program.report.overrides_changed(accessories=True)
            return
        if program.spindle_stopped:
            program.spindle_stopped = False
            program.set_spindle(program.spindle, program.modal.speed)
            ready_s = program.now_s + _SPINDLE_RESTORE_S
            while program.now_s < ready_s and Flag.RESET not in program.flags and Flag.DOOR not in program.flags:
                yield program.now_s + 0.05
                if Flag.STATUS in program.flags:
                    program.flags.discard(Flag.STATUS)
                    program.report.status()
        _resume(program)
