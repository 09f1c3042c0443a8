"""`mill emulate`: a virtual bench on real wires, for the other commands in another terminal."""

import os
import select
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.options import fault_option, motion_option, seed_option, specimen_option
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.recorder import Recorder
    from firmware_sim.bench import Dialect, MotionMake, SpindleMake
    from firmware_sim.faults import Fault
    from firmware_sim.serve import BenchService, ServiceStatus
    from milling.eyes import CompletionReader


@click.command()
@specimen_option
@seed_option
@fault_option
@click.option(
    "--rig-out",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write the rig file here; without it, it is printed.",
)
@motion_option
@click.option(
    "--dialect",
    type=click.Choice(["gnea", "grblhal"]),
    default="gnea",
    show_default=True,
    help="Firmware of a GRBL board.",
)
@click.option(
    "--spindle",
    type=click.Choice(["cia402", "modbus", "grbl"]),
    default="cia402",
    show_default=True,
    help="What turns the drill: a drive on CAN, an inverter on Modbus, or the motion board.",
)
@click.option(
    "--fps", type=click.FloatRange(1.0, 60.0), default=20.0, show_default=True, help="Pictures per second and eye."
)
@click.option(
    "--truth-out",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Keep the world's truth here as JSON, for scoring.",
)
@click.option("--until-stdin-closes", is_flag=True, help="End with the program that started this one.")
def emulate(
    specimen: Path | None,
    seed: int,
    faults: tuple[str, ...],
    rig_out: Path | None,
    motion: "MotionMake",
    dialect: "Dialect",
    spindle: "SpindleMake",
    fps: float,
    truth_out: Path | None,
    until_stdin_closes: bool,
) -> None:
    """Serve a virtual bench: a motion controller and a spindle on their wires, two cameras over HTTP.

    It prints a rig file that points at them; use it from another terminal. Ctrl-C ends it.
    """
    from firmware_sim.bench import Bench
    from firmware_sim.faults import parse_faults
    from firmware_sim.serve import BenchService, write_atomically
    from firmware_sim.specimen import specimen_for

    for path in (rig_out, truth_out):
        if path is not None and not path.parent.is_dir():
            raise ConfigError(f"{path}: no folder {path.parent}; make it, or name another file")
    if motion != "grbl" and dialect != "gnea":
        raise ConfigError(f"--dialect {dialect} belongs to --motion grbl; leave it out with --motion {motion}")
    planted = parse_faults(faults)
    if host := [str(fault) for fault in planted if fault.kind.place == "host"]:
        raise ConfigError(f"fault {', '.join(host)}: not of the bench; give it to `mill run --emulate --fault`")
    drawn = specimen_for(seed, specimen)
    if sys.stderr.isatty():
        click.echo("Preparing the bench...", err=True)
    bench = Bench(drawn, motion=motion, dialect=dialect, spindle=spindle, faults=planted)
    with _stop_signals() as stopped, BenchService(bench, fps=fps) as service:
        name = ", ".join([f"virtual bench, seed {seed}", *([specimen.name] if specimen else []), *map(str, planted)])
        text = rig_text(service, name)
        if rig_out is None:
            click.echo(text)
            click.echo("Save this as rig.toml (or use --rig-out rig.toml), then in another terminal: ", nl=False)
        else:
            write_atomically(rig_out, text)
            click.echo(f"{rig_out} is written. In another terminal: ", nl=False)
        click.echo(f"mill doctor --rig {rig_out or 'rig.toml'}")
        click.echo("Ctrl-C ends the bench.")
        show = sys.stdout.isatty()

        def ended() -> bool:
            return stopped() or (until_stdin_closes and _stdin_closed())

        service.run(ended, on_status=_show if show else None, truth_file=truth_out)
        if show:
            click.echo()


def sorted_faults(texts: Iterable[str]) -> "tuple[tuple[Fault, ...], tuple[Fault, ...]]":
    """The faults of the bench, and those of the program that uses it.

    Raises:
        ConfigError: one of them is not known; the message says which there are.
    """
    from firmware_sim.faults import parse_faults

    return parse_faults(texts, place="bench"), parse_faults(texts, place="host")


def spoiled(reader: "CompletionReader", faults: "Sequence[Fault]", clock: "Clock", *, seed: int) -> "CompletionReader":
    """The reader behind the faults of its family; itself where there are none."""
    from firmware_sim.faulty_reader import FaultyReader

    return FaultyReader(reader, faults, clock, seed=seed) if faults else reader


def recorded(recorder: "Recorder", faults: "Sequence[Fault]", clock: "Clock") -> "Recorder":
    """The recorder behind the faults of its disk; itself where there are none."""
    from firmware_sim.faulty_disk import FaultyDisk

    return FaultyDisk(recorder, faults, clock) if faults else recorder


def hogged(faults: "Sequence[Fault]") -> "AbstractContextManager[object]":
    """Other programs that want every core, where that is planted."""
    from firmware_sim.hogs import hogs

    return hogs(faults)


def rig_text(service: "BenchService", name: str) -> str:
    """The rig file of a served bench."""
    from firmware_sim.bench import PARK_MM
    from firmware_sim.optics import HEIGHT_PX, WIDTH_PX

    left, right = service.camera_urls
    tool = service.bench.specimen.tool
    motion = _robot_table(service) if service.bench.motion == "bcap" else _serial_table(service)
    return f"""\
# A virtual bench. It lives as long as its `mill emulate`.
schema = 1
name = "{name}"

{motion}
{_spindle_text(service)}

[camera]
backend = "opencv"
left = "{left}"
right = "{right}"
size_px = [{WIDTH_PX}, {HEIGHT_PX}]
fps = {service.fps:g}
max_skew_s = 0.02

[tool]
ball_radius_mm = {tool.ball_radius_mm:g}
axis = {_vector(tool.axis)}    # from the tip up the shank, in {{R}}

[bench]
park_mm = {_vector(PARK_MM)}        # where the drill is out of both pictures

[certificate]
required = false                   # a rig of devices needs one by `mill doctor`
"""


def _serial_table(service: "BenchService") -> str:
    from firmware_sim.bench import MAX_FEED_MM_S, ORIGIN_MM

    settings = "\n".join(f'"{key}" = {value:g}' for key, value in service.bench.motion_settings.items())
    return f"""\
[motion]
backend = "{service.bench.motion}"
port = "{service.motion_port}"
baud = 115200
origin_mm = {_vector(ORIGIN_MM)}      # machine position of the origin of {{R}}
max_feed_mm_s = {MAX_FEED_MM_S:g}
firmware = "{service.bench.motion_firmware}"

[motion.settings]                  # must read back like this
{settings}
"""


def _robot_table(service: "BenchService") -> str:
    from firmware_sim import bench

    host, _, port = service.motion_port.partition(":")
    return f"""\
[motion]
backend = "bcap"
host = "{host}"
port = {port}
origin_mm = {_vector(bench.ROBOT_ORIGIN_MM)}    # the origin of {{R}} in the robot's frame
orientation_deg = {_vector(bench.ROBOT_ORIENTATION_DEG)}  # of the tool, in every move
travel_low_mm = {_vector(bench.ROBOT_TRAVEL_LOW_MM)}  # in {{R}}; the controller has no limits of its own there
travel_high_mm = {_vector(bench.ROBOT_TRAVEL_HIGH_MM)}
max_feed_mm_s = {bench.MAX_FEED_MM_S:g}
"""


def _spindle_text(service: "BenchService") -> str:
    from firmware_sim.bench import MAX_SPEED_RPM, NODE_ID
    from firmware_sim.modbus_drive import BAUD, POLES, RATED_CURRENT_A

    own = {
        "cia402": f"""\
interface = "slcan"
channel = "{service.spindle_port}"
bitrate = {service.bench.can.bit_rate}
node_id = {NODE_ID}""",
        "modbus": f"""\
port = "{service.spindle_port}"
baud = {BAUD}
rated_current_a = {RATED_CURRENT_A:g}
poles = {POLES}
frequency_decimals = 1
heartbeat_s = 0.5""",
        "grbl": "run_up_s = 1.0",
    }[service.bench.spindle]
    speeds = f"speed_rpm = 45000\nmax_speed_rpm = {MAX_SPEED_RPM}"
    return f'[spindle]\nbackend = "{service.bench.spindle}"\n{own}\n{speeds}'


def _vector(values: tuple[float, float, float]) -> str:
    return f"[{', '.join(f'{float(value):.6g}' for value in values)}]"


def _show(status: "ServiceStatus") -> None:
    x, y, z = status.tip_mm
    depth = f"  depth {1000 * status.depth_mm:4.0f} um" if status.depth_mm > 0 else ""
    late = f"  {status.skipped_s:.1f} s left out" if status.skipped_s >= 0.1 else ""
    click.echo(
        f"\r\x1b[K{status.time_s:7.1f} s  {status.motion:5}  tip {x:7.3f} {y:7.3f} {z:7.3f} mm"
        f"  spindle {status.spindle_rpm:6.0f} rpm{depth}{late}",
        nl=False,
    )


@contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """Whether SIGINT or SIGTERM has come."""
    seen: list[int] = []
    old = {number: signal.signal(number, lambda n, _: seen.append(n)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


def _stdin_closed() -> bool:
    readable, _, _ = select.select([sys.stdin], [], [], 0)
    return bool(readable) and os.read(sys.stdin.fileno(), 4096) == b""
