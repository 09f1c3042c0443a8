"""An emulated motion board with g2core firmware, which speaks JSON over USB (g2core wiki; TinyG's successor).

It reads control lines at once and G-code when the planner has room, verifies the checksums of numbered lines, answers
each line with a footer, reports its state, holds, drops its queue, homes, and refuses what exceeds the soft limits. It
knows no wall clock.

Left out: text mode, the second USB channel, the loss of the USB connection that a reset causes on some boards, the
configuration of the digital inputs (switches 1 to 3 home X, Y and Z, and stop the machine while ``lim`` is set),
jogging, the interlock, the spindle, work offsets, and the lift in a feed hold. Comments in a block are not read.
"""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from firmware_sim import tinyg_states as codes
from firmware_sim.mechanics import AxesMm, Mechanics
from firmware_sim.tinyg_gcode import NO_FEED, BlockError, is_end, read_block, verified
from firmware_sim.tinyg_json import read_json
from firmware_sim.tinyg_motion import HEADROOM, Motion, beyond
from firmware_sim.tinyg_reports import Reports
from firmware_sim.tinyg_settings import AXES, OK, UNRECOGNIZED_NAME, Axes, Settings
from firmware_sim.tinyg_states import Exit, State, exception_words
from firmware_sim.tinyg_usb import LineBuffer, Usb

_TICK_S = 0.001
_BOOT_S = 0.15


class TinyGBoard:
    """The board from power-up at time zero. ``settings`` are what its memory holds then, by name."""

    def __init__(self, mechanics: Mechanics, *, settings: Mapping[str, float] = {}) -> None:
        self._mechanics = mechanics
        self._settings = Settings(settings)
        self._motor_steps_per_mm = self._settings.steps_per_mm
        self._usb = Usb()
        self._buffer = LineBuffer()
        self._motion = Motion(self._settings, mechanics.limit_switches)
        self._now_s = 0.0
        self._shown: AxesMm = (0.0, 0.0, 0.0)
        self._speed_mm_s = 0.0
        self._limits_pressed = False
        self._begin()

    def _begin(self) -> None:
        """Everything that a reset clears."""
        self._boots = True
        self._boots_until_s = self._now_s + _BOOT_S
        self._state = State.READY
        self._exit = Exit.WAIT
        self._flushes = False
        self._kills = False
        self._absolute = True
        self._motion_mode = "G0"
        self._feed: float | None = None
        self._line = 0
        self._reports = Reports(self._now_s, self._motion.buffers_free)

    # --- what others of the bench do to it -------------------------------------------------------------------------

    def reflash(self, version: str) -> None:
        """Another build of the same firmware, such as "100.26", as far as it tells of it."""
        self._settings.put("fb", float(version))
        self._settings.put("fbs", version)

    def commission(self, identity: str) -> None:
        """The serial number that tells this board from others of its make."""
        self._settings.put("id", identity)

    @property
    def state(self) -> str:
        """In a word."""
        names = {1: "Ready", 2: "Alarm", 3: "Stop", 4: "End", 5: "Run", 6: "Hold", 9: "Home"}
        return "Boot" if self._boots else names[self._stat]

    @property
    def steps_per_mm(self) -> Axes:
        """Of the motors, as they were at power-up."""
        return self._motor_steps_per_mm

    def raise_alarm(self, code: int) -> None:
        """Something of the board's own, not the host's doing: it comes to rest, and waits to be cleared."""
        self._alarm(codes.ALARMS[code])

    def restart(self) -> None:
        """Somebody presses the board's reset button."""
        self._buffer.forget()
        self._motion.lose_everything()
        self._settings.forget()
        self._begin()

    def change_setting(self, name: str, value: float) -> None:
        """Somebody else's hand on the board's memory."""
        self._settings.put(name, value)

    def turn_soft_limits_off(self) -> None:
        """By that hand."""
        self.change_setting("sl", 0)

    def slow_x_down(self) -> None:
        """By that hand: half as fast as it was."""
        self.change_setting("xvm", self._settings["xvm"] / 2)

    # --- wire and time ---------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """The host writes ``data``, now."""
        self._usb.send_to_board(data, self._now_s)

    def transmit(self) -> bytes:
        """What has reached the host since the last call."""
        return self._usb.collect(self._now_s)

    def advance_to(self, time_s: float) -> None:
        """Let the board's time go on to ``time_s``."""
        while self._now_s < time_s:
            if self._sleeps:
                self._now_s = time_s
                return
            self._now_s = min(time_s, self._now_s + _TICK_S)
            self._step()

    @property
    def _sleeps(self) -> bool:
        """Whether nothing can happen before somebody writes."""
        motion = self._motion
        waits = self._usb.waits or self._buffer.controls or self._buffer.data or self._kills or self._flushes
        moves = motion.busy or motion.is_homing or self._speed_mm_s
        reports = self._settings["sv"] or self._settings["qv"]
        return not (waits or moves or reports or self._boots or self._settings["lim"])

    def _step(self) -> None:
        data = self._usb.arrived(self._now_s)
        if self._boots:
            if self._now_s < self._boots_until_s:
                return
            self._boots = False
            self._welcome()
        for byte in data:
            self._buffer.take(byte, in_hold=self._in_hold)
            self._obey_controls()
            if self._boots:
                return
        self._sequence()
        while self._buffer.data and self._reads_data:
            self._run_line(self._buffer.data.popleft())
        self._move()
        self._report_by_itself()

    @property
    def _in_hold(self) -> bool:
        return self._motion.held or self._motion.slowing

    @property
    def _reads_data(self) -> bool:
        motion = self._motion
        return not (self._in_hold or motion.is_homing or self._kills) and motion.buffers_free > HEADROOM

    def _move(self) -> None:
        homed = self._motion.advance(self._now_s)
        if homed is not None:
            self._state = State.STOP
            if not homed:
                self._respond({"msg": "Homing cycle failed"}, codes.HOMING_FAILED, 0)
        x, y, z = (round(n) / s for n, s in zip(self._motion.stepper.position, self._motor_steps_per_mm, strict=True))
        self._speed_mm_s = math.dist((x, y, z), self._shown) / _TICK_S
        if (x, y, z) != self._shown:
            self._shown = (x, y, z)
            self._mechanics.move_to(self._now_s, self._shown)
        pressed = any(self._mechanics.limit_switches())
        if pressed and not self._limits_pressed and self._settings["lim"] and not self._motion.is_homing:
            self._alarm(codes.LIMIT_HIT)
        self._limits_pressed = pressed

    # --- states ----------------------------------------------------------------------------------------------------

    @property
    def _stat(self) -> int:
        """The combined state."""
        if self._state is State.ALARM:
            return State.ALARM.value
        if self._motion.is_homing:
            return 9
        if self._in_hold:
            return 6
        return 5 if self._motion.busy else self._state.value

    def _sequence(self) -> None:
        """What was asked for, once the motors allow it."""
        motion = self._motion
        if motion.busy and self._state in (State.READY, State.END) and not motion.is_homing:
            self._state = State.STOP
        if self._kills:
            self._exit = Exit.KILL
            if motion.stepper.running and not motion.is_homing:
                motion.hold()
        if motion.held or not motion.stepper.running or motion.is_homing:
            if self._exit is Exit.ALARM:
                motion.drop_queue()
                self._exit = Exit.WAIT
            elif self._exit is Exit.KILL:
                self._end_job()
        if self._flushes and motion.held:
            self._flushes = False
            motion.drop_queue()
            self._state = State.STOP

    def _end_job(self) -> None:
        self._motion.drop_queue()
        self._kills = self._flushes = False
        self._exit = Exit.WAIT
        if self._state is not State.ALARM:
            self._end_program()
            self._except(codes.KILLED, "Job killed by ^d")

    def _end_program(self) -> None:
        self._state = State.END
        self._absolute = True
        self._motion_mode = "G0"

    def _alarm(self, status: int) -> None:
        if self._state is State.ALARM:
            return
        if self._motion.is_homing:
            self._motion.drop_queue()
        self._motion.hold()
        self._state = State.ALARM
        self._exit = Exit.ALARM
        self._buffer.drop_data()
        self._except(status, "alarm")

    # --- commands --------------------------------------------------------------------------------------------------

    def _obey_controls(self) -> None:
        controls = self._buffer.controls
        while controls:
            text = controls.popleft()
            if text == "!":
                # In a homing cycle it ends the move only; what follows is the cycle's.
                if not self._motion.is_homing:
                    self._motion.hold()
            elif text == "~":
                if self._motion.held and not self._flushes:
                    self._motion.resume(self._now_s)
            elif text == "%":
                self._flushes = True
                self._buffer.drop_data()
            elif text == "\x04":
                self._kills = self._state is not State.ALARM
                self._buffer.drop_data()
                self._sequence()
            elif text == "\x05":
                self._say({"ack": True})
            elif text == "\x18":
                self.restart()
                return
            else:
                self._run_json(text)

    def _run_json(self, text: str) -> None:
        size = len(text) + 1
        try:
            request = read_json(text)
        except ValueError:
            self._respond({"err": text}, codes.SYNTAX_ERROR, size)
            return
        body: dict[str, Any] = {}
        status = OK
        for name, value in request.items():
            body[name], status = self._one(name, value)
            if status != OK:
                break
        if self._settings["jv"] < 3 and "sr" not in body:
            body = {}
        self._respond(body, status, size)

    def _one(self, name: str, value: Any) -> tuple[Any, int]:
        """One pair of a request: its answer and status."""
        if name in {"clear", "clr"}:
            if self._state is State.ALARM and not self._motion.stepper.running:
                self._state = State.STOP
            return value, OK
        if name == "gc":
            return value, self._run_block(str(value))
        if name == "sr" and isinstance(value, dict):
            return self._choose_report(value)
        if value is None or value == "":
            found = self._read(name)
            return found, UNRECOGNIZED_NAME if found is None else OK
        if isinstance(value, dict | list | str):
            return value, codes.UNSUPPORTED_TYPE
        if self._state is State.ALARM:
            return value, codes.REJECTED
        if self._motion.busy:
            return value, codes.NOT_ACCEPTED
        return value, self._settings.write(name, float(value))

    def _read(self, name: str) -> Any:
        if name == "sr":
            return {key: self._read(key) for key in self._reports.names}
        motion = self._motion
        live: dict[str, Any] = {
            "stat": self._stat,
            "line": self._line,
            "qr": motion.buffers_free,
            "vel": round(max(self._speed_mm_s * 60, 0.01 if motion.stepper.running else 0.0), 3),
            "feed": self._feed or 0.0,
            "home": int(all(motion.homed)),
            "hom": {"e": int(all(motion.homed)), **{a: int(h) for a, h in zip(AXES, motion.homed, strict=True)}},
        }
        for axis, position in zip(AXES, motion.position_mm, strict=True):
            live[f"mpo{axis}"] = live[f"pos{axis}"] = round(position, 3)
        return live[name] if name in live else self._settings.read(name)

    def _choose_report(self, wanted: dict[str, Any]) -> tuple[Any, int]:
        for key, value in wanted.items():
            if self._read(key) is None:
                return wanted, UNRECOGNIZED_NAME
            if value is not True:
                return wanted, codes.UNSUPPORTED_TYPE
        self._reports.names = tuple(wanted)
        return self._read("sr"), OK

    def _run_line(self, text: str) -> None:
        status = self._run_block(text)
        body: dict[str, Any] = {}
        if self._settings["jv"] >= 5:
            body["gc"] = text
        if self._settings["jv"] >= 4 and (number := re.match(r"N(\d+)", text)):
            body["n"] = int(number[1])
        self._respond(body, status, len(text) + 1)

    def _run_block(self, text: str) -> int:
        try:
            plain = verified(text)
            if self._state is State.ALARM:
                if not is_end(plain):
                    return codes.REJECTED
                self._state = State.STOP
            block = read_block(plain)
        except BlockError as error:
            return error.status
        if block.number is not None:
            self._line = block.number
        if block.absolute is not None:
            self._absolute = block.absolute
        if block.feed is not None:
            self._feed = block.feed
        if block.ends:
            self._end_program()
        elif block.homes:
            self._motion.start_homing(set(block.axes))
        elif block.axes:
            self._motion_mode = block.motion or self._motion_mode
            return self._queue_move(block.axes)
        return OK

    def _queue_move(self, axes: Mapping[str, float]) -> int:
        if self._motion_mode == "G1" and not self._feed:
            return NO_FEED
        target = list(self._motion.target_mm)
        for index, letter in enumerate(AXES.upper()):
            if letter in axes:
                target[index] = axes[letter] + (0.0 if self._absolute else target[index])
        wanted = (target[0], target[1], target[2])
        over = beyond(wanted, self._settings, self._motion.homed) if self._settings["sl"] else None
        if over is not None:
            status = codes.SOFT_LIMIT + 1 + over
            self._alarm(status)
            return status
        self._motion.add(wanted, self._feed if self._motion_mode == "G1" else None, self._now_s)
        return OK

    # --- what it says ----------------------------------------------------------------------------------------------

    def _say(self, line: dict[str, Any]) -> None:
        self._usb.say(json.dumps(line, separators=(",", ":")), self._now_s)

    def _respond(self, body: dict[str, Any], status: int, size: int) -> None:
        if self._settings["jv"]:
            self._say({"r": body, "f": [1, status, size]})

    def _except(self, status: int, text: str) -> None:
        self._say({"er": {"fb": self._settings["fb"], "st": status, "msg": f"{exception_words(status)} - {text}"}})

    def _welcome(self) -> None:
        names = ("fv", "fb", "fbs", "fbc", "hp", "hv", "id")
        self._say({"r": {**{name: self._read(name) for name in names}, "msg": "SYSTEM READY"}, "f": [1, 0, 0]})

    def _report_by_itself(self) -> None:
        settings, reports = self._settings, self._reports
        for report in reports.queue(self._motion.buffers_free, wanted=bool(settings["qv"])):
            self._say(report)
        if settings["sv"] and reports.is_due(self._now_s, settings["si"] / 1000):
            for report in reports.status(self._read("sr"), filtered=settings["sv"] == 1):
                self._say(report)
