"""`mill runs compare`: two runs beside each other, on the terminal and as a page."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import click

from cli.output import columns, write_json
from cli.run_table import RUN_COLUMNS, Row, Told, run_row
from drivers.errors import ConfigError

NOT_COMPARED = ("run", "record", "date_utc", "command", "resumes", "seed", "events", "events_head", "ring_center_mm")
"""Columns that tell runs apart, not how they went."""
SET_UP = (
    "specimen_id", "protocol", "operator", "rig", "faults_planted", "job_", "mill_version", "weights_", "calibration_",
    "device_", "camera_",
)  # fmt: skip
"""How columns begin that tell what was given; the others tell what came of it."""
SHORT_DIGITS = 12
WIDEST = 26
"""Letters in a column of the terminal."""


@dataclass(frozen=True)
class Difference:
    """One column, as it is shown."""

    what: str
    a: str
    b: str

    @property
    def differs(self) -> bool:
        """Whether the runs do, there."""
        return self.a != self.b


@dataclass(frozen=True)
class Decisions:
    """How often a bite was asked for and answered with these words; none is "granted"."""

    answer: str
    a: int
    b: int


@dataclass(frozen=True)
class Comparison:
    """Two runs, column by column."""

    set_up: list[Difference]
    """What they were given, as far as it differs."""
    outcome: list[Difference]
    """What came of it, all that either knows."""
    decisions: list[Decisions]


def compared(a: Told, b: Told) -> Comparison:
    """Lay them beside each other."""
    one, other = run_row(a), run_row(b)
    names = [*RUN_COLUMNS, *sorted({name for row in (one, other) for name in row} - set(RUN_COLUMNS))]
    found = [Difference(name, *_shown(name, one, other)) for name in names if name not in NOT_COMPARED]
    set_up = [each for each in found if each.what.startswith(SET_UP) and not each.what.startswith("calibration_check")]
    answers = [_answers(told) for told in (a, b)]
    words = sorted({*answers[0], *answers[1]}, key=lambda word: -answers[0].get(word, 0) - answers[1].get(word, 0))
    return Comparison(
        [each for each in set_up if each.differs],
        [each for each in found if each not in set_up and (each.a or each.b)],
        [Decisions(word or "granted", answers[0].get(word, 0), answers[1].get(word, 0)) for word in words],
    )


def compare_runs(a: Path, b: Path, out: Path | None, json_file: Path | None) -> None:
    """Write the page, and tell.

    Raises:
        ConfigError: a record that cannot be read, or a file that cannot be written.
    """
    from cli.reports.compare_report import render

    told = (Told.of_folder(a), Told.of_folder(b))
    comparison = compared(*told)
    out = out or Path(f"compare-{a.name}-{b.name}.html")
    try:
        out.write_text(render(*told, comparison), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); name another --out file") from error
    if json_file:
        write_json(json_file, "runs compare", seed=None, a=str(a), b=str(b), page=str(out), **asdict(comparison))
        if str(json_file) == "-":
            return
    for line in _lines(a.name, b.name, comparison):
        click.echo(line)
    click.echo(f"\npage: {out}")


def _lines(a: str, b: str, comparison: Comparison) -> Iterator[str]:
    yield "What they were given" if comparison.set_up else "They were given the same."
    if comparison.set_up:
        yield from _table(a, b, comparison.set_up)
    yield ""
    yield "What came of it (* differs)"
    marked = [replace(each, what=("* " if each.differs else "  ") + each.what) for each in comparison.outcome]
    yield from _table(a, b, marked)
    if comparison.decisions:
        yield ""
        yield "Bites asked for, by the answer"
        yield from columns(("", a, b), [(each.answer, str(each.a), str(each.b)) for each in comparison.decisions])


def _table(a: str, b: str, found: list[Difference]) -> Iterator[str]:
    """Columns; words that are too long for one stand below, and are not cut."""
    short = [each for each in found if max(len(each.a), len(each.b)) <= WIDEST]
    yield from columns(("", a, b), [(each.what, each.a, each.b) for each in short])
    for each in found:
        if each not in short:
            yield from (each.what, f"    {a}: {each.a or '-'}", f"    {b}: {each.b or '-'}")


def _shown(name: str, a: Row, b: Row) -> tuple[str, str]:
    texts = [_text(row.get(name)) for row in (a, b)]
    if name.endswith("sha256") and texts[0][:SHORT_DIGITS] != texts[1][:SHORT_DIGITS]:
        texts = [text[:SHORT_DIGITS] for text in texts]
    return texts[0], texts[1]


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return " ".join(_text(part) for part in value)
    return str(value)


def _answers(told: Told) -> Mapping[str, int]:
    counted: dict[str, int] = {}
    for event in told.of("asked"):
        counted[event["reason"]] = counted.get(event["reason"], 0) + 1
    return counted


def beside(a: Told, b: Told) -> list[tuple[Row, Row]]:
    """The points of two rings of as many points, pair by pair; none where they have not as many."""
    if len(a.points) != len(b.points):
        return []
    return list(zip_longest(a.points, b.points, fillvalue={}))
