"""`mill stop`."""

import contextlib
import os
import re
import signal
from pathlib import Path

import click

from cli.options import rig_option
from cli.rig import rig_for
from drivers.clock import Clock
from drivers.device import Device
from drivers.errors import DeviceError
from drivers.lock import owner_of

LIFT_S = 2.0
"""A run lifts the drill and stops the spindle within a second of being asked."""


@click.command()
@rig_option
def stop(rig: Path | None) -> None:
    """Stop motion and spindle of a rig, whoever runs it.

    A mill command that owns the devices is asked to lift and stop, and killed if it does not within 2 s. Then, or when
    nobody owns them, the spindle and the motion controller are stopped directly. The position may be lost: home next.
    """
    if rig is None:
        raise click.UsageError("--rig FILE is needed: it names the devices to stop")
    with rig_for(rig, emulate=False, specimen=None, seed=0) as bench:
        tables = (bench.config.spindle.model_dump(), bench.config.motion.model_dump())
        _end_owners([str(table[key]) for table in tables for key in ("port", "channel") if key in table], bench.clock)
        failures = []
        for name, opener in (("spindle", bench.open_spindle), ("motion", bench.open_motion)):
            try:
                with opener() as device:
                    _stop(device)
                click.echo(f"{name}: stopped")
            except DeviceError as error:
                failures.append(f"{name}: {error}")
    if failures:
        raise DeviceError("; ".join(failures) + "; switch the machine off at its emergency stop")


def _stop(device: Device) -> None:
    from drivers.motion.interface import MotionController
    from drivers.spindle.interface import Spindle

    if isinstance(device, MotionController):
        device.halt()
    elif isinstance(device, Spindle):
        device.stop()
        device.wait_until_at_speed(timeout_s=5.0)


def _end_owners(paths: list[str], clock: Clock) -> None:
    owners = {path: owner for path in paths if (owner := owner_of(path))}
    pids = {int(found.group(1)) for owner in owners.values() if (found := re.match(r"pid (\d+)", owner))}
    for pid in pids:
        click.echo(f"asking pid {pid} to lift and stop")
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)
    deadline_s = clock.now_s() + LIFT_S
    while any(owner_of(path) for path in owners) and clock.now_s() < deadline_s:
        clock.sleep_s(0.02)
    for path in owners:
        if owner_of(path):
            click.echo(f"{path} is still held: killing its owner")
            for pid in pids:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
