"""The paper's way to read completion, to be compared with: a heat map learnt with MSE from one picture.

The paper gives its network no picture of the unmilled skull, no uncertainty, no "hidden" and no hole apart from a
high completion; nor does it say how long it learns. Adam at 1e-3, 1e-4 and 1e-5 as for its keypoints, its
augmentations, and a U-Net in place of its ResNet-101, which two cores cannot train; it is given the same strips.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.completion_training import CompletionTask
from vision.networks import UNet, normalized
from vision.runtime import Network
from vision.samples import Data
from vision.strip import CELL_PX, CELLS
from vision.training import CHECKS, Batch, Recipe

WIDTHS = (16, 32, 64)
DONE_FROM = 0.95
"""Completion that counts as through: the paper names no threshold."""
KERF_FROM = 0.05
STEEPNESS = 400.0
"""Of the logits that stand for thresholds: as good as a step."""
CENTRE_ROWS = slice(CELLS[0] // 2 - 1, CELLS[0] // 2 + 1)


class PaperCompletionNet(nn.Module):
    """A completion for every place, 0 where there is no kerf; a point of the ring is read off it."""

    def __init__(self, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        self.body = UNet(3, 1, widths, fold=1)

    def heat(self, strips: Tensor) -> Tensor:
        """(N, across, along, 6) uint8 -> (N, cells across, cells along)."""
        now = normalized(strips[..., :3].permute(0, 3, 1, 2).float())
        return functional.avg_pool2d(self.body(now), CELL_PX)[:, 0]

    def forward(self, strips: Tensor) -> tuple[Tensor, Tensor]:
        """What ``CompletionNet`` answers, as far as a heat map tells it."""
        heat = self.heat(strips).clamp(0.0, 1.0)
        along = heat[:, CENTRE_ROWS].mean(dim=1)
        line = torch.stack([along, along, torch.full_like(along, -20.0), STEEPNESS * (along - DONE_FROM)], dim=1)
        return line, torch.stack([STEEPNESS * (heat - KERF_FROM), heat], dim=1)


class PaperCompletionTask(CompletionTask):
    """Read the ring as the paper does. Data as of ``CompletionTask``."""

    recipes: Mapping[str, Recipe] = {
        "paper": Recipe(epochs=5, batch=16, learning_rate=1e-3, plan="three-rates", patience=CHECKS)
    }

    def __init__(self, *, widths: tuple[int, ...] = WIDTHS) -> None:
        self._widths = widths

    def network(self) -> nn.Module:
        """A fresh network."""
        return PaperCompletionNet(self._widths)

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Mean squared error of the heat map, but where the drill stands."""
        assert isinstance(network, PaperCompletionNet)
        seen = (batch["kerfs"] >= 0.0).float()
        errors = (network.heat(batch["strips"]).float() - batch["maps"]) ** 2
        return torch.as_tensor((errors * seen).sum() / seen.sum().clamp(min=1))

    def calibrate(self, network: Network, data: Data) -> dict[str, float]:
        """Nothing: the paper's reading has no bound."""
        return {}
