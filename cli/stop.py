"""`mill stop`."""

import contextlib
import os
import re
import signal
from pathlib import Path

import click

from cli.config import RigConfig
from cli.options import rig_option
from cli.rig import rig_for
from drivers.clock import Clock
from drivers.device import Device
from drivers.errors import DeviceError, MillError
from drivers.lock import can_device, owner_of

LIFT_S = 2.0
"""A run lifts the drill and stops the spindle within a second of being asked."""
KILL_S = 1.0
"""The kernel lets go of a killed process's locks in milliseconds, unless it hangs in a device's driver."""


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
        _end_owners(_locked_names(bench.config), bench.clock)
        failures = []
        for name, opener in (("spindle", bench.open_spindle), ("motion", bench.open_motion)):
            try:
                with opener() as device:
                    _stop(device)
                click.echo(f"{name}: stopped")
            except MillError as error:
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


def _locked_names(config: RigConfig) -> list[str]:
    """What the locks of spindle and motion are called: ports, or a network interface."""
    spindle, motion = config.spindle.model_dump(), config.motion.model_dump()
    if spindle.get("interface") == "socketcan":
        spindle["channel"] = can_device(spindle["channel"])
    return [str(table[key]) for table in (spindle, motion) for key in ("port", "channel") if key in table]


def _end_owners(names: list[str], clock: Clock) -> None:
    for number, words, limit_s in (
        (signal.SIGTERM, "asking pid {} to lift and stop", LIFT_S),
        (signal.SIGKILL, "pid {} does not end: killing it", KILL_S),
    ):
        for pid in sorted(_owners(names)):
            click.echo(words.format(pid))
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, number)
        deadline_s = clock.now_s() + limit_s
        while _owners(names) and clock.now_s() < deadline_s:
            clock.sleep_s(0.02)


def _owners(names: list[str]) -> set[int]:
    return {int(found[1]) for name in names if (found := re.match(r"pid (\d+)", owner_of(name) or ""))}
