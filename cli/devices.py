"""`mill devices`."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.options import json_option, rig_option
from cli.output import write_json

if TYPE_CHECKING:
    from drivers.discovery import FoundDevice


@click.command()
@rig_option
@json_option
def devices(rig: Path | None, json_file: Path | None) -> None:
    """List serial ports, CAN interfaces and cameras; opens none of them.

    With --rig, the ports that the rig file names are listed too, such as those of a virtual bench.
    """
    from rich.console import Console
    from rich.table import Table

    from cli.config import GrblMotion, load_rig
    from drivers.discovery import find_devices

    named: list[str] = []
    if rig is not None:
        config = load_rig(rig)
        named += [config.motion.port] if isinstance(config.motion, GrblMotion) else []
        named += [str(channel)] if (channel := config.spindle.model_dump().get("channel")) else []
    found = find_devices(named)
    if json_file:
        write_json(json_file, "devices", seed=None, devices=[asdict(device) for device in found])
    if json_file and str(json_file) == "-":
        return
    if not found:
        click.echo("nothing found: no serial port, CAN interface or camera. Is it plugged in? `lsusb` lists what is.")
        return
    table = Table("kind", "use this name", "is now", "USB id", "serial number", "product", "state")
    for device in found:
        table.add_row(
            device.kind,
            device.stable_paths[0] if device.stable_paths else device.path,
            device.path,
            device.usb_id or "",
            device.serial_number or "",
            device.product or "",
            state(device),
        )
    Console().print(table)


def state(device: "FoundDevice") -> str:
    """Whether it could be opened, and if not, why."""
    if device.owner:
        return f"held by {device.owner}"
    return device.problem or "ready"
