"""One study as one page: its figures drawn with their intervals, then as tables beside the paper's."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from studies.tables import PUBLISHED, tables

TEMPLATE = Path(__file__).with_name("study_report.html")
DRAWN = {
    "calibration": ("rmse_mm", "rmse_center_mm", "rmse_periphery_mm", "tip_rmse_px"),
    "surface": ("height_rmse_mm", "normal_rmse_deg", "bregma_rmse_px", "lambda_rmse_px"),
    "completion": ("mape", "penetration_recall", "upper_bound_coverage", "ap50_95"),
}
"""What is drawn of each experiment; the rest stands in the tables."""


def write_study_report(
    path: Path,
    name: str,
    recipes: Mapping[str, Mapping[str, Any]],
    published: Mapping[str, float],
    trials: Mapping[str, Mapping[str, Any]],
) -> None:
    """Write a self-contained page to ``path``."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
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

    columns: dict[str, Mapping[str, Any]] = dict(recipes)
    for recipe, figures in recipes.items():
        columns |= {f"{recipe}, {shift}": of_shift for shift, of_shift in figures.get("shifts", {}).items()}
    drawn = [figure for figure in DRAWN[name] if any(figures.get(figure) is not None for figures in columns.values())]
    if not drawn:
        return "<p>No trial gave a figure.</p>"
    picture = make_subplots(rows=(len(drawn) + 1) // 2, cols=2, subplot_titles=drawn)
    for index, figure in enumerate(drawn):
        at = {"row": index // 2 + 1, "col": index % 2 + 1}
        shown = {column: figures for column, figures in columns.items() if figures.get(figure) is not None}
        values = [figures[figure] for figures in shown.values()]
        above = [
            figures.get(f"{figure}_high", value) - value for figures, value in zip(shown.values(), values, strict=True)
        ]
        below = [
            value - figures.get(f"{figure}_low", value) for figures, value in zip(shown.values(), values, strict=True)
        ]
        interval = {"type": "data", "symmetric": False, "array": above, "arrayminus": below, "thickness": 2, "width": 8}
        mark = {"size": 11, "color": "#2563a8"}
        picture.add_trace(go.Scatter(x=list(shown), y=values, error_y=interval, mode="markers", marker=mark), **at)
        dots = [(t["recipe"], t[figure]) for t in trials.values() if t.get(figure) is not None and "recipe" in t]
        if dots:
            where, what = zip(*dots, strict=True)
            faint = {"size": 5, "color": "#8a8f99", "opacity": 0.6}
            picture.add_trace(go.Scatter(x=where, y=what, mode="markers", marker=faint), **at)
        if figure in published:
            picture.add_hline(
                y=published[figure], line_dash="dash", line_color="#b3262e", annotation_text=PUBLISHED, **at
            )
    picture.update_layout(
        height=340 * ((len(drawn) + 1) // 2), showlegend=False, template="plotly_white", margin={"t": 40, "b": 20}
    )
    return str(picture.to_html(full_html=False, include_plotlyjs="inline", config={"displayModeBar": False}))
