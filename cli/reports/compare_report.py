"""Two runs as one page: their rings beside each other, every point's depth and contact laid over one another."""

from typing import TYPE_CHECKING, Any

from cli.compare import Comparison, beside
from cli.reports.chart import axes
from cli.reports.run_report import page
from cli.reports.template import filled
from cli.run_table import Row, Told

if TYPE_CHECKING:
    from collections.abc import Sequence

COLORS = ("var(--a)", "var(--b)")
"""Of A and B; their marks also differ in shape."""


def render(a: Told, b: Told, comparison: Comparison) -> str:
    """The page, self-contained."""
    charts = [
        _overlaid("Depth below contact", "mm", "depth_mm", (a.points, b.points)),
        _overlaid("Contact", "mm, height in {R}", "contact_z_mm", (a.points, b.points)),
        _overlaid("Completion, as the eyes read it", "0 to 1", "completion", (a.points, b.points)),
    ]
    return filled(
        "compare_report.html",
        names=(a.run.folder.name, b.run.folder.name),
        colors=COLORS,
        headers=(a.run.header, b.run.header),
        pictures=(page(a.run)["picture"], page(b.run)["picture"]),
        charts=[chart for chart in charts if chart],
        comparison=comparison,
        points=beside(a, b),
    )


def _overlaid(title: str, unit: str, key: str, runs: "Sequence[list[Row]]") -> dict[str, Any] | None:
    """One figure of every point over its angle; None where neither run knows it."""
    known = [
        [
            (360.0 * number / len(points), point[key])
            for number, point in enumerate(points, 1)
            if point.get(key) is not None
        ]
        for points in runs
    ]
    values = [value for series in known for _, value in series]
    if not values:
        return None
    low, high = min([*values, 0.0] if min(values) >= 0 else values), max(values)
    place, across, up = axes(0.0, 360.0, low, high + 0.05 * max(high - low, 1e-3), "°")
    series = [
        {"color": color, "shape": shape, "places": [place(angle, value) for angle, value in found]}
        for found, color, shape in zip(known, COLORS, ("circle", "square"), strict=True)
    ]
    return {"title": title, "unit": unit, "series": series, "across": across, "up": up}
