"""The `mill` command. Each subcommand is loaded only when it is called: `mill --help` imports nothing heavy.

Exit codes: 0 done; 1 ended, but not as asked (run held or aborted, a check or a calibration failed); 2 wrong input,
nothing moved; 3 a device failed; 130 interrupted.
"""

import importlib
import signal
import sys

import click

from cli.output import for_people, one_line
from drivers.errors import ConfigError, DeviceError, MillError

COMMANDS: dict[str, tuple[str, str]] = {
    "emulate": ("cli.emulate", "Serve a virtual bench on real wires, for the other commands to use."),
    "calibrate": ("cli.calibrate", "Calibrate the stereo microscope against the robot."),
    "run": ("cli.run", "Mill one window in a closed loop."),
    "resume": ("cli.resume", "Go on with a window whose run ended too early."),
    "jog": ("cli.jog", "Move the drill by hand, or home it."),
    "stop": ("cli.stop", "Stop motion and spindle of a rig, whoever runs it."),
    "devices": ("cli.devices", "List what is plugged in, ask who it is, write a rig file of it."),
    "doctor": ("cli.doctor", "Open, identify, read back and measure each device of a rig."),
    "annotate": ("cli.annotate", "Label your own pictures in the browser, alone or in twos."),
    "dataset": ("cli.dataset", "Make data sets: rendered, from photographs, or from a rig."),
    "train": ("cli.train", "Train a network on rendered pictures or on your own."),
    "evaluate": ("cli.train", "Measure a network on specimens and rigs it never saw."),
    "experiment": ("cli.experiment", "Repeat the paper's experiments on virtual rigs."),
    "live": ("cli.live", "Play a recorded run in the browser."),
    "runs": ("cli.runs", "List, show, report and replay recorded runs."),
    "metrics": ("cli.metrics", "Serve figures of the newest run to Prometheus."),
    "trace": ("cli.trace", "Show, cut and export what --trace has written."),
    "support-bundle": ("cli.support_bundle", "Pack what a maintainer needs to help, without personal data."),
    "completion": ("cli.completion", "Print the shell's completion script."),
}


class LazyGroup(click.Group):
    """Knows its commands by name and imports one when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The commands in the order of work."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command, or None where there is none of this name."""
        if cmd_name not in COMMANDS:
            return None
        command = getattr(importlib.import_module(COMMANDS[cmd_name][0]), cmd_name.replace("-", "_"))
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="micromill", prog_name="mill")
def mill() -> None:
    """Drive, calibrate and close the loop of a robotic bone micro-mill.

    Research equipment, not a medical device. Try it without any hardware: mill run --emulate
    """


def exit_code(error: MillError) -> int:
    """2 for input that cannot be used, 3 for a device, 1 for the rest."""
    if isinstance(error, ConfigError):
        return 2
    return 3 if isinstance(error, DeviceError) else 1


def main() -> None:
    """Run `mill`; an error of ours is one line and no traceback. SIGTERM is like Ctrl-C: devices are left safe."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        mill.main(args=sys.argv[1:] or ["--help"], prog_name="mill", standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        step = f"; see `{context.command_path} --help`" if context else ""
        click.echo(f"mill: {one_line(error.format_message()).rstrip('.')}{step}", err=True)
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("mill: interrupted", err=True)
        sys.exit(130)
    except MillError as error:
        click.echo(f"mill: {for_people(error)}", err=True)
        sys.exit(exit_code(error))
    except OSError as error:
        # A file's name makes it about a path that a person gave; any other is a fault of ours and keeps its traceback.
        if error.filename is None:
            raise
        click.echo(f"mill: {error.filename}: {error.strerror}; name another place, or make room there", err=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
