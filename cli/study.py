"""What a run belongs to in a lab's study: specimen, protocol and operator, from the command line or the rig file."""

from collections.abc import Callable, Mapping
from functools import wraps
from typing import TYPE_CHECKING, Any

import click

from cli.config import StudyTable, study_word
from drivers.errors import ConfigError

if TYPE_CHECKING:
    from milling.record import Run

IDS = tuple(StudyTable.model_fields)


def _word(_context: click.Context, _parameter: click.Parameter, text: str | None) -> str | None:
    if text is None:
        return None
    try:
        return study_word(text)
    except ValueError as error:
        raise click.BadParameter(f"found {text!r}, {error}") from error


_options = (
    click.option("--specimen-id", callback=_word, metavar="ID", help="Whose skull it is, for the record."),
    click.option("--protocol", callback=_word, metavar="ID", help="Protocol of the study, for the record."),
    click.option("--operator", callback=_word, metavar="ID", help="Who mills, for the record."),
)


def study_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options; the command's argument ``study`` is a dict of those that were given."""

    @wraps(command)
    def with_study(*words: object, **others: Any) -> None:
        told = {name: others.pop(name) for name in IDS}
        command(*words, study={name: value for name, value in told.items() if value is not None}, **others)

    decorated: Callable[..., None] = with_study
    for option in reversed(_options):
        decorated = option(decorated)
    return decorated


def study_of(told: Mapping[str, str], rig: StudyTable, resumed: "Run | None" = None) -> dict[str, str]:
    """The ids for the header: the command line's, else the resumed record's, else the rig file's; only those known.

    Raises:
        ConfigError: the window to go on with lies in another specimen.
    """
    before = {} if resumed is None else study_told(resumed)
    ids = {**rig.model_dump(exclude_none=True), **told}
    here, there = ids.get("specimen_id"), before.get("specimen_id")
    if resumed is not None and here and there and here != there:
        raise ConfigError(
            f"{resumed.folder}: was milled in specimen {there!r}, and {here!r} is named; resume the run of this "
            "specimen, or correct --specimen-id or [study] in the rig file"
        )
    return {**rig.model_dump(exclude_none=True), **before, **told}


def study_told(run: "Run") -> dict[str, str]:
    """The ids in a record's header."""
    study = run.header.get("study")
    return {name: str(study[name]) for name in IDS if study.get(name)} if isinstance(study, dict) else {}
