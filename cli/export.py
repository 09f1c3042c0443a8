"""`mill runs export`: runs, or their points, as a CSV file for statistics."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from cli.run_table import POINT_COLUMNS, RUN_COLUMNS, Row, Told, damaged_row, label_columns, point_rows, run_row
from drivers.errors import ConfigError


def export_runs(folders: Sequence[Path], csv_file: Path, *, points: bool) -> None:
    """Write one row a run, or one a point; a run that cannot be read is a row that says so, and no points.

    Raises:
        ConfigError: the file cannot be written.
    """
    rows: list[Row] = []
    for folder in folders:
        try:
            told = Told.of_folder(folder)
        except ConfigError as error:
            click.echo(f"mill: left out: {error}" if points else f"mill: damaged: {error}", err=True)
            rows += [] if points else [damaged_row(folder, error)]
        else:
            rows += point_rows(told) if points else [run_row(told)]
    columns = list(POINT_COLUMNS) if points else [*RUN_COLUMNS, *label_columns(rows)]
    text = _csv(columns, rows)
    if str(csv_file) == "-":
        click.echo(text, nl=False)
        return
    try:
        # RFC 4180 ends lines with CR LF.
        csv_file.write_text(text, encoding="utf-8", newline="")
    except OSError as error:
        raise ConfigError(f"{csv_file}: cannot write the table: {error.strerror}; name another --csv file") from None
    of = "point" if points else "run"
    click.echo(f"{csv_file}: {len(rows)} row{'s' if len(rows) != 1 else ''}, one a {of}, {len(columns)} columns")


def _csv(columns: Sequence[str], rows: Sequence[Row]) -> str:
    file = io.StringIO()
    writer = csv.writer(file)
    writer.writerow(columns)
    writer.writerows([_cell(row.get(column)) for column in columns] for row in rows)
    return file.getvalue()


def _cell(value: Any) -> Any:
    """Empty where nothing is known; what has several parts is separated by spaces."""
    if isinstance(value, list | tuple):
        return " ".join(str(part) for part in value)
    return value
