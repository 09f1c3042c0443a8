"""The landmark network's geometry, with eyes that see colour in place of trained ones: red is bregma, blue lambda."""

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from vision.keypoints import LandmarkFinder
from vision.landmark_network import LAST_LOOKS, LandmarkNet
from vision.landmark_training import EDGE_PX, LandmarkTask, _turned, _view
from vision.runtime import Network
from vision.training import export


class SeesColor(nn.Module):
    """Heat where the picture is red, and where it is blue, on a grid of 2 x 2 pixels."""

    def __init__(self, spare_maps):
        super().__init__()
        self.spare_maps = spare_maps

    def forward(self, x):
        red = 20 * (x[:, 0] - x[:, 2])
        maps = []
        for color in (red, -red):
            heat = functional.avg_pool2d(color[:, None], 2)
            maps += [heat, *(torch.full_like(heat, 3.0) for _ in range(self.spare_maps))]
        return torch.cat(maps, dim=1)


@pytest.fixture
def seeing():
    network = LandmarkNet()
    network.coarse, network.fine = SeesColor(0), SeesColor(2)
    return network.eval()


def painted(bregma, lambda_, size=(960, 540)):
    """A soft red spot and a soft blue one, as large as befits the distance between them."""
    rows, columns = np.mgrid[: size[1], : size[0]]
    spread = np.hypot(*np.subtract(lambda_, bregma)) / 12
    picture = np.full((size[1], size[0], 3), 120.0)
    for (x, y), channel in ((bregma, 0), (lambda_, 2)):
        picture[..., channel] += 130 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * spread**2))
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("degrees", [0, 37, 90, 181, 275])
@pytest.mark.parametrize("span", [80, 106, 200])
def test_every_view_of_a_head_in_any_direction_comes_back_to_the_picture(seeing, degrees, span):
    along = span / 2 * np.array([np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])
    middle = np.array([470.3, 260.8])
    bregma, lambda_ = middle - along, middle + along
    with torch.no_grad():
        places, log_sigma, visible = seeing(torch.from_numpy(painted(bregma, lambda_)))
    assert places.shape == (len(LAST_LOOKS), 2, 2)
    assert places.numpy() == pytest.approx(np.stack([[bregma, lambda_]] * len(LAST_LOOKS)), abs=0.5)
    # A sigma of the view counts in pixels of the picture; a visibility is the same in both.
    scales = np.array([scale for _, scale, _ in LAST_LOOKS]) * span / 104.0
    assert log_sigma.numpy()[:, 0] == pytest.approx(3.0 + np.log(scales), abs=0.02)
    assert visible.numpy() == pytest.approx(3.0, abs=1e-3)


def test_a_picture_of_another_size_is_answered_in_its_own_pixels(seeing, tmp_path):
    task = LandmarkTask()
    export(task, seeing, tmp_path / "landmarks.onnx", {"pictures": painted((400, 200), (420, 300))[None]})
    finder = LandmarkFinder(Network(tmp_path / "landmarks.onnx"))
    bregma, lambda_ = finder.find(painted((300, 200), (310, 390), size=(640, 640)))
    assert (bregma.x_px, bregma.y_px) == pytest.approx((300, 200), abs=0.8)
    assert (lambda_.x_px, lambda_.y_px) == pytest.approx((310, 390), abs=0.8)
    assert bregma.visible


@pytest.mark.parametrize("seed", range(6))
def test_what_the_network_learns_from_says_where_the_points_went(seed):
    points = np.array([[430.0, 200.0], [450.0, 310.0]])
    picture = painted(*points)
    rng = np.random.default_rng(seed)
    checked = 0
    for made, places, scale in ((*_view(picture, points, rng), 1.0), (*_turned(picture, points, rng), 0.25)):
        for k, sign in ((0, 1.0), (1, -1.0)):
            x, y = places[k] * scale + (scale - 1) / 2
            if not (EDGE_PX < x < made.shape[1] - EDGE_PX and EDGE_PX < y < made.shape[0] - EDGE_PX):
                continue
            checked += 1
            color = sign * (made[..., 0].astype(float) - made[..., 2])
            weight = np.where(color > 0.5 * max(color.max(), 1.0), color, 0.0)
            rows, columns = np.mgrid[: made.shape[0], : made.shape[1]]
            middle = (weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()
            assert middle == pytest.approx((x, y), abs=1.2)
    assert checked >= 2


def test_figures_along_and_across_the_midline():
    """Bregma 8 px too far along a span of 84 px, lambda 4 px off to the side."""
    task = LandmarkTask()

    class Place:
        visible, sigma_px, score = True, 1.0, 1.0

        def __init__(self, x, y):
            self.x_px, self.y_px = x, y

    found = [(Place(100, 108), np.array([100.0, 100.0]), True), (Place(104, 184), np.array([100.0, 184.0]), True)]
    figures = task.figures_of(found)
    assert figures["mean_mm"] == pytest.approx(0.3)
    assert figures["worst_mm"] == pytest.approx(0.4)
    assert figures["along_midline_mean_mm"] == pytest.approx(0.2)
    assert figures["across_midline_mean_mm"] == pytest.approx(0.1)
    assert figures["center_rmse_mm"] == pytest.approx(np.hypot(0.4 * 2 / 3, 0.2 / 3))
    assert figures["swapped"] == 0
    found[0], found[1] = (found[1][0], found[0][1], True), (found[0][0], found[1][1], True)
    assert task.figures_of(found)["swapped"] == 1
