import numpy as np
import pytest

from vision.keypoints import decode


def maps_of_peak(x_px, y_px, *, sigma_cells=1.2, log_sigma=0.0, visible=4.0, side=64):
    rows, columns = np.mgrid[:side, :side]
    x, y = (x_px - 0.5) / 2, (y_px - 0.5) / 2
    heat = -((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma_cells**2)
    return np.stack([heat, np.full_like(heat, log_sigma), np.full_like(heat, visible)]).astype(np.float32)


@pytest.mark.parametrize(("x", "y"), [(64.0, 64.0), (40.3, 77.9), (12.75, 100.2), (63.49, 63.51), (50.0, 51.0)])
def test_a_gaussian_peak_is_found_to_a_hundredth_of_a_pixel(x, y):
    found = decode(maps_of_peak(x, y), np.array([300, 200]))
    assert found.x_px == pytest.approx(300 + x, abs=0.01)
    assert found.y_px == pytest.approx(200 + y, abs=0.01)


def test_no_bias_over_all_places_within_a_cell():
    errors = [decode(maps_of_peak(60 + d, 60 - d), np.zeros(2)).x_px - 60 - d for d in np.linspace(0, 2, 41)]
    assert np.abs(errors).max() < 0.01


def test_a_second_lower_peak_does_not_pull():
    maps = maps_of_peak(40, 40)
    maps[0] = np.maximum(maps[0], maps_of_peak(100, 100)[0] - 1.0)
    found = decode(maps, np.zeros(2))
    assert (found.x_px, found.y_px) == pytest.approx((40, 40), abs=0.05)


def test_a_peak_at_the_edge_stays_in_the_crop():
    found = decode(maps_of_peak(1.0, 126.0), np.zeros(2))
    assert 0 <= found.x_px <= 3
    assert 124 <= found.y_px <= 127.5


def test_sigma_and_its_scale():
    found = decode(maps_of_peak(64, 64, log_sigma=np.log(0.3)), np.zeros(2), sigma_scale=2.0)
    assert found.sigma_px == pytest.approx(0.6, rel=1e-5)


@pytest.mark.parametrize(("logit", "visible"), [(-3.0, False), (-0.1, False), (0.1, True), (3.0, True)])
def test_not_visible_is_an_answer(logit, visible):
    found = decode(maps_of_peak(64, 64, visible=logit), np.zeros(2))
    assert found.visible is visible
    assert found.score == pytest.approx(1 / (1 + np.exp(-logit)))
