"""The ring as characters: a gauge that fills up point by point, readable without colour."""

import math
from collections.abc import Sequence

from rich.text import Text

HEIGHT = 15
WIDTH = 2 * HEIGHT + 1
"""A terminal's cells are about twice as high as wide."""

MARKS = "·░▒▓█"
"""Untouched to almost through, so that the gauge reads in black and white as well."""

DONE = "●"
LEFT_OUT = "?"
COLOURS = ("grey50", "steel_blue1", "sky_blue2", "gold1", "orange1")


def ring_gauge(completion: Sequence[float | None], done: Sequence[bool], lines: Sequence[str] = ()) -> Text:
    """Draw the points as seen from above, image x to the right and image y down.

    Args:
        completion: per point, 0 untouched to 1 through; None where nothing is known.
        done: per point, whether it gets no further bite.
        lines: up to five short lines for the middle.
    """
    cells: dict[tuple[int, int], tuple[str, str]] = {}
    count = len(completion)
    # More cells than points lie on the circle: each shows the point nearest to its angle.
    for step in range(4 * WIDTH):
        angle = 2.0 * math.pi * step / (4 * WIDTH)
        # theta_i = 2 pi i / n for i = 1..n, theta from +x of {R} (down in the picture) to +y (right).
        index = round(angle / (2.0 * math.pi) * count - 1.0) % count
        row = round((HEIGHT - 1) / 2 * (1.0 + math.cos(angle)))
        column = round((WIDTH - 1) / 2 * (1.0 + math.sin(angle)))
        cells[row, column] = _mark(completion[index], done[index])
    first = (HEIGHT - len(lines)) // 2
    text = Text()
    for row in range(HEIGHT):
        middle = lines[row - first].center(WIDTH) if 0 <= row - first < len(lines) else " " * WIDTH
        for column in range(WIDTH):
            mark, colour = cells.get((row, column), (middle[column], "default"))
            text.append(mark, style=colour)
        text.append("\n")
    return text


def _mark(value: float | None, done: bool) -> tuple[str, str]:
    if done:
        return DONE, "bold green"
    if value is None or not math.isfinite(value):
        return LEFT_OUT, "grey50"
    level = min(len(MARKS) - 1, max(0, int(value * len(MARKS))))
    return MARKS[level], COLOURS[level]
