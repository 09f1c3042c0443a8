"""The unrolled ring: what lies where, and back again."""

import numpy as np
import pytest

from vision.completion import box_of
from vision.strip import ACROSS_PX, ALONG_PX, BALL_PX, CELL_PX, CELLS, at_points, cells_at, unroll

CENTER = np.array([300.0, 200.0])


def ellipse(n: int, wide: float = 60.0, high: float = 52.0, *, clockwise: bool = False) -> np.ndarray:
    angles = np.arange(1, n + 1) * 2 * np.pi / n * (-1 if clockwise else 1)
    return CENTER + np.stack([wide * np.cos(angles), high * np.sin(angles)], axis=1)


@pytest.mark.parametrize("n", [8, 32, 80])
@pytest.mark.parametrize("clockwise", [False, True])
def test_points_of_the_ring_lie_in_the_middle_of_their_cells(n: int, clockwise: bool) -> None:
    ring = ellipse(n, clockwise=clockwise)
    strip = unroll(ring, 12.5)
    # The middle of cell k is between columns 4k + 1 and 4k + 2, the ring between the two middle rows.
    place = np.stack([strip.x_px, strip.y_px], axis=-1)[ACROSS_PX // 2 - 1 : ACROSS_PX // 2 + 1].mean(axis=0)
    for point, cell in zip(ring, cells_at(n), strict=True):
        column = cell * CELL_PX[1] + (CELL_PX[1] - 1) / 2
        before = int(np.floor(column)) % ALONG_PX
        share = column - np.floor(column)
        found = (1 - share) * place[before] + share * place[(before + 1) % ALONG_PX]
        assert found == pytest.approx(point, abs=0.35 if n == 8 else 0.05)


@pytest.mark.parametrize("clockwise", [False, True])
def test_rows_lead_outwards_in_shares_of_the_ball(clockwise: bool) -> None:
    ball_px = 20.0
    strip = unroll(ellipse(32, 100.0, 100.0, clockwise=clockwise), ball_px)
    away = np.hypot(strip.x_px - CENTER[0], strip.y_px - CENTER[1])
    rows = (np.arange(ACROSS_PX) - (ACROSS_PX - 1) / 2) * ball_px / BALL_PX
    assert away == pytest.approx(np.broadcast_to(100.0 + rows[:, None], away.shape), abs=0.05)


def test_a_map_of_the_strip_goes_back_to_where_it_was_cut() -> None:
    ring = ellipse(32)
    strip = unroll(ring, 12.5)
    kerf = np.zeros(CELLS, np.float32)
    kerf[6:18] = np.linspace(0.1, 1.0, CELLS[1])
    picture = strip.painted(kerf, (400, 600))
    assert picture.shape == (400, 600)
    for index in (3, 10, 25):
        x, y = np.round(ring[index]).astype(int)
        assert picture[y, x] == pytest.approx(kerf[12, round(cells_at(32)[index])], abs=0.03)
    assert picture[200, 300] == 0.0
    assert picture[:, :200].max() == 0.0


def test_a_strip_that_leaves_the_picture_is_painted_as_far_as_it_reaches() -> None:
    strip = unroll(ellipse(32) - [280.0, 0.0], 12.5)
    assert strip.painted(np.ones(CELLS, np.float32), (400, 600)).sum() > 0


def test_the_box_passes_through_the_zero_of_the_logit() -> None:
    strip = unroll(ellipse(32, 60.0, 60.0), BALL_PX)
    logit = np.full(CELLS, -4.0, np.float32)
    assert box_of(logit, strip) is None
    logit[6:18] = 4.0
    logit[17] = 12.0  # a steeper edge outside: nothing moves by more than a share of a cell
    x0, y0, x1, y1 = box_of(logit, strip)
    # Rows 5.5 to 17.75 of 24 cells of 2 px: 12 px inside the ring, 12.5 px outside it.
    assert np.array([x0, y0, x1, y1]) == pytest.approx([227.5, 127.5, 372.5, 272.5], abs=0.2)


def test_values_between_cells_are_shared_and_the_end_meets_the_beginning() -> None:
    values = np.arange(CELLS[1], dtype=float)
    assert at_points(values, 160)[:3] == pytest.approx([0.0, 0.5, 1.0])
    assert at_points(values, 160)[-1] == pytest.approx((CELLS[1] - 1) / 2)
