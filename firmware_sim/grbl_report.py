"""Status reports, and their habit of leaving out what has not changed."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from firmware_sim.grbl_gcode import Point
    from firmware_sim.grbl_program import Program

_BUSY = {"Run", "Hold", "Jog", "Home", "Door"}


def point_text(point: "Point") -> str:
    """Three coordinates with three decimals."""
    return ",".join(f"{value:.3f}" for value in point)


class Reporter:
    """Counts reports: work offset and overrides come only now and then."""

    def __init__(self, program: "Program") -> None:
        self._program = program
        self._is_hal = program.dialect.name == "grblhal"
        self._wco_in = 0
        self._overrides_in = 0
        self._accessories = self._is_hal
        self._tool_length = self._is_hal
        self.homed_changed = False
        self.held_feed = 0.0
        """grblHAL shows, at the end of a hold, the feed it will go on with."""

    def offsets_changed(self) -> None:
        """The next report shows the work offset."""
        self._wco_in = 0

    def overrides_changed(self, *, accessories: bool = False) -> None:
        """The next report shows the overrides."""
        if not (self._is_hal and accessories):
            self._overrides_in = 0
        self._accessories = self._accessories or accessories

    def status(self) -> None:
        """The answer to `?`."""
        program = self._program
        mask = program.settings.mask(10)
        offset, machine = program.work_offset_mm, program.machine_mm
        parts = [self._state()]
        if mask & 1:
            parts.append("MPos:" + point_text(machine))
        else:
            x, y, z = (m - o for m, o in zip(machine, offset, strict=True))
            parts.append("WPos:" + point_text((x, y, z)))
        if mask & 2:
            parts.append(f"Bf:{program.planner.free},{program.uart.rx_free}")
        if not self._is_hal or mask & 16:
            feed = self._feed()
            shown = int(feed + 1e-3) if self._is_hal else round(feed)
            parts.append(f"FS:{shown},{program.spindle_rpm:.0f}")
        if not self._is_hal or mask & 32:
            pins = self._pins()
            if pins:
                parts.append("Pn:" + pins)
        parts += self._now_and_then(mask)
        program.say("<" + "|".join(parts) + ">")

    def _state(self) -> str:
        program = self._program
        name = program.state.value
        if name == "Hold":
            return "Hold:0" if program.suspend.complete else "Hold:1"
        if name == "Door":
            if not program.suspend.complete:
                return "Door:2"
            return "Door:3" if program.suspend.restoring else "Door:0"
        return name

    def _feed(self) -> float:
        program = self._program
        name = program.state.value
        if name not in _BUSY:
            return 0.0
        if name == "Hold" and program.suspend.complete:
            return self.held_feed * 60
        return program.stepper.speed * 60

    def _pins(self) -> str:
        program = self._program
        pins = "P" if program.probe_closed() else ""
        return pins + "".join(a for a, pressed in zip("XYZ", program.limit_switches(), strict=True) if pressed)

    def _accessory_text(self) -> str:
        program = self._program
        turning = program.spindle_rpm > 0
        spindle = ("S" if program.spindle == "M3" else "C") if turning else ""
        return spindle + ("F" if program.flood else "")

    def _now_and_then(self, mask: int) -> list[str]:
        return self._hal_fields(mask) if self._is_hal else self._gnea_fields()

    def _gnea_fields(self) -> list[str]:
        program = self._program
        busy = program.state.value in _BUSY
        parts = []
        if self._wco_in > 0:
            self._wco_in -= 1
        else:
            self._wco_in = 29 if busy else 9
            if self._overrides_in == 0:
                self._overrides_in = 1
            if program.settings.mask(10) & 1:
                parts.append("WCO:" + point_text(program.work_offset_mm))
        if self._overrides_in > 0:
            self._overrides_in -= 1
        else:
            self._overrides_in = 19 if busy else 9
            parts.append(self._override_text())
            accessories = self._accessory_text()
            if accessories:
                parts.append("A:" + accessories)
        return parts

    def _override_text(self) -> str:
        overrides = self._program.overrides
        return f"Ov:{overrides.feed},{overrides.rapid},{overrides.spindle}"

    def _hal_fields(self, mask: int) -> list[str]:
        program = self._program
        busy = program.state.value in _BUSY
        parts = []
        if not busy:
            self._wco_in, self._overrides_in = min(self._wco_in, 10), min(self._overrides_in, 10)
        show_overrides = self._overrides_in == 0
        show_offset = self._wco_in == 0 and not show_overrides
        self._overrides_in = (19 if busy else 9) if show_overrides else self._overrides_in - 1
        if show_offset:
            self._wco_in = 29 if busy else 9
            if mask & 64 and mask & 1:
                parts.append("WCO:" + point_text(program.work_offset_mm))
        elif self._wco_in > 0:
            self._wco_in -= 1
        if show_overrides and mask & 128:
            parts.append(self._override_text())
        if (show_overrides and self._accessory_text()) or self._accessories:
            self._accessories = False
            if mask & 128:
                parts.append("A:" + self._accessory_text())
        if self.homed_changed:
            self.homed_changed = False
            parts.append(f"H:{int(program.homed)}")
        if self._tool_length:
            self._tool_length = False
            parts.append("TLR:0")
        return parts
