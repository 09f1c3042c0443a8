"""`mill live`: a recorded run in the browser; and the page of a run that goes on, for the commands that mill."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.runs import folder_option, located

if TYPE_CHECKING:
    from rich.console import Console

    from calib.calibration_file import Calibration
    from drivers.clock import Clock
    from drivers.recorder import Recorder
    from live.page import Page
    from milling.guard import Guard

live_option = click.option(
    "--live", is_flag=True, help="Show the run in a browser, with a button that stops the machine."
)


@click.command()
@click.argument("run_folder", metavar="RUN", type=click.Path(path_type=Path))
@folder_option
def live(run_folder: Path, folder: Path) -> None:
    """Play a recorded run in the browser: pictures, ring, curves and reasons, with a time slider.

    Prints a link for a browser on this computer; Ctrl-C ends it. `mill run --live` shows a run while it goes on.
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
    calibration: "Calibration",
    guard: "Guard | None",
    clock: "Clock",
) -> "Recorder":
    """The recorder, shown on the page, whose button reaches the supervisor from now on; itself without a page."""
    if page is None:
        return recorder
    from live.page import Shown

    page.header(title=folder.name, calibration=str((folder / "calibration.toml").resolve()))
    if guard is not None:
        page.hand_over_stop(guard.stop_end)
    return Shown(recorder, page, clock, calibration)


@contextmanager
def page_for(wanted: bool, console: "Console") -> "Iterator[Page | None]":
    """The page of this command's run, told on the terminal; None where nobody asked for one."""
    if not wanted:
        yield None
        return
    from live.page import Page

    def lost(words: str) -> None:
        console.print(words, highlight=False, soft_wrap=True)

    with Page(on_loss=lost) as page:
        console.print(f"open {page.address}", highlight=False, soft_wrap=True)
        yield page
