"""`mill devices`."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.options import json_option, rig_option
from cli.output import columns, write_json

if TYPE_CHECKING:
    from drivers.discovery import FoundDevice


@click.command()
@rig_option
@json_option
def devices(rig: Path | None, json_file: Path | None) -> None:
    """List serial ports, CAN interfaces and cameras; opens none of them.

    With --rig, the ports that the rig file names are listed too, such as those of a virtual bench.
    """
    found = found_devices(rig)
    if json_file:
        write_json(json_file, "devices", seed=None, devices=[asdict(device) for device in found])
    if json_file and str(json_file) == "-":
        return
    if not found:
        click.echo("nothing found: no serial port, CAN interface or camera. Is it plugged in? `lsusb` lists what is.")
        return
    rows = []
    for device in found:
        name, *_ = [*device.stable_paths, device.path]
        now = device.path if device.path != name else ""
        about = (device.usb_id or "", device.serial_number or "", device.product or "")
        rows.append((device.kind, name, now, *about, state(device)))
    for line in columns(("kind", "use this name", "is now", "USB id", "serial number", "product", "state"), rows):
        click.echo(line)


def found_devices(rig: Path | None) -> "list[FoundDevice]":
    """What is plugged in, and the ports that the rig file names."""
    from cli.config import load_rig
    from drivers.discovery import find_devices

    named: list[str] = []
    if rig is not None:
        config = load_rig(rig)
        named += [str(port)] if (port := config.motion.model_dump().get("port")) else []
        named += [str(channel)] if (channel := config.spindle.model_dump().get("channel")) else []
    return find_devices(named)


def state(device: "FoundDevice") -> str:
    """Whether it could be opened, and if not, why."""
    if device.owner:
        return f"held by {device.owner}"
    return device.problem or "ready"
