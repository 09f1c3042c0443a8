import numpy as np
import pytest

from vision.scores import IOU_STEPS, average_precision, by_tenths, iou


def test_each_tenth_counts_alike_however_many_samples_it_has():
    truth = np.array([0.15] * 99 + [0.95])
    errors = np.array([0.015] * 99 + [0.19])
    figures = by_tenths(errors, truth)
    assert figures["mape_from_0.05_by_tenths"] == pytest.approx((0.1 + 0.2) / 2)
    assert figures["rmse_by_tenths"] == pytest.approx(np.sqrt((0.015**2 + 0.19**2) / 2))
    assert figures["rmse_tenth_1"] == pytest.approx(0.015)
    assert figures["rmse_tenth_9"] == pytest.approx(0.19)
    assert "rmse_tenth_5" not in figures


def test_a_percentage_of_nearly_nothing_is_left_out_and_through_is_the_last_tenth():
    figures = by_tenths(np.array([0.04, 0.1]), np.array([0.01, 1.0]))
    assert figures["mape_from_0.05_by_tenths"] == pytest.approx(0.1)
    assert figures["rmse_tenth_0"] == pytest.approx(0.04)
    assert figures["rmse_tenth_9"] == pytest.approx(0.1)


def test_boxes():
    assert iou((0, 0, 2, 2), (0, 0, 2, 2)) == 1
    assert iou((0, 0, 2, 2), (1, 0, 3, 2)) == pytest.approx(1 / 3)
    assert iou((0, 0, 2, 2), (2, 0, 3, 2)) == 0
    assert (IOU_STEPS[0], IOU_STEPS[-1], len(IOU_STEPS)) == (0.5, 0.95, 10)


def test_average_precision_by_hand():
    # Of three true boxes two are found, first and third by score; between them a wrong one.
    ious, scores = np.array([0.9, 0.6, 0.1]), np.array([0.9, 0.2, 0.5])
    at_half = average_precision(ious, scores, 3, 0.5)
    assert at_half == pytest.approx((34 * 1.0 + 33 * (2 / 3)) / 101)
    assert average_precision(ious, scores, 3, 0.7) == pytest.approx(34 / 101)
    assert average_precision(ious, scores, 3, 0.95) == 0
    assert average_precision(np.ones(5), np.ones(5), 5, 0.95) == 1
    assert average_precision(np.array([]), np.array([]), 2, 0.5) == 0
    assert np.isnan(average_precision(np.array([]), np.array([]), 0, 0.5))
