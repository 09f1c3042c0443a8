"""Feed, rapid and spindle overrides: real-time bytes that act on all that is queued."""

from typing import TYPE_CHECKING

from firmware_sim.grbl_states import Flag

if TYPE_CHECKING:
    from firmware_sim.grbl_program import Program

_FEED = {0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}
_RAPID = {0x95: 100, 0x96: 50, 0x97: 25}
_SPINDLE = {0x9A: 10, 0x9B: -10, 0x9C: 1, 0x9D: -1}
_FEED_RESET, _SPINDLE_RESET, _SPINDLE_STOP, _FLOOD = 0x90, 0x99, 0x9E, 0xA0
OVERRIDE_BYTES = frozenset({*_FEED, *_RAPID, *_SPINDLE, _FEED_RESET, _SPINDLE_RESET, _SPINDLE_STOP, _FLOOD})
_LOWEST, _HIGHEST = 10, 200


def _within(value: int) -> int:
    return min(max(value, _LOWEST), _HIGHEST)


class Overrides:
    """In per cent. Bytes are collected by the interrupt and applied by the program."""

    def __init__(self) -> None:
        self.feed = 100
        self.rapid = 100
        self.spindle = 100
        self._asked: list[int] = []

    def ask(self, byte: int) -> None:
        """A real-time byte has arrived; the same one twice between two looks of the program counts once."""
        if byte not in self._asked:
            self._asked.append(byte)

    @property
    def waits(self) -> bool:
        """Whether something was asked and not yet applied."""
        return bool(self._asked)

    def apply(self, program: "Program") -> None:
        """Act on what was asked."""
        if not self._asked:
            return
        # A hold that came before them counts first.
        waits = (_SPINDLE_STOP,) if Flag.HOLD in program.flags else ()
        asked = [byte for byte in self._asked if byte not in waits]
        self._asked = [byte for byte in self._asked if byte in waits]
        before = (self.feed, self.rapid, self.spindle)
        for byte in asked:
            if byte == _FEED_RESET:
                self.feed = 100
            elif byte in _FEED:
                self.feed = _within(self.feed + _FEED[byte])
            elif byte in _RAPID:
                self.rapid = _RAPID[byte]
            elif byte == _SPINDLE_RESET:
                self.spindle = 100
            elif byte in _SPINDLE:
                self.spindle = _within(self.spindle + _SPINDLE[byte])
            elif byte == _SPINDLE_STOP:
                self._stop_spindle(program)
            elif byte == _FLOOD and program.state.value in {"Idle", "Run", "Hold"}:
                program.flood = not program.flood
                program.report.overrides_changed(accessories=True)
        if (self.feed, self.rapid) != before[:2]:
            program.planner.feed_override, program.planner.rapid_override = self.feed, self.rapid
            program.planner.apply_overrides(program.stepper.speed)
            program.stepper.replan()
        if (self.feed, self.rapid, self.spindle) != before:
            program.report.overrides_changed()
        if self.spindle != before[2]:
            program.set_spindle(program.spindle, program.modal.speed)

    @staticmethod
    def _stop_spindle(program: "Program") -> None:
        """Only in a hold; at its end only, and the other way round where it was stopped already."""
        if program.state.value == "Hold":
            program.spindle_toggle_due = True
