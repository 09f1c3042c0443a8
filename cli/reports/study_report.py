"""One study as one page: its figures drawn with their intervals, then as tables beside the paper's."""

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

from cli.reports.chart import Chart, Tick
from cli.reports.template import filled
from studies.tables import PUBLISHED, Figures, tables

DRAWN = {
    "calibration": ("rmse_mm", "rmse_center_mm", "rmse_periphery_mm", "tip_rmse_px"),
    "surface": ("height_rmse_mm", "normal_rmse_deg", "bregma_rmse_px", "lambda_rmse_px"),
    "milling": ("success_rate", "damage_rate", "milling_time_min", "heat_rise_c"),
    "completion": ("mape", "penetration_recall", "upper_bound_coverage", "ap50_95"),
}
"""What is drawn of each experiment; the rest stands in the tables."""
COLORS = ("one", "two", "three")
"""Of the recipes, as the stylesheet names them."""
NARROW, WIDE, MOST_BESIDE = 520.0, 1080.0, 5
"""Widths of a chart; with more columns it is a wide one."""
ASIDE, ROOM = 0.2, 0.08
"""Between recipes in one column, as a share of it; above and below the data, as a share of their range."""


def write_study_report(
    path: Path,
    name: str,
    recipes: Mapping[str, Mapping[str, Any]],
    published: Mapping[str, float],
    trials: Mapping[str, Mapping[str, Any]],
) -> None:
    """Write a self-contained page to ``path``."""
    page = filled(
        "study_report.html",
        name=name,
        count=len(trials),
        heading=PUBLISHED,
        tables=tables(name, recipes, published),
        panels=_panels(name, recipes, published, trials),
        recipes=list(zip(recipes, cycle(COLORS))),
    )
    path.write_text(page, encoding="utf-8")


def _panels(
    name: str,
    recipes: Mapping[str, Mapping[str, Any]],
    published: Mapping[str, float],
    trials: Mapping[str, Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Every figure with its interval, and each trial as a dot where a trial has it."""
    series = _series(recipes)
    drawn = [figure for figure in DRAWN[name] if any(_values(columns, figure) for columns in series.values())]
    return [_panel(figure, series, published.get(figure), trials) for figure in drawn]


def _panel(
    figure: str,
    series: Mapping[str, Mapping[str, Figures]],
    paper: float | None,
    trials: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    names = list(dict.fromkeys(column for columns in series.values() for column in columns))
    dots = [
        (str(t["recipe"]), float(t[figure])) for t in trials.values() if t.get(figure) is not None and "recipe" in t
    ]
    marks = []
    for index, (recipe, columns) in enumerate(series.items()):
        # Recipes stand beside each other where they share columns.
        aside = 0.0 if len(columns) == 1 else ASIDE * (index - (len(series) - 1) / 2)
        for column, value in _values(columns, figure).items():
            low, high = (float(columns[column].get(figure + end, value)) for end in ("_low", "_high"))
            marks.append((recipe, column, names.index(column) + aside, low, value, high, COLORS[index % len(COLORS)]))
    seen = [value for _, value in dots] + [value for mark in marks for value in mark[3:6]]
    low, high = (pick([*seen, *([] if paper is None else [paper])]) for pick in (min, max))
    room = ROOM * ((high - low) or abs(high) or 1.0)
    wide = len(names) > MOST_BESIDE
    ends = (-0.5, len(names) - 0.5), (low - room, high + room)
    chart = Chart(*ends, width=WIDE if wide else NARROW, height=300.0, named=True)
    return {
        "title": figure,
        "chart": chart,
        "wide": wide,
        "names": [Tick(chart.at(index, low)[0], column) for index, column in enumerate(names)],
        "paper": None if paper is None else chart.at(0.0, paper)[1],
        "dots": [chart.at(names.index(recipe), value) for recipe, value in dots if recipe in names],
        "marks": [
            {
                "x": chart.at(x, value)[0],
                "y": chart.at(x, value)[1],
                "low": chart.at(x, low)[1],
                "high": chart.at(x, high)[1],
                "color": color,
                "title": f"{recipe}, {column}: {value:.4g} ({low:.3g} to {high:.3g})",
            }
            for recipe, column, x, low, value, high, color in marks
        ],
    }


def _series(recipes: Mapping[str, Figures]) -> dict[str, dict[str, Figures]]:
    """What has one colour, and its columns: each recipe, over the shifts where there are any."""
    return {
        recipe: {"clean": figures, **figures["shifts"]} if "shifts" in figures else {recipe: figures}
        for recipe, figures in recipes.items()
    }


def _values(columns: Mapping[str, Figures], figure: str) -> dict[str, float]:
    return {column: figures[figure] for column, figures in columns.items() if figures.get(figure) is not None}
