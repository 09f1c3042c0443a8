"""`mill devices`."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cli.options import json_option, rig_option, trace_option
from cli.output import columns, for_people, write_json
from drivers.clock import Clock, SystemClock
from drivers.errors import ConfigError, DeviceError, MillError

if TYPE_CHECKING:
    from pydantic import BaseModel

    from cli.config import RigConfig
    from drivers.discovery import FoundDevice
    from drivers.identify import Identified
    from drivers.trace_file import Trace

WATCH_S = 1.0
TITLES = ("kind", "use this name", "is now", "USB id", "serial number", "product", "driver", "state", "who")


@click.command()
@rig_option
@json_option
@click.option(
    "--identify", is_flag=True, help="Ask who is there, where nobody holds the device and nothing can happen."
)
@click.option(
    "--suggest",
    type=click.Path(path_type=Path, dir_okay=False, allow_dash=True),
    is_flag=False,
    flag_value="-",
    metavar="[FILE]",
    help="Identify, and write a rig file of what was found; print it without FILE.",
)
@click.option(
    "--pictures",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Save a picture of each camera under its stable name.",
)
@click.option("--watch", is_flag=True, help="Show what is plugged in and pulled, until Ctrl-C.")
@trace_option
def devices(
    rig: Path | None,
    json_file: Path | None,
    identify: bool,
    suggest: Path | None,
    pictures: Path | None,
    watch: bool,
    trace_file: Path | None,
) -> None:
    """List serial ports, CAN interfaces and cameras: stable name, driver, and who holds them.

    Without --identify, --suggest and --pictures none is opened. With --rig, the ports and addresses that the rig file
    names are listed too, such as those of a virtual bench.

    --identify asks a serial port for GRBL's or g2core's version or an SLCAN adapter's, listens to a CAN bus, and asks a
    robot or an inverter that the rig file names. --trace writes down what is asked and answered. No command is sent
    that moves or resets anything; but opening a port raises DTR, on which some boards start anew.
    """
    from cli.config import load_rig
    from cli.rig import trace_of
    from drivers.discovery import find_devices

    wants_stdout = [str(path) for path in (suggest, json_file) if path is not None].count("-")
    if wants_stdout == 2:
        raise click.UsageError("--suggest and --json - both want stdout; give one of them a FILE")
    if watch and (identify or suggest or pictures):
        raise click.UsageError("--watch opens nothing; leave out --identify, --suggest and --pictures")
    if trace_file is not None and not (identify or suggest):
        raise click.UsageError("--trace writes down what is asked; add --identify or --suggest")
    if suggest is not None and str(suggest) != "-" and suggest.exists():
        raise ConfigError(f"{suggest}: exists and is not written over; name another file")
    config = load_rig(rig) if rig is not None else None
    named = _named(config) if config else ((), (), ())
    clock = SystemClock()

    def say(line: str) -> None:
        click.echo(line, err=wants_stdout > 0)

    found = find_devices(*named)
    who: dict[str, Identified] = {}
    if identify or suggest is not None:
        with trace_of(trace_file, clock, config, {}) as trace:
            who = dict(_identified(found, clock, config, trace))
    for line in _table(found, who):
        say(line)
    files = {} if pictures is None else dict(_saved(found, pictures, clock, say))
    if suggest is not None:
        _suggest(suggest, found, who, say)
    results: dict[str, Any] = {"devices": [_as_json(device, who, files) for device in found]}
    if watch:
        results["changes"] = _watch(watched(lambda: find_devices(*named), found, clock), say)
    if json_file:
        write_json(json_file, "devices", seed=None, **results)
    if None in files.values():
        raise SystemExit(1)


def watched(
    look: Callable[[], Sequence["FoundDevice"]], before: Sequence["FoundDevice"], clock: Clock
) -> Iterator[tuple[str, "FoundDevice", float]]:
    """What is plugged in and what is gone since ``before``, second by second without end, and when it was noticed."""
    began_s, known = clock.now_s(), {_key(device): device for device in before}
    while True:
        clock.sleep_s(WATCH_S)
        now = {_key(device): device for device in look()}
        for change, those, others in (("gone", known, now), ("plugged", now, known)):
            for key in those.keys() - others.keys():
                yield change, those[key], clock.now_s() - began_s
        known = now


def _watch(changes: Iterator[tuple[str, "FoundDevice", float]], say: Callable[[str], None]) -> list[dict[str, Any]]:
    """Tell each change as it happens until Ctrl-C, and all of them then."""
    say("watching; Ctrl-C ends it")
    seen: list[dict[str, Any]] = []
    try:
        for change, device, after_s in changes:
            seen.append({"change": change, "after_s": after_s, "device": asdict(device)})
            say("  ".join([f"{change:7}", *filter(None, _cells(device))]))
    except KeyboardInterrupt:
        return seen
    return seen


def found_devices(rig: Path | None) -> "list[FoundDevice]":
    """What is plugged in, and what the rig file names beside that."""
    from cli.config import load_rig
    from drivers.discovery import find_devices

    return find_devices(*(_named(load_rig(rig)) if rig is not None else ()))


def _key(device: "FoundDevice") -> tuple[str | None, ...]:
    """What stays the same of a device for as long as it is plugged in."""
    return (device.kind, device.path, device.usb_id, device.serial_number)


def _named(config: "RigConfig") -> tuple[list[str], list[str], list[tuple[str, int]]]:
    """The ports, the cameras and the robot that a rig file names, of any make."""
    from cli.config import BcapMotion

    camera = config.camera.model_dump()
    cameras = [name for side in ("left", "right") if isinstance(name := camera.get(side), str)]
    motion = config.motion
    robots = [(motion.host, motion.port)] if isinstance(motion, BcapMotion) else []
    return [*_ports(motion), *_ports(config.spindle)], cameras, robots


def _ports(table: "BaseModel") -> list[str]:
    """The serial port of a device's table, by the keys that all makes use."""
    keys = table.model_dump()
    return [name for key in ("port", "channel") if isinstance(name := keys.get(key), str)]


def _identified(
    found: Iterable["FoundDevice"], clock: Clock, config: "RigConfig | None", trace: "Trace | None"
) -> Iterator[tuple[str, "Identified"]]:
    """Whom each device says that it is: those that can be opened are asked, in the way of their kind."""
    from cli.config import ModbusSpindleTable, OtherBackend
    from drivers.identify import Identified, identify_can, identify_inverter, identify_port, identify_robot

    asks: dict[str, Callable[..., Identified]] = {
        "serial": identify_port,
        "can": identify_can,
        "robot": identify_robot,
    }
    tables = {port: table for table in (config.motion, config.spindle) for port in _ports(table)} if config else {}
    for device in found:
        if device.kind == "camera" or device.held_by or device.problem:
            continue
        table = tables.get(device.path) or tables.get(device.name)
        if isinstance(table, OtherBackend):
            yield device.path, Identified(None, f"not asked: backend {table.backend!r} of the rig file")
        elif isinstance(table, ModbusSpindleTable):
            yield (
                device.path,
                identify_inverter(
                    device.name, clock, baud=table.baud, framing=table.framing, station=table.station, trace=trace
                ),
            )
        else:
            yield device.path, asks[device.kind](device.name, clock, trace=trace)


def _saved(
    found: Sequence["FoundDevice"], folder: Path, clock: Clock, say: Callable[[str], None]
) -> Iterator[tuple[str, Path | None]]:
    """A picture of each camera; None where there is none."""
    from drivers.camera.snapshot import file_name, save_snapshot

    folder.mkdir(parents=True, exist_ok=True)
    for device in found:
        if device.kind != "camera":
            continue
        path = folder / file_name(device.name)
        try:
            if device.held_by or device.problem:
                raise DeviceError(f"{device.name}: {state(device)}")
            save_snapshot(device.name, path, clock)
        except MillError as error:
            say(f"no picture: {for_people(error)}")
            yield device.path, None
        else:
            say(f"picture: {path}")
            yield device.path, path


def _suggest(
    path: Path, found: Sequence["FoundDevice"], who: Mapping[str, "Identified"], say: Callable[[str], None]
) -> None:
    from cli.suggest import rig_suggestion

    text = rig_suggestion(found, who)
    if str(path) == "-":
        click.echo(text, nl=False)
        return
    with path.open("x", encoding="utf-8") as file:
        file.write(text)
    say(f"{path} is written; read its comments, then: mill doctor --rig {path}")


def _as_json(
    device: "FoundDevice", who: Mapping[str, "Identified"], files: Mapping[str, Path | None]
) -> dict[str, Any]:
    extra: dict[str, Any] = {}
    if device.path in who:
        extra["identified"] = asdict(who[device.path])
    if device.path in files:
        file = files[device.path]
        extra["picture"] = None if file is None else str(file)
    return {**asdict(device), **extra}


def _table(found: Sequence["FoundDevice"], who: Mapping[str, "Identified"]) -> list[str]:
    if not found:
        return ["nothing found: no serial port, CAN interface or camera. Is it plugged in? `lsusb` lists what is."]
    rows = [(*_cells(device), who[device.path].words if device.path in who else "") for device in found]
    return columns(TITLES, rows)


def _cells(device: "FoundDevice") -> tuple[str, ...]:
    now = device.path if device.path != device.name else ""
    about = (device.usb_id, device.serial_number, device.product, device.driver)
    return (device.kind, device.name, now, *(text or "" for text in about), state(device))


def state(device: "FoundDevice") -> str:
    """Whether it could be opened, and if not, why."""
    if device.held_by:
        return f"held by {device.held_by}"
    return device.problem or "ready"
