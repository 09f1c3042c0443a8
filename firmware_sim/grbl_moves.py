"""What a line of G-code makes the machine do: moves, jogs, dwells, probing, homing."""

import math
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from firmware_sim.grbl_gcode import GcodeError, Line, Point, read_line
from firmware_sim.grbl_planner import steps_of
from firmware_sim.grbl_report import point_text
from firmware_sim.grbl_states import Aborted, Alarm, Flag, HomingPart, State, Waits

if TYPE_CHECKING:
    from firmware_sim.grbl_program import Program

_TRAVEL_EXCEEDED = 15
_DWELL_STEP_S = 0.05
_AXES = "XYZ"
_HOME_Z, _HOME_XY = (2,), (0, 1)


def run_line(program: "Program", text: str) -> Waits:
    """Read, check and obey one line.

    Raises:
        GcodeError: refused as a whole, nothing has changed.
    """
    line = read_line(text, program.modal, program.frame)
    before, modal = program.modal, line.modal
    if program.state is State.CHECK:
        program.modal = modal
        return
    turning = before.spindle != "M5"
    if line.speed_given and modal.speed != before.speed and turning and modal.spindle == before.spindle:
        yield from program.wait_for_motion()
        program.set_spindle(modal.spindle, modal.speed)
    if modal.spindle != before.spindle:
        yield from program.wait_for_motion()
        program.set_spindle(modal.spindle, modal.speed)
    if modal.flood != before.flood:
        yield from program.wait_for_motion()
        program.flood = modal.flood
        program.report.overrides_changed(accessories=True)
    if line.dwell_s is not None:
        yield from _dwell(program, line.dwell_s)
    _change_offsets(program, line)
    program.modal = modal
    yield from _act(program, line)
    if line.program_flow is not None:
        yield from _flow(program, line.program_flow)


def jog(program: "Program", text: str) -> Waits:
    """``$J=``: one move that leaves the modal state alone."""
    line = read_line(text, program.modal, program.frame, jog=True)
    target = line.target_mm
    if _soft_limits(program):
        if program.dialect.name == "grblhal" and program.settings.flag(40):
            target = _clamped(program, target)
        elif not _within_travel(program, target):
            raise GcodeError(_TRAVEL_EXCEEDED)
    cancels = program.jog_cancels
    yield from move(program, target, line, is_jog=True)
    if program.dialect.drops_segments and program.jog_cancels != cancels:
        return
    program.position_mm = target
    if program.state is State.IDLE and program.planner.blocks:
        program.state = State.JOG
        program.stepper.prepare()
        program.stepper.wake_up(program.now_s)


def move(program: "Program", target: Point, line: Line, *, is_jog: bool = False) -> Waits:
    """Queue a straight move, waiting for room.

    A jog that waits here while the jogs before it are cancelled is dropped by grblHAL. GRBL 1.1h still runs it, from
    wherever the axes came to rest straight to its old absolute target.
    """
    if _soft_limits(program) and not is_jog and not _within_travel(program, target):
        yield from _soft_limit(program)
        return
    cancels = program.jog_cancels
    while True:
        yield from program.realtime()
        if program.dialect.drops_segments and program.jog_cancels != cancels:
            return
        if program.planner.free > 0:
            break
        program.start_cycle_if_queued()
        yield None
    program.planner.add(
        steps_of(target, program.settings.steps_per_mm),
        program.settings.limits(),
        speed=line.modal.feed / 60,
        is_rapid=line.action in {"G0", "G28", "G30"},
        inverse_time=line.modal.inverse_time,
        keeps_feed=is_jog,
        tail_speed=program.stepper.speed,
    )
    program.stepper.replan()


def _soft_limits(program: "Program") -> bool:
    """GrblHAL checks only axes that have been homed."""
    return program.settings.flag(20) and (program.homed or program.dialect.name == "gnea")


def _travel_low(program: "Program") -> Point:
    x, y, z = program.settings.per_axis(130)
    return -x, -y, -z


def _within_travel(program: "Program", target: Point) -> bool:
    return all(low <= value <= 0 for low, value in zip(_travel_low(program), target, strict=True))


def _clamped(program: "Program", target: Point) -> Point:
    x, y, z = (min(max(value, low), 0.0) for low, value in zip(_travel_low(program), target, strict=True))
    return x, y, z


def _soft_limit(program: "Program") -> Waits:
    """Come to rest first, so that the position stays known; then alarm."""
    program.soft_limit_hit = True
    if program.state is State.RUN:
        program.flags.add(Flag.HOLD)
        while True:
            yield from program.realtime()
            if program.at_rest():
                break
            yield None
    program.interrupt_reset()
    program.alarm = Alarm.SOFT_LIMIT
    yield from program.realtime()


def _dwell(program: "Program", duration_s: float) -> Waits:
    yield from program.wait_for_motion()
    end_s = program.now_s + duration_s
    while program.now_s < end_s:
        yield from program.realtime()
        yield min(program.now_s + _DWELL_STEP_S, end_s)


def _change_offsets(program: "Program", line: Line) -> None:
    before = program.work_offset_mm
    if line.cancels_tool_offset:
        program.tool_mm = (0.0, 0.0, 0.0)
    elif line.action == "G43.1":
        program.tool_mm = _with(program.tool_mm, line.words)
    coordinates_changed = line.modal.coordinates != program.modal.coordinates
    program.modal = replace(program.modal, coordinates=line.modal.coordinates)
    if line.clears_g92:
        program.g92_mm = (0.0, 0.0, 0.0)
    elif line.action == "G92":
        program.g92_mm = _offset_for(program, line.words, program.coordinates[line.modal.coordinates])
    elif line.action in {"G10L2", "G10L20"}:
        index = int(line.words["P"])
        given = {axis: value for axis, value in line.words.items() if axis != "P"}
        if line.action == "G10L2":
            program.coordinates[index] = _with(program.coordinates[index], given)
        else:
            program.coordinates[index] = _offset_for(program, given, program.g92_mm, program.coordinates[index])
    if coordinates_changed or program.work_offset_mm != before:
        program.report.offsets_changed()


def _with(point: Point, given: dict[str, float]) -> Point:
    x, y, z = (given.get(axis, old) for axis, old in zip(_AXES, point, strict=True))
    return x, y, z


def _offset_for(program: "Program", given: dict[str, float], other: Point, old: Point | None = None) -> Point:
    """The offset under which the given axes read the given work coordinates."""
    kept = program.g92_mm if old is None else old
    parts = zip(_AXES, program.position_mm, other, program.tool_mm, kept, strict=True)
    x, y, z = (p - given[axis] - o - t if axis in given else k for axis, p, o, t, k in parts)
    return x, y, z


def _act(program: "Program", line: Line) -> Waits:
    action = line.action
    if action in {"G0", "G1"}:
        yield from move(program, line.target_mm, line)
        program.position_mm = line.target_mm
    elif action in {"G28", "G30"}:
        if line.waypoint_mm is not None:
            yield from move(program, line.waypoint_mm, line)
        yield from move(program, line.target_mm, line)
        program.position_mm = line.target_mm
    elif action in {"G28.1", "G30.1"}:
        program.homes_mm[0 if action == "G28.1" else 1] = program.position_mm
    elif action is not None and action.startswith("G38"):
        yield from _probe(program, line)


def _flow(program: "Program", flow: str) -> Waits:
    """M0 holds; M2 and M30 end the program."""
    if flow == "M1":
        return
    yield from program.wait_for_motion()
    if flow == "M0":
        program.flags.add(Flag.HOLD)
        yield from program.realtime()
        return
    program.modal = replace(
        program.modal, motion="G1", plane="G17", incremental=False, inverse_time=False, coordinates=0,
        spindle="M5", flood=False,
    )  # fmt: skip
    program.set_spindle("M5", 0.0)
    program.flood = False
    program.report.offsets_changed()
    program.report.overrides_changed()
    program.say("[MSG:Pgm End]")


# --- probing -------------------------------------------------------------------------------------------------------


def say_probe(program: "Program") -> None:
    """``[PRB:...]``."""
    program.say(f"[PRB:{point_text(program.probe_mm)}:{int(program.probe_succeeded)}]")


def _probe(program: "Program", line: Line) -> Waits:
    away = line.action in {"G38.4", "G38.5"}
    must_touch = line.action in {"G38.2", "G38.4"}
    yield from program.wait_for_motion()
    program.probe_succeeded = False
    program.probe_away = away
    if program.probe_closed() != away:
        program.alarm = Alarm.PROBE_START
        yield from program.realtime()
        return
    yield from move(program, line.target_mm, line)
    program.probing = True
    program.flags.add(Flag.CYCLE_START)
    while True:
        yield from program.realtime()
        if program.at_rest():
            break
        yield None
    missed = program.probing
    program.probing = False
    if missed:
        if must_touch:
            program.alarm = Alarm.PROBE_END
        if not must_touch or program.dialect.name == "grblhal":
            program.probe_mm = program.machine_mm
    else:
        program.probe_succeeded = True
    with suppress(Aborted):  # the result is told before a reset is obeyed
        yield from program.realtime()
    program.planner.reset()
    program.stepper.reset()
    program.idle_motors()
    yield program.now_s
    program.planner_mm_from_motors()
    say_probe(program)


# --- homing --------------------------------------------------------------------------------------------------------


def home(program: "Program") -> Waits:
    """``$H``: Z first, then X and Y; each seek, pull off, find slowly, pull off. Answers nothing meanwhile."""
    program.state = State.HOME
    program.homed = False
    if program.dialect.name == "grblhal":
        program.report.status()
    for axes in (_HOME_Z, _HOME_XY):
        alarm = yield from _home_axes(program, axes)
        if alarm is not None:
            program.interrupt_reset()
            program.alarm = alarm
            yield from program.realtime()
            return
    program.planner_mm_from_motors()
    yield from program.realtime()
    program.homed = True
    program.report.homed_changed = True
    program.state = State.IDLE
    program.idle_motors()
    yield program.now_s
    if program.dialect.name == "grblhal":
        program.say("[MSG:]")
    yield from program.run_startup_lines()


def _home_axes(program: "Program", axes: tuple[int, ...]) -> HomingPart:
    settings = program.settings
    pull_off, debounce_s = settings[27], settings[26] / 1000
    travel = [1.5 * settings[130 + axis] for axis in axes]
    for step, speed in enumerate((settings[25], settings[25], settings[24], settings[25])):
        approach = step % 2 == 0
        distances = travel if step == 0 else [pull_off * (5.0 if approach else 1.0)] * len(axes)
        alarm = yield from _home_move(program, axes, distances, speed / 60, approach=approach)
        if alarm is not None:
            return alarm
        yield from program.delay(debounce_s)
    spm = settings.steps_per_mm
    for axis in axes:
        place = pull_off - settings[130 + axis] if settings.mask(23) >> axis & 1 else -pull_off
        program.origin_steps[axis] = round(place * spm[axis]) - round(program.stepper.position[axis])
    return None


def _home_move(
    program: "Program", axes: tuple[int, ...], distances: list[float], speed: float, *, approach: bool
) -> HomingPart:
    """One straight system move of all axes together; each axis stops at its own switch."""
    settings, stepper = program.settings, program.stepper
    program.planner.reset()
    stepper.reset()
    program.planner.position = program.machine_steps
    spm = settings.steps_per_mm
    target = list(program.machine_steps)
    for axis, distance in zip(axes, distances, strict=True):
        to_max = not settings.mask(23) >> axis & 1
        target[axis] += round((distance if to_max == approach else -distance) * spm[axis])
    stepper.moves_axis = [axis in axes for axis in range(3)]
    program.planner.add(
        (target[0], target[1], target[2]), settings.limits(), speed=speed * math.sqrt(len(axes)), is_rapid=False,
        keeps_feed=True,
    )  # fmt: skip
    stepper.replan()
    stepper.prepare()
    stepper.wake_up(program.now_s)
    while True:
        if approach:
            pressed = program.limit_switches()
            for axis in axes:
                if pressed[axis]:
                    stepper.moves_axis[axis] = False
            if not any(stepper.moves_axis):
                break
        stepper.prepare()
        if Flag.RESET in program.flags:
            return Alarm.HOMING_RESET
        if Flag.DOOR in program.flags:
            return Alarm.HOMING_DOOR
        if Flag.CYCLE_STOP in program.flags:
            program.flags.discard(Flag.CYCLE_STOP)
            if approach:
                return Alarm.HOMING_APPROACH
            if any(program.limit_switches()[axis] for axis in axes):
                return Alarm.HOMING_PULL_OFF
            break
        yield None
    stepper.reset()
    program.flags.discard(Flag.CYCLE_STOP)
    return None
