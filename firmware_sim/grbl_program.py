"""The firmware's program: one endless loop that reads lines, and looks at its real-time flags wherever it waits.

Written as generators. ``yield None`` waits for anything to happen, ``yield time_s`` sleeps and is deaf until then,
exactly where the real program spins or delays.
"""

from collections.abc import Callable, Generator
from contextlib import suppress

from firmware_sim import grbl_commands, grbl_moves, grbl_realtime
from firmware_sim.grbl_dialects import Dialect
from firmware_sim.grbl_gcode import Frame, GcodeError, Modal, Point
from firmware_sim.grbl_overrides import Overrides
from firmware_sim.grbl_planner import Planner
from firmware_sim.grbl_report import Reporter
from firmware_sim.grbl_settings import Settings
from firmware_sim.grbl_states import Aborted, Alarm, Flag, State, Suspend, Waits
from firmware_sim.grbl_stepper import Stepper
from firmware_sim.grbl_uart import Uart

_IN_MOTION = {State.RUN, State.JOG, State.HOME}


class Program:
    """All that the firmware knows. ``now_s`` is set by the board before it lets the program go on."""

    def __init__(
        self,
        dialect: Dialect,
        settings: Settings,
        uart: Uart,
        limit_switches: Callable[[], tuple[bool, bool, bool]],
        probe_closed: Callable[[], bool],
    ) -> None:
        self.dialect = dialect
        self.settings = settings
        self.uart = uart
        self.limit_switches = limit_switches
        self.probe_closed = probe_closed
        self.now_s = 0.0
        self.blocked_until_s = 0.0
        """The stepper's interrupt holds the processor until then."""
        self.planner = Planner(dialect.blocks, caps_feed_before_override=dialect.name == "grblhal")
        self.stepper = Stepper(self.planner, dialect.segments)
        self.flags: set[Flag] = set()
        self.alarm: Alarm | None = None
        self.state = State.IDLE
        self.origin_steps = [0, 0, 0]
        """Machine position minus motor position, in steps."""
        self.coordinates: list[Point] = [(0.0, 0.0, 0.0)] * (9 if dialect.name == "grblhal" else 6)
        self.homes_mm: list[Point] = [(0.0, 0.0, 0.0)] * 2
        self.startup_lines = ["", ""]
        self.build_info = ""
        self.version = ""
        """That it tells in place of its own."""
        self.tool_mm: Point = (0.0, 0.0, 0.0)
        self.homed = False
        self.jog_cancels = 0
        self.locked_at_start = settings.flag(22)
        self._line = bytearray()
        self._listens = False
        """Whether it waits for the next byte, with nothing else in hand."""
        self._begin()

    def _begin(self) -> None:
        """Everything that a reset clears."""
        self.suspend = Suspend()
        self.flags.clear()
        self.alarm = None
        self.modal = Modal()
        self.g92_mm: Point = (0.0, 0.0, 0.0)
        if not self.dialect.latches_errors:
            self.tool_mm = (0.0, 0.0, 0.0)
        self.probe_mm: Point = (0.0, 0.0, 0.0)
        self.probe_succeeded = False
        self.probing = False
        self.probe_away = False
        self.soft_limit_hit = False
        self.last_error = 0
        self.spindle = "M5"
        self.spindle_rpm = 0.0
        self.spindle_stopped = False
        self.spindle_toggle_due = False
        """The spindle stop override waits for the end of a hold."""
        self.flood = False
        self.overrides = Overrides()
        self.report = Reporter(self)
        self.forget_line()
        self.planner.reset()
        self.planner.feed_override = self.planner.rapid_override = 100
        self.planner_mm_from_motors()

    # --- places ----------------------------------------------------------------------------------------------------

    @property
    def machine_steps(self) -> tuple[int, int, int]:
        """Machine position in whole steps."""
        x, y, z = (round(p) + o for p, o in zip(self.stepper.position, self.origin_steps, strict=True))
        return x, y, z

    def _mm(self, steps: tuple[int, int, int]) -> Point:
        x, y, z = (n / s for n, s in zip(steps, self.settings.steps_per_mm, strict=True))
        return x, y, z

    @property
    def machine_mm(self) -> Point:
        """Machine position of the motors, now."""
        return self._mm(self.machine_steps)

    def planner_mm_from_motors(self) -> None:
        """Parser and planner believe that they stand where the motors stand."""
        self.planner.position = self.machine_steps
        self.position_mm = self.machine_mm

    @property
    def work_offset_mm(self) -> Point:
        """Machine minus work coordinates."""
        parts = zip(self.coordinates[self.modal.coordinates], self.g92_mm, self.tool_mm, strict=True)
        x, y, z = (a + b + c for a, b, c in parts)
        return x, y, z

    @property
    def frame(self) -> Frame:
        """What the G-code reader must know."""
        return Frame(
            position_mm=self.position_mm,
            coordinates=lambda index: self.coordinates[min(index, len(self.coordinates) - 1)],
            g92_mm=self.g92_mm,
            tool_mm=self.tool_mm,
            homes_mm=(self.homes_mm[0], self.homes_mm[1]),
            last_coordinates=len(self.coordinates) - 1,
            any_axis_tool_offset=self.dialect.name == "grblhal",
            knows_hal_words=self.dialect.name == "grblhal",
        )

    # --- words and pauses ------------------------------------------------------------------------------------------

    def say(self, text: str) -> None:
        """One line to the host."""
        self.uart.say(text + "\r\n", self.now_s)

    def answer(self, error: int) -> None:
        """The reply that every line gets."""
        self.say(f"error:{error}" if error else "ok")

    def at_rest(self) -> bool:
        """Nothing moves and nothing is suspended."""
        return self.state is State.IDLE

    def idle_motors(self) -> None:
        """After motion the firmware lets the motors settle for ``$1`` ms, unless told to keep them on."""
        if self.dialect.idle_delay and self.settings[1] != 255 and self.state is not State.HOME:
            pause_s = self.settings[1] / 1000 * self.dialect.delay_stretch
            self.blocked_until_s = max(self.blocked_until_s, self.now_s + pause_s)

    def delay(self, duration_s: float) -> Waits:
        """Deaf for a while."""
        yield self.now_s + duration_s * self.dialect.delay_stretch

    def interrupt_reset(self) -> None:
        """0x18, or a limit switch: flag it, stop the spindle, and kill motion dead if there is any."""
        if Flag.RESET in self.flags:
            return
        self.flags.add(Flag.RESET)
        self.set_spindle("M5", 0.0)
        self.flood = False
        slowing = self.stepper.holding and self.stepper.running
        if self.state in _IN_MOTION or slowing:
            if self.state is not State.HOME:
                self.alarm = Alarm.ABORTED
            elif not self.alarm:
                self.alarm = Alarm.HOMING_RESET
            self.homed = False
            self.stepper.running = False
            self.idle_motors()

    def set_spindle(self, command: str, speed: float) -> None:
        """Let the spindle turn, within ``$30`` and ``$31`` and under its override."""
        if command != self.spindle:
            self.report.overrides_changed(accessories=True)
        self.spindle = command
        wanted = speed * self.overrides.spindle / 100
        low, high = self.settings[31], self.settings[30]
        if command == "M5" or self.spindle_stopped or wanted <= 0:
            self.spindle_rpm = 0.0
        else:
            self.spindle_rpm = min(max(wanted, low), high)

    # --- the loop --------------------------------------------------------------------------------------------------

    def run(self) -> Waits:
        """Power-up, and again after every reset."""
        while True:
            self._listens = False
            self.uart.rx.clear()
            self._begin()
            self.stepper.reset()
            self.planner_mm_from_motors()
            self.idle_motors()
            yield self.now_s
            self.say("\r\n" + self.dialect.banner)
            with suppress(Aborted):
                yield from self._start()
                while True:
                    yield from self._read_lines()
                    self.start_cycle_if_queued()
                    yield from self.realtime()
                    self._listens = True
                    yield None
                    self._listens = False

    def _start(self) -> Waits:
        if self.settings.flag(22) and self.locked_at_start:
            self.state = State.ALARM
        self.locked_at_start = False
        if self.settings.flag(21) and any(self.limit_switches()) and self.dialect.name == "gnea":
            self.state = State.ALARM
            self.say("[MSG:Check Limits]")
        if self.state in {State.ALARM, State.SLEEP}:
            self.state = State.ALARM
            self.say("[MSG:'$H'|'$X' to unlock]")
        else:
            self.state = State.IDLE
            yield from self.run_startup_lines()

    def run_startup_lines(self) -> Waits:
        """The lines stored by ``$N``."""
        for text in self.startup_lines:
            if text:
                error = yield from self.catching(grbl_moves.run_line(self, text))
                self.say(f">{text}:" + (f"error:{error}" if error else "ok"))

    def _read_lines(self) -> Waits:
        rx = self.uart.rx
        while rx:
            byte = rx.popleft()
            if byte not in b"\r\n":
                self._take(byte)
                continue
            yield self.now_s + self.dialect.line_cost_s
            yield from self.realtime()
            text, overflow = self._line.decode("latin-1"), self._overflow
            self.forget_line()
            try:
                yield from self._obey(text, overflow=overflow)
            except Aborted:
                self.answer(0)
                raise

    def take_quietly(self, byte: int) -> bool:
        """Put a byte into the line without a turn of the loop, if that would do no more than this."""
        idle = self._listens and not (self.flags or self.alarm or self.uart.rx or self.overrides.waits)
        starts = self.planner.blocks and self.state is not State.RUN
        if not idle or starts or byte in b"\r\n":
            return False
        self._take(byte)
        grbl_realtime.keep_prepared(self)
        return True

    def forget_line(self) -> None:
        """What has been read of a line so far."""
        self._line.clear()
        self._overflow = False
        self._comment = ""

    def _take(self, byte: int) -> None:
        """One character of a line; blanks and comments are thrown away."""
        if self._comment:
            if self._comment == "(" and byte == ord(")"):
                self._comment = ""
        elif byte <= ord(" ") or byte == ord("/"):
            pass
        elif byte in b"(;":
            self._comment = chr(byte)
        elif byte == ord("%") and self.dialect.name == "grblhal" and not self._line:
            pass
        elif len(self._line) >= self.dialect.line_size - 1:
            self._overflow = True
        else:
            self._line.append(byte - 32 if ord("a") <= byte <= ord("z") else byte)

    def _obey(self, text: str, *, overflow: bool) -> Waits:
        if overflow:
            self.last_error = 11
        elif not text:
            self.last_error = 0
        elif text[0] == "$":
            self.last_error = yield from self.catching(grbl_commands.run(self, text))
        elif self.state in {State.ALARM, State.JOG}:
            self.last_error = 9
        elif not (self.dialect.latches_errors and self.last_error):
            self.last_error = yield from self.catching(grbl_moves.run_line(self, text))
        self.answer(self.last_error)

    def catching(self, part: Waits) -> Generator[float | None, None, int]:
        """The error code of a part of the program; 0 is fine."""
        try:
            yield from part
        except GcodeError as error:
            return error.code
        return 0

    # --- real time -------------------------------------------------------------------------------------------------

    def start_cycle_if_queued(self) -> None:
        """Ask for motion when there is something to move."""
        if self.planner.blocks:
            self.flags.add(Flag.CYCLE_START)

    def wait_for_motion(self) -> Waits:
        """Until all that is queued has been done."""
        self.start_cycle_if_queued()
        while True:
            yield from self.realtime()
            if not (self.planner.blocks or self.state is State.RUN):
                return
            yield None

    def realtime(self) -> Waits:
        """Look at the flags, and stay here while suspended."""
        while True:
            if self.alarm:
                yield from grbl_realtime.report_alarm(self)
            grbl_realtime.look_at_flags(self)
            if not self.suspend.active:
                return
            yield from grbl_realtime.while_suspended(self)
            yield None
