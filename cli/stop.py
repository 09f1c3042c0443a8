"""`mill stop`."""

import contextlib
import os
import re
import signal
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import click

from cli.config import GrblSpindleTable, RigConfig
from cli.options import BenchChoice, rig_option, trace_option
from cli.rig import Rig, rig_for
from drivers.clock import Clock
from drivers.errors import DeviceError, MillError
from drivers.lock import can_device, owner_of, udp_device

LIFT_S = 2.0
"""A run lifts the drill and stops the spindle within a second of being asked."""
KILL_S = 1.0
"""The kernel lets go of a killed process's locks in milliseconds, unless it hangs in a device's driver."""


@click.command()
@rig_option
@trace_option
def stop(rig: Path | None, trace_file: Path | None) -> None:
    """Stop motion and spindle of a rig, whoever runs it.

    A mill command that owns the devices is asked to lift and stop, and killed if it does not within 2 s. Then, or when
    nobody owns them, the spindle and the motion controller are stopped directly, each without waiting for the other.
    The position may be lost: home next.
    """
    if rig is None:
        raise click.UsageError("--rig FILE is needed: it names the devices to stop")
    ways = {"motion": _stop_motion, "spindle": _stop_spindle}
    failures = []
    with rig_for(BenchChoice(rig, trace_file=trace_file)) as bench:
        if isinstance(bench.config.spindle, GrblSpindleTable):
            # One wire: the reset that stops the motion stops the drill.
            ways = {"motion": _stop_motion}
        stops: dict[str, Future[None]] = {}
        with ThreadPoolExecutor(len(ways)) as threads:
            locks = {name: lock for name, lock in _lock_names(bench.config).items() if name in ways}
            for name in _as_they_become_free(locks, bench.clock):
                stops[name] = threads.submit(ways[name], bench)
            for name in ways:
                try:
                    stops[name].result()
                    click.echo(f"{name}: stopped" if len(ways) > 1 else f"{name} and spindle: stopped")
                except MillError as error:
                    failures.append(f"{name}: {error}")
    if failures:
        raise DeviceError("; ".join(failures) + "; switch the machine off at its emergency stop")


def _stop_motion(bench: Rig) -> None:
    with bench.open_motion() as motion:
        motion.halt()


def _stop_spindle(bench: Rig) -> None:
    with bench.open_spindle() as spindle:
        spindle.stop()
        spindle.wait_until_at_speed(timeout_s=5.0)


def _lock_names(config: RigConfig) -> dict[str, str | None]:
    """What the lock of each device is called: a port, or a network interface; None where a third party knows."""
    motion, spindle = config.motion.model_dump(), config.spindle.model_dump()
    if motion["backend"] == "bcap":
        motion["port"] = udp_device(motion["host"], motion["port"])
    if spindle.get("interface") == "socketcan":
        spindle["channel"] = can_device(spindle["channel"])
    tables = {"motion": motion, "spindle": spindle}
    return {name: table.get("port") or table.get("channel") for name, table in tables.items()}


def _as_they_become_free(locks: Mapping[str, str | None], clock: Clock) -> Iterator[str]:
    """End who owns the devices; name each device as soon as nobody does, and at last those that stay owned.

    An owner is asked once, however many of the devices it has: asked again, it would break off its own stopping.
    """
    waiting = list(locks)
    for number, words, limit_s in (
        (signal.SIGTERM, "asking pid {} to lift and stop", LIFT_S),
        (signal.SIGKILL, "pid {} does not end: killing it", KILL_S),
    ):
        for pid in sorted({pid for name in waiting if (pid := _owner(locks[name]))}):
            click.echo(words.format(pid))
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, number)
        deadline_s = clock.now_s() + limit_s
        while waiting and clock.now_s() < deadline_s:
            free = [name for name in waiting if _owner(locks[name]) is None]
            waiting = [name for name in waiting if name not in free]
            yield from free
            if waiting:
                clock.sleep_s(0.02)
    yield from waiting


def _owner(lock: str | None) -> int | None:
    found = re.match(r"pid (\d+)", owner_of(lock) or "") if lock else None
    return int(found[1]) if found else None
