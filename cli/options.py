"""Options that several commands share."""

from pathlib import Path

import click

rig_option = click.option(
    "--rig", type=click.Path(path_type=Path), metavar="FILE", help="Rig file: use the devices it names."
)
emulate_option = click.option("--emulate", is_flag=True, help="Use a virtual bench, started for this command.")
specimen_option = click.option(
    "--specimen", type=click.Path(path_type=Path), metavar="FILE", help="Specimen file of the virtual bench."
)
seed_option = click.option(
    "--seed", type=int, default=0, show_default=True, help="Draws specimen and rig of the virtual bench."
)
json_option = click.option(
    "--json",
    "json_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write the results as JSON; - for stdout.",
)
