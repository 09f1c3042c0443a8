"""Lines that begin with a dollar sign."""

import re
from typing import TYPE_CHECKING

from firmware_sim import grbl_moves
from firmware_sim.grbl_gcode import BAD_NUMBER, GcodeError
from firmware_sim.grbl_report import point_text
from firmware_sim.grbl_settings import SettingError
from firmware_sim.grbl_states import Flag, State, Waits

if TYPE_CHECKING:
    from firmware_sim.grbl_program import Program

_BAD_STATEMENT, _DISABLED, _NOT_IDLE = 3, 5, 8
_SETTING = re.compile(r"\$([+-]?[\d.]+)=([+-]?[\d.]+)")


def run(program: "Program", text: str) -> Waits:
    """Obey a `$` line.

    Raises:
        GcodeError: with the firmware's code.
    """
    state = program.state
    if text == "$":
        program.say(program.dialect.help)
    elif text.startswith("$J"):
        if state not in {State.IDLE, State.JOG}:
            raise GcodeError(_NOT_IDLE)
        if not text.startswith("$J="):
            raise GcodeError(_BAD_STATEMENT)
        yield from grbl_moves.jog(program, text[3:])
    elif text[1] in "$GCX":
        if len(text) > 2:
            raise GcodeError(_BAD_STATEMENT)
        _plain(program, text[1])
    elif state not in {State.IDLE, State.ALARM}:
        raise GcodeError(_NOT_IDLE)
    else:
        yield from _when_still(program, text)


def _plain(program: "Program", letter: str) -> None:
    state = program.state
    if letter == "$":
        if state in {State.RUN, State.HOLD}:
            raise GcodeError(_NOT_IDLE)
        for line in program.settings.lines():
            program.say(line)
    elif letter == "G":
        program.say(modal_text(program))
    elif letter == "C":
        if state is State.CHECK:
            program.interrupt_reset()
            program.say("[MSG:Disabled]")
        elif state is not State.IDLE:
            raise GcodeError(_NOT_IDLE)
        else:
            program.state = State.CHECK
            program.say("[MSG:Enabled]")
    elif state is State.ALARM:
        program.say("[MSG:Caution: Unlocked]")
        program.state = State.IDLE


def modal_text(program: "Program") -> str:
    """The answer to `$G`."""
    modal, hal = program.modal, program.dialect.name == "grblhal"
    coordinates = modal.coordinates
    system = f"G{54 + coordinates}" if coordinates < 6 else f"G59.{coordinates - 5}"
    words = [modal.motion, system, modal.plane]
    words += ["G20" if modal.inches else "G21", "G91" if modal.incremental else "G90"]
    words += ["G93" if modal.inverse_time else "G94"]
    if hal:
        words += ["G40", "G43.1" if modal.tool_offset else "G49", "G98", "G50"]
    words += [modal.spindle, "M8" if modal.flood else "M9", f"T{modal.tool}", f"F{modal.feed:.0f}"]
    words += [f"S{modal.speed:.0f}" + ("." if hal else "")]
    return f"[GC:{' '.join(words)}]"


def _when_still(program: "Program", text: str) -> Waits:
    hal = program.dialect.name == "grblhal"
    if text == "$#":
        _say_offsets(program)
    elif text == "$H":
        if not program.settings.flag(22):
            raise GcodeError(_DISABLED)
        yield from grbl_moves.home(program)
    elif text == "$SLP" and not hal:
        program.flags.add(Flag.SLEEP)
    elif text == "$I":
        _say_build(program)
    elif text.startswith("$I="):
        program.build_info = text[3:]
    elif text in {"$RST=$", "$RST=#", "$RST=*"}:
        if text[-1] in "$*":
            program.settings.restore()
        if text[-1] in "#*":
            program.coordinates = [(0.0, 0.0, 0.0)] * len(program.coordinates)
        program.say("[MSG:Restoring defaults]")
        program.interrupt_reset()
    elif text == "$N":
        for index, line in enumerate(program.startup_lines):
            program.say(f"$N{index}={line}")
    elif text.startswith(("$N0=", "$N1=")):
        if program.state is not State.IDLE:
            raise GcodeError(_NOT_IDLE)
        yield from grbl_moves.run_line(program, text[4:])
        program.startup_lines[int(text[2])] = text[4:]
    else:
        _store(program, text)


def _store(program: "Program", text: str) -> None:
    match = _SETTING.fullmatch(text)
    if match is None:
        hal = program.dialect.name == "grblhal"
        numeric = re.match(r"\$[+-]?[\d.]+(=|$)", text)
        raise GcodeError(_BAD_STATEMENT if hal or (numeric and "=" not in text) else BAD_NUMBER)
    try:
        program.settings.store(int(float(match[1])), float(match[2]))
    except SettingError as error:
        raise GcodeError(error.code) from error
    except ValueError as error:
        raise GcodeError(BAD_NUMBER) from error


def _say_build(program: "Program") -> None:
    if program.dialect.name == "gnea":
        program.say(f"[VER:{program.version or '1.1h'}.20190830:{program.build_info}]")
        program.say("[OPT:V,15,128]")
        return
    program.say(f"[VER:{program.version or '1.1f'}.20260817:{program.build_info}]")
    for line in ("OPT:VNML+,100,1024,3,0", "AXS:3:XYZ", "NEWOPT:ENUMS,RT+,TC,SED", "FIRMWARE:grblHAL", "SIGNALS:D"):
        program.say(f"[{line}]")
    for line in ("NVS STORAGE:*EEPROM", "DRIVER:Simulator", "DRIVER VERSION:260324"):
        program.say(f"[{line}]")


def _say_offsets(program: "Program") -> None:
    for index, offset in enumerate(program.coordinates):
        name = f"G{54 + index}" if index < 6 else f"G59.{index - 5}"
        program.say(f"[{name}:{point_text(offset)}]")
    program.say(f"[G28:{point_text(program.homes_mm[0])}]")
    program.say(f"[G30:{point_text(program.homes_mm[1])}]")
    program.say(f"[G92:{point_text(program.g92_mm)}]")
    if program.dialect.name == "grblhal":
        program.say("[HOME:0.000,0.000,0.000:0]")
        program.say(f"[TLO:{point_text(program.tool_mm)}]")
    else:
        program.say(f"[TLO:{program.tool_mm[2]:.3f}]")
    grbl_moves.say_probe(program)
