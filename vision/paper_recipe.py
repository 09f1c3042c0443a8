"""The paper's keypoint recipe, to be compared with: a U-Net over the whole picture, Gaussian confidence maps, MSE.

Adam, 30 epochs, learning rates 1e-3, 1e-4 and 1e-5 for ten epochs each, batches of 4; blur, noise, colour, geometry and
resolution as augmentation. The paper gives neither the width of the maps nor that of the network: 5 px and the usual 64
channels are ours. Made for a GPU: on two cores an epoch takes hours.
"""

import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.keypoint_training import KeypointTask, as_input
from vision.keypoints import BORDER, PICTURE_PX, Finder, LandmarkFinder, TipFinder
from vision.networks import CELL_PX, CROP_PX, UNet, normalized
from vision.runtime import Image, Network
from vision.samples import Data, relit
from vision.training import CHECKS, Batch, Recipe

MAP_SIGMA_PX = 5.0
WIDTHS = (64, 128, 256, 512, 1024)
SEEN_FROM = 0.3
"""Least peak of a confidence map that counts as a point."""
_PADDED_ROWS = 544


class PaperNet(nn.Module):
    """One confidence map per point, as large as the picture; the place is where it is highest."""

    def __init__(self, points: int, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        self.points = points
        self.body = UNet(3, points, widths, fold=1)

    def maps(self, pictures: Tensor) -> Tensor:
        """(N, 3, 540, 960) -> (N, points, 540, 960) confidence."""
        padded = functional.pad(pictures, (0, 0, 0, _PADDED_ROWS - PICTURE_PX[1]), mode="replicate")
        return torch.as_tensor(self.body(padded)[:, :, : PICTURE_PX[1]])

    def forward(self, picture: Tensor) -> tuple[Tensor, ...]:
        """(540, 960, 3) uint8 -> the outputs of the network that it stands in for: one view, a peak of one pixel."""
        confidence = self.maps(normalized(picture.permute(2, 0, 1)[None].float()))[0]
        value, index = confidence.flatten(1).max(1)
        place = torch.stack([index % PICTURE_PX[0], index // PICTURE_PX[0]], dim=1).float()
        visible = 20.0 * (value - SEEN_FROM)
        if self.points > 1:
            return place[None], torch.zeros(1, self.points), visible[None]
        # The tip's finder reads maps of a crop: the peak goes to the middle of one of its cells.
        cells = CROP_PX // CELL_PX
        middle = torch.zeros(cells, cells)
        middle[cells // 2, cells // 2] = 50.0
        corner = place - (cells // 2 * CELL_PX + 0.5)
        flat = torch.ones(cells, cells)
        return corner, torch.stack([middle, torch.zeros(cells, cells), flat * visible[0]])[None]


class PaperTask(KeypointTask):
    """Find ``names`` as the paper does. Data as of the task it stands in for."""

    def __init__(self, name: str, names: tuple[str, ...], *, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__(name, names, steps=0)
        self.recipes: Mapping[str, Recipe] = {
            "paper": Recipe(epochs=30, batch=4, learning_rate=1e-3, plan="three-rates", patience=CHECKS)
        }
        self._widths = widths

    def network(self) -> nn.Module:
        """A fresh network."""
        return PaperNet(len(self.names), self._widths)

    def finder(self, network: Network) -> Finder:
        """What runs the exported network."""
        return TipFinder(network) if len(self.names) == 1 else LandmarkFinder(network)

    def batch(self, data: Data, size: int, rng: np.random.Generator) -> Batch:
        """Whole pictures and their confidence maps."""
        pictures, targets = [], []
        for index in rng.integers(len(data["pictures"]), size=size):
            picture, points = _moved(np.asarray(data["pictures"][index]), np.asarray(data["points"][index]), rng)
            pictures.append(_coarser(relit(picture, rng), rng))
            targets.append(_confidence(points, np.asarray(data["visible"][index])))
        return {"pictures": as_input(pictures), "maps": torch.from_numpy(np.stack(targets))}

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Mean squared error of the confidence maps."""
        assert isinstance(network, PaperNet)
        return functional.mse_loss(network.maps(batch["pictures"]).float(), batch["maps"])


def _moved(
    picture: Image, points: npt.NDArray[np.float64], rng: np.random.Generator
) -> tuple[Image, npt.NDArray[np.float64]]:
    """Turned, scaled and shifted a little."""
    affine: npt.NDArray[Any] = cv2.getRotationMatrix2D(
        ((PICTURE_PX[0] - 1) / 2, (PICTURE_PX[1] - 1) / 2), rng.uniform(-12.0, 12.0), math.exp(rng.uniform(-0.15, 0.15))
    )
    affine[:, 2] += np.asarray(rng.uniform(-30.0, 30.0, size=2))
    moved = cv2.warpAffine(picture, affine, PICTURE_PX, borderValue=(BORDER,) * 3)
    return moved.astype(np.uint8), points @ affine[:, :2].T + affine[:, 2]


def _coarser(picture: Image, rng: np.random.Generator) -> Image:
    """Now and then as a camera of less resolution would have it."""
    if rng.random() < 0.7:
        return picture
    share = rng.uniform(0.4, 0.9)
    small = cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    return cv2.resize(small, PICTURE_PX, interpolation=cv2.INTER_LINEAR).astype(np.uint8)


def _confidence(points: npt.NDArray[np.float64], visible: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    columns = np.arange(PICTURE_PX[0], dtype=np.float32)
    rows = np.arange(PICTURE_PX[1], dtype=np.float32)
    maps = np.zeros((len(points), PICTURE_PX[1], PICTURE_PX[0]), np.float32)
    for k in np.flatnonzero(visible):
        x = np.exp(-((columns - points[k, 0]) ** 2) / (2 * MAP_SIGMA_PX**2))
        y = np.exp(-((rows - points[k, 1]) ** 2) / (2 * MAP_SIGMA_PX**2))
        maps[k] = y[:, None] * x[None, :]
    return maps
