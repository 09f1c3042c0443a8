"""The faults that a virtual bench can be given: their names, their values, and when they begin.

A fault is written ``NAME[=VALUE][@TIME]``, such as ``camera.stuck@30s``, ``serial.drop=1e-3``, ``vision.low=0.7:arc``.
Without a time it is there from the beginning; ``@30s`` is 30 s after the drill first turned, which is where milling
starts. ``vision.low=0.5..0.9:arc`` draws its value by the seed of the mouse. What each one does is in
``firmware_sim.sabotage`` (devices), ``firmware_sim.faulty_reader`` (networks, the program itself) and
``firmware_sim.faulty_disk``.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from drivers.errors import ConfigError

Place = Literal["bench", "host"]
REACHES: Final = ("one", "arc", "all")
"""One point of the ring, a quarter of it, all of it."""
_NUMBER: Final = r"[-+]?(?:0[xX][0-9a-fA-F]+|\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+)"
_SCALES: Final = {"ms": 1e-3, "s": 1.0, "mm": 1.0, "um": 1e-3, "%": 0.01, "x": 1.0, "": 1.0}


@dataclass(frozen=True)
class Kind:
    """One entry of the catalogue; a kind without a unit takes no value."""

    does: str
    place: Place = "bench"
    default: float = 0.0
    unit: str | None = None
    low: float = 0.0
    high: float = 0.0
    reach: bool = False
    """Whether ``:one``, ``:arc`` or ``:all`` may follow; the value may then be a range too, ``0.5..0.9``."""
    word: str = ""
    """What it is without a value, where its values are no numbers but match ``pattern``."""
    pattern: str = ""


CATALOGUE: Final[dict[str, Kind]] = {
    "camera.stuck": Kind("the same picture for ever, with new times"),
    "camera.off": Kind("no more pictures"),
    "camera.slow": Kind("pictures arrive late", default=0.2, unit="s", low=0.01, high=5.0),
    "camera.black": Kind("the light is gone"),
    "camera.blur": Kind("out of focus"),
    "camera.swapped": Kind("left and right are exchanged"),
    "camera.mirrored": Kind("the left picture is mirrored"),
    "camera.skew": Kind("the right picture is older than the left", default=0.04, unit="s", low=0.005, high=1.0),
    "camera.exposure": Kind("the exposure is changed", default=2.0, unit="x", low=0.1, high=10.0),
    "camera.intermittent": Kind("so many of the pictures do not arrive", default=0.5, unit="", low=0.01, high=1.0),
    "camera.torn": Kind("the lower half of each picture is of the one before"),
    "camera.glare": Kind("a reflection hides a part of the ring"),
    "camera.size": Kind("pictures have another size than told"),
    "camera.moved": Kind("the microscope is pushed aside", default=0.2, unit="mm", low=0.01, high=5.0),
    "serial.drop": Kind("bytes of the motion port are lost", default=1e-3, unit="", low=1e-6, high=1.0),
    "serial.flip": Kind("bits of the motion port are flipped", default=1e-3, unit="", low=1e-6, high=1.0),
    "serial.dup": Kind("bytes of the motion port come twice", default=1e-3, unit="", low=1e-6, high=1.0),
    "serial.insert": Kind("bytes come out of nowhere on the motion port", default=1e-3, unit="", low=1e-6, high=1.0),
    "serial.slice": Kind("bytes of the motion port come in pieces, and pieces together"),
    "serial.stall": Kind("the motion port is silent both ways"),
    "serial.latency": Kind("answers of the motion board are late", default=0.016, unit="s", low=0.001, high=1.0),
    "serial.unplug": Kind("the motion port is gone"),
    "port.held": Kind("another program has the motion port"),
    "motion.alarm": Kind("the motion board raises an alarm", default=1, unit="", low=1, high=9),
    "motion.reset": Kind("the motion board restarts"),
    "motion.backlash": Kind("play of every axis", default=0.05, unit="mm", low=0.001, high=0.5),
    "motion.scale_x": Kind("X moves farther than told", default=1.01, unit="x", low=0.9, high=1.1),
    "motion.lost_steps": Kind("steps are lost on Z: the tip is lower than told", default=20, unit="", low=1, high=500),
    "motion.slip": Kind("X slips: the tip is elsewhere than told", default=0.05, unit="mm", low=0.001, high=1.0),
    "motion.no_soft_limits": Kind("the board's soft limits are off"),
    "motion.firmware": Kind("the board has another firmware version", word="1.1f", pattern=r"1\.1[a-z]|\d{2,3}\.\d{2}"),
    "motion.settings_changed": Kind("a setting of the board differs from the rig file"),
    "can.drop": Kind("frames of the CAN bus are lost", default=0.02, unit="", low=1e-6, high=1.0),
    "can.flip": Kind("frames of the CAN bus have wrong data", default=0.02, unit="", low=1e-6, high=1.0),
    "can.short": Kind("frames of the CAN bus lack a byte", default=0.02, unit="", low=1e-6, high=1.0),
    "can.bus_off": Kind("no frame passes any more"),
    "can.silent": Kind("the drive hears and says nothing"),
    "spindle.stall": Kind("the drill is blocked"),
    "spindle.slow": Kind("the drill turns slower than told", default=0.1, unit="%", low=0.01, high=0.9),
    "spindle.overspeed": Kind("the drill turns half as fast again as told"),
    "spindle.starts_by_itself": Kind("the drill turns without being told"),
    "spindle.no_consumer": Kind("the drive does not mind a silent host"),
    "spindle.emcy": Kind("the drive reports an error and stops", default=0x2310, unit="", low=0x1000, high=0xFFFF),
    "vision.nan": Kind("the network answers NaN", place="host"),
    "vision.slow": Kind("the network is late", place="host", default=0.5, unit="s", low=0.01, high=10.0),
    "vision.low": Kind(
        "completion never reads more than this", place="host", default=0.7, unit="", low=0.05, high=0.99, reach=True
    ),
    "vision.high": Kind("completion reads as through from the beginning", place="host", reach=True),
    "host.stop": Kind(
        "the program that mills stands still once", place="host", default=2.0, unit="s", low=0.01, high=60.0
    ),
    "host.hog": Kind(
        "so many other programs want every core, from the run's start on",
        place="host",
        default=6,
        unit="",
        low=1,
        high=64,
    ),
    "disk.full": Kind("the disk takes no more of the record; `mill doctor` finds next to no room", place="host"),
    "disk.slow": Kind(
        "once a second the disk keeps the program waiting", place="host", default=0.3, unit="s", low=0.01, high=10.0
    ),
}


@dataclass(frozen=True)
class Fault:
    """One planted fault."""

    name: str
    value: float
    reach: str
    after_s: float | None
    """Since the drill first turned; None: from the beginning."""
    word: str = ""
    highest: float | None = None
    """Where a range was given, from ``value`` to here: each seed draws its own."""

    def drawn(self, seed: int) -> "Fault":
        """The fault with one value of its range; itself where it has none."""
        if self.highest is None:
            return self
        value = float(np.random.default_rng([seed, 4713]).uniform(self.value, self.highest))
        return replace(self, value=value, highest=None)

    @property
    def kind(self) -> Kind:
        """Its entry in the catalogue."""
        return CATALOGUE[self.name]

    def __str__(self) -> str:
        value = f"={self.value:g}" if self.kind.unit is not None else f"={self.word}" if self.word else ""
        value += "" if self.highest is None else f"..{self.highest:g}"
        reach = f"{':' if value else '='}{self.reach}" if self.kind.reach else ""
        return f"{self.name}{value}{reach}" + (f"@{self.after_s:g}s" if self.after_s is not None else "")


def parse_fault(text: str) -> Fault:
    """Read ``NAME[=VALUE][@TIME]``.

    Raises:
        ConfigError: naming what is wrong and what is allowed.
    """
    name_and_value, at, time = text.strip().partition("@")
    name, equals, value = name_and_value.partition("=")
    kind = CATALOGUE.get(name)
    if kind is None:
        near = [known for known in CATALOGUE if known.partition(".")[0] == name.partition(".")[0]] or list(CATALOGUE)
        raise ConfigError(f"fault {text!r}: no fault {name!r}; there are {', '.join(near)}")
    after_s = _quantity(text, time, "s", 0.0, 86_400.0) if at else None
    if kind.word:
        if equals and not re.fullmatch(kind.pattern, value):
            raise ConfigError(f"fault {text!r}: found {value!r}, needs a word such as {kind.word}")
        return Fault(name, 0.0, "", after_s, value or kind.word)
    number, reach = _split(text, kind, value) if equals else ("", "")
    lowest, dots, highest = number.partition("..") if kind.reach else (number, "", "")
    amount = _quantity(text, lowest, kind.unit or "", kind.low, kind.high) if number else kind.default
    to = _quantity(text, highest, kind.unit or "", amount, kind.high) if dots else None
    return Fault(name, amount, reach or ("all" if kind.reach else ""), after_s, highest=to)


def parse_faults(texts: Iterable[str], *, place: Place | None = None) -> tuple[Fault, ...]:
    """Read several; with ``place``, only those that are planted there.

    Raises:
        ConfigError: as of ``parse_fault``.
    """
    return tuple(fault for fault in map(parse_fault, texts) if place in (None, fault.kind.place))


def _split(text: str, kind: Kind, value: str) -> tuple[str, str]:
    """The number and the reach of a value."""
    number, colon, reach = value.partition(":")
    if kind.reach and not colon and number in REACHES:
        number, reach = "", number
    if reach and (not kind.reach or reach not in REACHES):
        allowed = f"after the colon: {', '.join(REACHES)}" if kind.reach else "without a colon"
        raise ConfigError(f"fault {text!r}: found {reach!r}, allowed {allowed}")
    if number and kind.unit is None:
        raise ConfigError(f"fault {text!r}: takes no value; leave {number!r} out")
    return number, reach


def _quantity(text: str, written: str, unit: str, low: float, high: float) -> float:
    match = re.fullmatch(rf"({_NUMBER})\s*([a-zA-Z%]*)", written)
    asked = f"a number from {low:g} to {high:g}" + (f", in {unit}" if unit else "")
    if match is None or match[2] not in _SCALES:
        raise ConfigError(f"fault {text!r}: found {written!r}, needs {asked}")
    same_kind = {"s": {"s", "ms", ""}, "mm": {"mm", "um", ""}, "%": {"%", ""}, "x": {"x", ""}, "": {""}}[unit]
    if match[2] not in same_kind:
        raise ConfigError(f"fault {text!r}: found {written!r}, needs {asked}")
    number = float(int(match[1], 16)) if match[1].lower().startswith("0x") else float(match[1])
    value = number * _SCALES[match[2]]
    if not low <= value <= high:
        raise ConfigError(f"fault {text!r}: found {written!r}, needs {asked}")
    return value


def markdown() -> str:
    """The catalogue as a page."""
    lines = [
        "# Faults of the virtual bench",
        "",
        "`--fault NAME[=VALUE][@TIME]` plants one, and may be given more than once: to `mill emulate`, or to a command",
        "with `--emulate`. It is refused with `--rig`: what is not virtual has faults enough. Without a time the fault",
        "is there from the beginning; `@30s` is 30 s after the drill first turned (for `vision` and `host`: after",
        "the ring was first read). What was planted stands in the header of the run's record. The same seed plants the",
        "same.",
        "",
        "| name | what happens | value, unless told | allowed |",
        "|---|---|---|---|",
    ]
    for name, kind in CATALOGUE.items():
        value = kind.word if kind.unit is None else f"{kind.default:g}{'' if kind.unit == '%' else kind.unit}"
        allowed = "" if kind.unit is None else f"{kind.low:g} to {kind.high:g}"
        reach = f"; `:{'`, `:'.join(REACHES)}` of the ring" if kind.reach else ""
        reach += "; a range, `0.5..0.9`, of which each seed draws" if kind.reach and kind.unit is not None else ""
        lines.append(f"| `{name}` | {kind.does} | {value} | {allowed}{reach} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(markdown(), end="")
