"""An emulated controller board with GRBL 1.1 firmware, in two dialects: ``gnea`` (1.1h) and ``grblhal``.

It speaks at 115200 baud both ways, has a receive buffer that drops what does not fit, a bounded planner with
look-ahead, and motors that follow constant-speed segments prepared some 50 or 90 ms ahead. It knows no wall clock.

It was compared with dialogues recorded from both firmwares (``tests/firmware_sim/test_grbl_replay.py``). There the
replies, codes, states and their order are the same, except:

- Memory: the recorded boards start with blank memory, say ``error:7`` and print their settings first. This one has
  settings from the start.
- ``%`` on 1.1h: the recording also holds a line of the process that the firmware ran in. The board only refuses it.
- Hard limit on 1.1h: recorded as ALARM:3 with a banner half a second later. There the limit interrupt waited out the
  motors' settling while the program went on; on a microcontroller the interrupt comes first, so that the alarm is 1,
  as the manual says, and the program waits for a reset and answers nothing.
- Three reports on 1.1h fall on the other side of a change of state that comes a few milliseconds sooner or later:
  Run for Idle at the end of a move and Jog for Idle at the end of a jog cancel (within $1), and Run for Hold:0 where
  ``?`` follows ``~`` within 0.1 ms.
- grblHAL adds ``H:`` and ``T:`` to some reports, and leaves ``A:`` out of the first one after a hard limit; which
  changes cause them is not documented. Here ``H:`` comes after homing only.
- Homing takes 0.1 s less than grblHAL's of 7.6 s. After it grblHAL stands one step from where 1.1h does: machine
  coordinates differ by 0.004 mm at 250 steps/mm.

Left out: arcs (``G2`` and ``G3`` with offsets get error:20), tool changes, parking, laser mode, homing of single
axes, backlash and skipped steps (the mechanics' part), and the loss of memory when power fails in a write.
"""

import math
from collections.abc import Mapping
from typing import Literal

from firmware_sim.grbl_dialects import DIALECTS
from firmware_sim.grbl_overrides import OVERRIDE_BYTES
from firmware_sim.grbl_program import Program
from firmware_sim.grbl_settings import Settings
from firmware_sim.grbl_states import Alarm, Flag, State
from firmware_sim.grbl_stepper import TICK_S
from firmware_sim.grbl_uart import Uart
from firmware_sim.mechanics import Mechanics

_FINE_TICK_S = 0.0005
_FLAG_BYTES = {ord("?"): Flag.STATUS, ord("~"): Flag.CYCLE_START, ord("!"): Flag.HOLD, 0x84: Flag.DOOR}
_RESET, _JOG_CANCEL, _FIRST_REALTIME = 0x18, 0x85, 0x80


class GrblBoard:
    """The board from power-up at time zero. ``settings`` are what its memory holds then, by ``$`` number."""

    def __init__(
        self,
        mechanics: Mechanics,
        *,
        dialect: Literal["gnea", "grblhal"],
        settings: Mapping[str, float] = {},
    ) -> None:
        self._mechanics = mechanics
        self._dialect = DIALECTS[dialect]
        memory = Settings(dialect, settings)
        self._motor_steps_per_mm = memory.steps_per_mm
        self._uart = Uart(self._dialect.rx_size)
        self._program = Program(self._dialect, memory, self._uart, mechanics.limit_switches, mechanics.probe_closed)
        self._run = self._program.run()
        self._now_s = 0.0
        self._sleeps_until_s: float | None = None
        self._something_happened = True
        self._tick_s = 0.0
        self._shown = (0.0, 0.0, 0.0)
        self._limits_pressed = False

    def reflash(self, version: str) -> None:
        """Another version of the same firmware, such as "1.1f", as far as it tells of it."""
        self._program.version = version

    def commission(self, build_info: str) -> None:
        """What an installer leaves behind by ``$I=``: a text that tells this board from others of its make."""
        self._program.build_info = build_info

    @property
    def state(self) -> str:
        """What a status report would say."""
        return self._program.state.value

    @property
    def spindle_rpm(self) -> float:
        """What the spindle output asks for; negative turns the other way."""
        program = self._program
        return -program.spindle_rpm if program.spindle == "M4" else program.spindle_rpm

    @property
    def steps_per_mm(self) -> tuple[float, float, float]:
        """Of the motors, as they were at power-up."""
        return self._motor_steps_per_mm

    def raise_alarm(self, code: int) -> None:
        """Something of the board's own, not the host's doing: it stops where it stands, and waits for a reset."""
        self._program.interrupt_reset()
        self._program.alarm = Alarm(code)
        self._something_happened = True

    def restart(self) -> None:
        """Somebody presses the board's reset button."""
        self._program.interrupt_reset()
        self._something_happened = True

    def change_setting(self, number: int, value: float) -> None:
        """Somebody else's hand on the board's memory."""
        self._program.settings.store(number, value)

    def turn_soft_limits_off(self) -> None:
        """By that hand."""
        self.change_setting(20, 0.0)

    def slow_x_down(self) -> None:
        """By that hand: half as fast as on the bench."""
        self.change_setting(110, 600.0)

    def receive(self, data: bytes) -> None:
        """The host writes ``data``, now."""
        self._uart.send_to_board(data, self._now_s)

    def transmit(self) -> bytes:
        """What has reached the host since the last call."""
        return self._uart.collect(self._now_s)

    def advance_to(self, time_s: float) -> None:
        """Let the board's time go on to ``time_s``."""
        while True:
            next_s = self._next_time_s()
            if next_s > time_s:
                break
            self._now_s = max(self._now_s, next_s)
            self._step()
        self._now_s = max(self._now_s, time_s)
        if self._program.stepper.running:
            self._turn_motors()
            if not self._looks_closely:
                self._tick_s = self._now_s + TICK_S

    @property
    def _looks_closely(self) -> bool:
        return self._program.probing or self._program.state is State.HOME

    def _next_time_s(self) -> float:
        stepper = self._program.stepper
        next_s = self._uart.next_arrival_s
        if stepper.running:
            next_s = min(next_s, stepper.next_time_s, self._tick_s)
        return min(next_s, self._program_at_s()) if self._something_happened else next_s

    def _program_at_s(self) -> float:
        """When the program goes on: awake, not blocked by an interrupt, and with room for what it has said."""
        if not self._something_happened:
            return math.inf
        program = self._program
        at_s = max(program.blocked_until_s, self._uart.room_at_s(self._dialect.tx_size))
        if self._sleeps_until_s is not None:
            return max(at_s, self._sleeps_until_s)
        poll_s = self._dialect.poll_s
        if poll_s:
            at_s = max(at_s, math.ceil(self._now_s / poll_s - 1e-6) * poll_s)
        return at_s

    def _step(self) -> None:
        program, now_s = self._program, self._now_s
        program.now_s = now_s
        while (byte := self._uart.next_arrived(now_s)) is not None:
            self._interrupt(byte)
        if program.stepper.running:
            self._turn_motors()
            if self._tick_s <= now_s:
                self._tick_s = now_s + (_FINE_TICK_S if self._looks_closely else TICK_S)
        if self._program_at_s() <= now_s:
            was_running = program.stepper.running
            self._sleeps_until_s = next(self._run)
            self._something_happened = self._sleeps_until_s is not None or program.blocked_until_s > now_s
            if program.stepper.running and not was_running:
                self._tick_s = now_s

    def _interrupt(self, byte: int) -> None:
        """Real-time characters never reach the receive buffer."""
        program = self._program
        if byte in _FLAG_BYTES:
            program.flags.add(_FLAG_BYTES[byte])
        elif byte == _RESET:
            program.interrupt_reset()
        elif byte == _JOG_CANCEL:
            if program.state is State.JOG:
                program.flags.add(Flag.MOTION_CANCEL)
                if self._dialect.drops_segments:
                    self._uart.rx.clear()
                    program.forget_line()
        elif byte in OVERRIDE_BYTES:
            program.overrides.ask(byte)
        elif byte < _FIRST_REALTIME:
            if self._takes_quietly(byte):
                return
            self._uart.store(byte)
        self._something_happened = True

    def _turn_motors(self) -> None:
        program, now_s = self._program, self._now_s
        stepper = program.stepper
        if stepper.advance(now_s):
            self._something_happened = True
            if not stepper.running:
                program.flags.add(Flag.CYCLE_STOP)
                program.idle_motors()
        # Written out: this runs at every byte and at every tick.
        (x, y, z), (along_x, along_y, along_z) = stepper.position, self._motor_steps_per_mm
        shown = (round(x) / along_x, round(y) / along_y, round(z) / along_z)
        if shown != self._shown:
            self._shown = shown
            self._mechanics.move_to(now_s, shown)
        self._look_at_switches()

    def _look_at_switches(self) -> None:
        program = self._program
        if program.state is State.HOME:
            self._something_happened = True
        elif program.probing and self._mechanics.probe_closed() != program.probe_away:
            program.probing = False
            program.probe_mm = program.machine_mm
            program.flags.add(Flag.MOTION_CANCEL)
            self._something_happened = True
        elif program.settings.flag(21):
            pressed = any(self._mechanics.limit_switches())
            if pressed and not self._limits_pressed and program.state is not State.ALARM and program.alarm is None:
                program.interrupt_reset()
                program.alarm = Alarm.HARD_LIMIT
                self._something_happened = True
            self._limits_pressed = pressed

    def _takes_quietly(self, byte: int) -> bool:
        """Whether the program has put a byte into its line, and would do nothing else if it were woken."""
        program = self._program
        return (
            not self._something_happened
            and self._dialect.poll_s == 0.0
            and program.blocked_until_s <= self._now_s
            and self._uart.room_at_s(self._dialect.tx_size) <= self._now_s
            and program.take_quietly(byte)
        )
