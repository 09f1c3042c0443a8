"""One study as one page: its figures drawn with their intervals, then as tables beside the paper's."""

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

from cli.reports.template import filled
from studies.tables import PUBLISHED, Figures, tables

DRAWN = {
    "calibration": ("rmse_mm", "rmse_center_mm", "rmse_periphery_mm", "tip_rmse_px"),
    "surface": ("height_rmse_mm", "normal_rmse_deg", "bregma_rmse_px", "lambda_rmse_px"),
    "milling": ("success_rate", "damage_rate", "milling_time_min", "heat_rise_c"),
    "completion": ("mape", "penetration_recall", "upper_bound_coverage", "ap50_95"),
}
"""What is drawn of each experiment; the rest stands in the tables."""
COLORS = ("#2563a8", "#c2410c", "#0f766e")
FAINT = {"size": 5, "color": "#8a8f99", "opacity": 0.6}


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
        drawing=_drawing(name, recipes, published, trials),
    )
    path.write_text(page, encoding="utf-8")


def _drawing(
    name: str,
    recipes: Mapping[str, Mapping[str, Any]],
    published: Mapping[str, float],
    trials: Mapping[str, Mapping[str, Any]],
) -> str:
    """Every figure with its interval, and each trial as a dot where a trial has it; as HTML that needs no network."""
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    series = _series(recipes)
    drawn = [figure for figure in DRAWN[name] if any(_values(columns, figure) for columns in series.values())]
    if not drawn:
        return "<p>No trial gave a figure.</p>"
    picture = make_subplots(rows=(len(drawn) + 1) // 2, cols=2, subplot_titles=drawn, vertical_spacing=0.16)
    for index, figure in enumerate(drawn):
        at = {"row": index // 2 + 1, "col": index % 2 + 1}
        dots = [(t["recipe"], t[figure]) for t in trials.values() if t.get(figure) is not None and "recipe" in t]
        if dots:
            where, what = zip(*dots, strict=True)
            picture.add_trace(go.Scatter(x=where, y=what, mode="markers", marker=FAINT, showlegend=False), **at)
        for (recipe, columns), color in zip(series.items(), cycle(COLORS)):
            values = _values(columns, figure)
            low, high = ([columns[c].get(figure + end, v) for c, v in values.items()] for end in ("_low", "_high"))
            middle = list(values.values())
            interval = {
                "type": "data",
                "symmetric": False,
                "array": [top - value for top, value in zip(high, middle, strict=True)],
                "arrayminus": [value - bottom for bottom, value in zip(low, middle, strict=True)],
            }
            mark = {"size": 11, "color": color}
            picture.add_trace(
                go.Scatter(
                    x=list(values), y=middle, error_y=interval, mode="markers", marker=mark, name=recipe,
                    legendgroup=recipe, showlegend=index == 0,
                ),
                **at,
            )  # fmt: skip
        if figure in published:
            picture.add_hline(
                y=published[figure], line_dash="dash", line_color="#b3262e", annotation_text=PUBLISHED, **at
            )
    height = 400 * ((len(drawn) + 1) // 2)
    # Recipes stand beside each other where they share columns.
    mode = "group" if any(len(columns) > 1 for columns in series.values()) else "overlay"
    picture.update_layout(height=height, template="plotly_white", margin={"t": 40, "b": 20}, scattermode=mode)
    return str(picture.to_html(full_html=False, include_plotlyjs="inline", config={"displayModeBar": False}))


def _series(recipes: Mapping[str, Figures]) -> dict[str, dict[str, Figures]]:
    """What has one colour, and its columns: each recipe, over the shifts where there are any."""
    return {
        recipe: {"clean": figures, **figures["shifts"]} if "shifts" in figures else {recipe: figures}
        for recipe, figures in recipes.items()
    }


def _values(columns: Mapping[str, Figures], figure: str) -> dict[str, float]:
    return {column: figures[figure] for column, figures in columns.items() if figures.get(figure) is not None}
