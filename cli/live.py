"""`mill live`: a recorded run in the browser; and the page of a command that goes on."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.output import for_people
from cli.runs import folder_option, located
from drivers.errors import MillError

if TYPE_CHECKING:
    from rich.console import Console

    from calib.calibration_file import Calibration
    from drivers.clock import Clock
    from drivers.motion.interface import MotionController
    from drivers.recorder import Recorder
    from live.page import Page
    from milling.guard import Guard

live_option = click.option("--live", is_flag=True, help="Show it in a browser, with a button that stops the machine.")


@click.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@folder_option
def live(run_folder: Path, folder: Path) -> None:
    """Play a recorded run in the browser: pictures, ring, curves and reasons, with a time slider.

    Prints a link for a browser on this computer; Ctrl-C ends it. With --live, `mill run`, `mill resume`,
    `mill calibrate` and `mill doctor` show what they do while they do it.
    """
    from live.page import require_installed

    require_installed()
    from live.player import Player
    from live.theatre import play
    from milling.record import read_run

    player = Player(read_run(located(run_folder, folder)))
    play(player, lambda address: click.echo(f"open {address}\nCtrl-C ends it."))


def shown(
    recorder: "Recorder",
    page: "Page | None",
    folder: Path,
    command: str,
    calibration: "Calibration",
    guard: "Guard | None",
    clock: "Clock",
) -> "Recorder":
    """The recorder, shown on the page, whose button reaches the supervisor from now on; itself without a page."""
    if page is None:
        return recorder
    from live.page import Shown

    page.header(title=folder.name, command=command, calibration=str((folder / "calibration.toml").resolve()))
    if guard is not None:
        page.hand_over_stop(guard.stop_end)
    return Shown(recorder, page, clock, calibration)


@contextmanager
def shown_in_the_air(
    recorder: "Recorder", page: "Page | None", title: str, command: str, clock: "Clock"
) -> "Iterator[Recorder]":
    """The recorder of a command that cuts nothing, shown on the page, which is told how it ended where that is ill."""
    if page is None:
        yield recorder
        return
    from live.page import Shown

    page.header(title=title, command=command)
    told = Shown(recorder, page, clock, None)
    try:
        yield told
    except KeyboardInterrupt:
        told.event("outcome", outcome="interrupted", reason="stopped by a person")
        raise
    except MillError as error:
        told.event("outcome", outcome="failed", reason=for_people(error))
        raise


@contextmanager
def stoppable(motion: "MotionController", page: "Page | None", clock: "Clock") -> "Iterator[MotionController]":
    """The same controller, in free air, with a supervisor that the page's button reaches.

    Without a page, or where no supervisor can reach the wire, the controller itself: the page interrupts the command.

    Raises:
        SafetyStop: it was stopped after the last call.
    """
    path = motion.stop_path
    if page is None or path is None:
        yield motion
        return
    from milling.guard import Guard
    from milling.guarded_motion import GuardedMotion

    with Guard(path, clock) as guard:
        page.hand_over_stop(guard.stop_end)
        guarded = GuardedMotion(motion, guard)
        yield guarded
    guarded.require_unstopped()


@contextmanager
def page_for(wanted: bool, console: "Console") -> "Iterator[Page | None]":
    """The page of this command, told on the terminal; None where nobody asked for one."""
    if not wanted:
        yield None
        return
    from live.page import Page

    def lost(words: str) -> None:
        console.print(words, highlight=False, soft_wrap=True)

    with Page(on_loss=lost) as page:
        console.print(f"open {page.address}", highlight=False, soft_wrap=True)
        yield page
