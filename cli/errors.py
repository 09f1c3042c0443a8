"""`python -m cli.errors`: writes docs/errors.md, every error that mill tells and what to do about it, from the code."""

from collections.abc import Iterator
from pathlib import Path

from cli.main import exit_code
from drivers import errors
from drivers.errors import MillError
from drivers.motion.bcap.results import WORDS as BCAP
from drivers.motion.grbl.codes import ALARMS, ERRORS
from drivers.motion.tinyg.codes import CODES as G2CORE
from drivers.spindle import delta_registers, emergency, modbus_wire

PAGE = Path(__file__).parent.parent / "docs/errors.md"

HEAD = """\
# Errors

Written by `python -m cli.errors` from the code; a test holds the two together.

An error of mill is one line on stderr: what, where, what was found, what is allowed, and the next step. A traceback is
a fault of mill itself.
Programs tell errors apart by class (`drivers.errors`), scripts by exit code:

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | ended otherwise than asked: held, aborted, a check or a calibration failed |
| 2 | wrong input; nothing moved |
| 3 | a device failed |
| 130 | interrupted |

The first fault latches: nothing moves until `mill jog --home` (`home()`) has released it.
"""

MOVED_AND_STEP: dict[type[MillError], tuple[str, str]] = {
    errors.MillError: ("the message says", "do what the message says"),
    errors.DeviceError: ("may have", "look at the device it names; `mill doctor --rig FILE` examines all of them"),
    errors.ConnectionLostError: (
        "no while it is being opened; later the position is taken for lost",
        "check cable and power; `mill devices` lists what is connected, `mill jog --home` trusts the position again",
    ),
    errors.DeviceTimeoutError: (
        "may have",
        "check cable and power, then the computer's load; `reply_s` and `heartbeat_s` (docs/rig.md) are its patience",
    ),
    errors.ProtocolError: (
        "may have",
        "check baud rate, firmware, cable and shielding; `mill devices --identify` asks",
    ),
    errors.DeviceFaultError: (
        "may have; the device has stopped by itself",
        "remove the cause that the code names (tables below), then `mill jog --home`",
    ),
    modbus_wire.RefusedError: (
        "may have; the inverter has its own reason",
        "correct the parameter of the inverter that the message names (tables below)",
    ),
    modbus_wire.StoppedError: ("may have; a stop came first", "start the drill again where that was meant"),
    errors.DeviceBusyError: ("no", "end the process that it names; `mill stop` ends one of mill's"),
    errors.NotHomedError: ("no", "`mill jog --home`"),
    errors.OutOfTravelError: ("no", "choose a target inside the travel that the message tells"),
    errors.ConfigError: (
        "no; where results cannot be written, the work itself was done",
        "correct the file or option that it names; docs/rig.md says what each key means",
    ),
    errors.CalibrationError: (
        "may have, in free air",
        "look into the report beside the calibration file; clean the optics, then `mill calibrate`",
    ),
    errors.WrongCalibrationError: ("no", "`mill calibrate` with the devices and settings of now"),
    errors.DetectionError: (
        "may have, in free air",
        "look at the pictures (`mill devices --pictures DIR`): light, focus, lens cap, what lies in view",
    ),
    errors.PlanError: ("may have; bone was touched at most", "move or clean the specimen, or change the job"),
    errors.SafetyStop: (
        "yes; the drill is lifted, or stands where it cannot be",
        "read why in the run's report; `mill resume RUN` goes on where that can be done",
    ),
}
"""Whether anything moved, and the next step of a person."""


def page() -> str:
    """The text of docs/errors.md."""
    return "\n".join([HEAD, *_classes(), *_grbl(), *_other_controllers(), *_drive(), ""])


def kinds(kind: type[MillError] = MillError, depth: int = 0) -> Iterator[tuple[type[MillError], int]]:
    """Every class of the table, each under its first parent, and how deep it lies."""
    yield kind, depth
    for child in kind.__subclasses__():
        if child in MOVED_AND_STEP and child.__mro__[1] is kind:
            yield from kinds(child, depth + 1)


def _classes() -> Iterator[str]:
    yield "## By class\n"
    yield "| class | what it means | exit code | whether anything moved | next step |"
    yield "|---|---|---|---|---|"
    for kind, depth in kinds():
        moved, step = MOVED_AND_STEP[kind]
        meaning = (kind.__doc__ or "").strip().rstrip(".")
        indent = "&nbsp;" * 4 * depth
        yield f"| {indent}`{kind.__name__}` | {meaning} | {exit_code(kind(''))} | {moved} | {step} |"
    yield ""


def _grbl() -> Iterator[str]:
    yield "## GRBL: `error:N`, a line was refused\n"
    yield "Nothing of the line happens. The numbers above 38 are grblHAL's.\n"
    yield from _table(("code", "meaning"), ((f"error:{code}", words) for code, words in ERRORS.items()))
    yield "## GRBL: `ALARM:N`, the controller stopped itself\n"
    yield "`mill jog --home` releases each. After an alarm that lost the position, look where the drill stands first.\n"
    yield from _table(
        ("code", "meaning", "position"),
        ((f"ALARM:{code}", alarm.words, "lost" if alarm.position_lost else "kept") for code, alarm in ALARMS.items()),
    )


def _other_controllers() -> Iterator[str]:
    yield "## g2core: status codes\n"
    yield "In the footer of a reply or in an exception report.\n"
    yield from _table(("code", "meaning"), ((str(code), words) for code, words in G2CORE.items()))
    yield "## b-CAP: results of the robot's controller\n"
    yield "What is not listed stands in the controller's own list of errors.\n"
    yield from _table(("result", "meaning"), ((f"0x{code:08X}", words) for code, words in BCAP.items()))


def _drive() -> Iterator[str]:
    yield "## CiA 402: emergency codes of the drive\n"
    yield "In messages as `drive fault 0x7121 motor blocked`. A code that is not listed is told by its family.\n"
    yield from _table(("code", "meaning"), ((f"0x{code:04X}", words) for code, words in emergency.EXACT.items()))
    yield from _table(("family", "meaning"), ((f"0x{code:X}...", words) for code, words in emergency.BY_FAMILY.items()))
    yield "## Delta VFD: faults of the inverter\n"
    yield "Acknowledge at the inverter once the cause is gone.\n"
    yield from _table(("code", "meaning"), ((str(code), words) for code, words in delta_registers.FAULTS.items()))


def _table(titles: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(titles)} |"
    yield "|" + "---|" * len(titles)
    for row in rows:
        yield f"| {' | '.join(row)} |"
    yield ""


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
