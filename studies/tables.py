"""An experiment's figures as tables of words, for the terminal, the report and the page of results alike."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

PUBLISHED = "the paper (its own rig or tissue)"
"""Heading of the paper's own figures, which are not simulation."""
BY_SHIFT = (
    "mape", "rmse", "penetration_recall", "penetration_false_alarm", "upper_bound_coverage", "hidden_recall",
    "hidden_recall_by_picture", "visible_withheld", "ap50_95",
)  # fmt: skip
"""What is told of each shift."""
_SUFFIXES = ("_low", "_high")
_NOT_TOLD = ("shifts", "wilson_95")
"""Tables of their own, and what the interval beside a figure says."""

Figures = Mapping[str, Any]


@dataclass(frozen=True)
class Table:
    """Rows of words under headings."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


def tables(name: str, recipes: Mapping[str, Figures], published: Mapping[str, float]) -> list[Table]:
    """The recipes side by side with the paper's own figures; and of each recipe, where there are any, its shifts."""
    result = [_by_recipe(f"{name}, on the virtual bench", recipes, published)]
    for recipe, figures in recipes.items():
        if "shifts" in figures:
            result.append(_by_shift(f"{name}, {recipe}, by shift, on the virtual bench", figures["shifts"]))
    return result


def _by_recipe(title: str, recipes: Mapping[str, Figures], published: Mapping[str, float]) -> Table:
    names = [name for name in dict.fromkeys(key for figures in recipes.values() for key in figures) if _is_told(name)]
    rows = [
        [name, *(with_interval(figures, name) for figures in recipes.values()), _published(published, name)]
        for name in names
    ]
    return Table(title, ["figure", *recipes, PUBLISHED], rows)


def _by_shift(title: str, shifts: Mapping[str, Figures]) -> Table:
    rows = [[shift, *(with_interval(figures, name) for name in BY_SHIFT)] for shift, figures in shifts.items()]
    return Table(title, ["shift", *BY_SHIFT], rows)


def _is_told(name: str) -> bool:
    return not name.endswith(_SUFFIXES) and name not in _NOT_TOLD


def _published(published: Mapping[str, float], name: str) -> str:
    return f"{published[name]:.4g}" if name in published else ""


def with_interval(figures: Figures, name: str) -> str:
    """A figure with its 95 % interval, where it has one."""
    if figures.get(name) is None:
        return "-"
    low, high = (figures.get(name + suffix) for suffix in _SUFFIXES)
    value = f"{figures[name]:.4g}"
    return value if low is None or high is None else f"{value} ({low:.3g} to {high:.3g})"
