"""What the networks are made of, and the tip's, in torch. To run one, `vision.runtime` is enough."""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.keypoints import PICTURE_PX, WINDOW_CELLS

COARSE = 4
"""The first look is at a picture this much smaller."""
CELL_PX = 2
"""Every answer comes on a grid of 2 x 2 pixels."""
CROP_PX = 128
"""Side of the second look, at full resolution."""
_PADDED_PX = (960, 576)


class _Block(nn.Sequential):
    def __init__(self, inputs: int, outputs: int) -> None:
        layers: list[nn.Module] = []
        for width in (inputs, outputs):
            layers += [
                nn.Conv2d(width, outputs, 3, padding=1, bias=False),
                nn.BatchNorm2d(outputs),
                nn.ReLU(inplace=True),
            ]
        super().__init__(*layers)


class UNet(nn.Module):
    """A U-Net on a picture folded 2 x 2, so that the costly first layers run at half resolution."""

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, ...], *, fold: int = CELL_PX) -> None:
        super().__init__()
        self.fold = nn.PixelUnshuffle(fold)
        below = [inputs * fold**2, *widths]
        self.down = nn.ModuleList(_Block(a, b) for a, b in zip(below, widths, strict=False))
        self.up = nn.ModuleList(_Block(a + b, b) for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.head = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) -> (N, outputs, H / fold, W / fold)."""
        x = self.fold(x)
        levels: list[Tensor] = []
        for index, block in enumerate(self.down):
            x = block(functional.max_pool2d(x, 2) if index else x)
            levels.append(x)
        levels.pop()
        for block in self.up:
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = block(torch.cat([x, levels.pop()], dim=1))
        return cast(Tensor, self.head(x))


class KeypointNet(nn.Module):
    """Finds each of ``points`` once: roughly in the whole picture, then exactly in a crop round the rough place.

    The fine half answers three maps per point: log-probability of the place (``heat``), log of the expected error
    in pixels, and the logit that the point is visible at all.
    """

    def __init__(self, points: int) -> None:
        super().__init__()
        self.points = points
        self.coarse = UNet(3, points, (12, 24, 32, 48))
        self.fine = UNet(3, 3 * points, (12, 24, 40, 56))

    def look(self, pictures: Tensor) -> Tensor:
        """The rough look: (N, 3, 144, 240) reduced pictures -> (N, points, 72, 120) heat."""
        return cast(Tensor, self.coarse(pictures))

    def look_closely(self, crops: Tensor, point: Tensor) -> Tensor:
        """The close look: (N, 3, S, S) crops, (N,) index of the point sought -> (N, 3, S/2, S/2) maps."""
        maps = self.fine(crops)
        maps = maps.reshape(maps.shape[0], self.points, 3, *maps.shape[2:])
        return cast(Tensor, maps[torch.arange(maps.shape[0], device=maps.device), point])

    def forward(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """(540, 960, 3) uint8 -> corners (points, 2) of the crops in px, and their maps (points, 3, S/2, S/2)."""
        x = normalized(picture.permute(2, 0, 1)[None].float())
        heat = self.look(reduced(x))
        cells = heat.flatten(2).argmax(2)[0]
        step = COARSE * CELL_PX
        center = torch.stack([cells % heat.shape[3], cells // heat.shape[3]], dim=1) * step + step // 2
        corners = torch.stack(
            [
                (center[:, 0] - CROP_PX // 2).clamp(0, PICTURE_PX[0] - CROP_PX),
                (center[:, 1] - CROP_PX // 2).clamp(0, PICTURE_PX[1] - CROP_PX),
            ],
            dim=1,
        )
        side = torch.arange(CROP_PX)
        crops = [
            x.index_select(2, corners[k, 1] + side).index_select(3, corners[k, 0] + side) for k in range(self.points)
        ]
        maps = [self.fine(crop)[:, 3 * k : 3 * k + 3] for k, crop in enumerate(crops)]
        return corners, torch.cat(maps)


def reduced(x: Tensor) -> Tensor:
    """(1, C, 540, 960) -> (1, C, 144, 240), for a rough look: the last rows are padding."""
    return functional.pad(
        functional.avg_pool2d(x, COARSE), (0, 0, 0, (_PADDED_PX[1] - PICTURE_PX[1]) // COARSE), mode="replicate"
    )


def read_peak(maps: Tensor, window_cells: int = WINDOW_CELLS) -> tuple[Tensor, Tensor]:
    """What (N, 1 + M, h, w) maps say round the peak of the first: (N, 2) place in cells, (N, M) mean of the others."""
    heat = maps[:, 0]
    rows, columns = (torch.arange(size, dtype=torch.float32, device=heat.device) for size in heat.shape[1:])
    peak = heat.flatten(1).argmax(1)
    y = (rows - (peak // heat.shape[2])[:, None]).abs() <= window_cells
    x = (columns - (peak % heat.shape[2])[:, None]).abs() <= window_cells
    window = y[:, :, None] & x[:, None, :]
    weight = torch.softmax(heat.detach().masked_fill(~window, -1e4).flatten(1), dim=1).reshape(heat.shape)
    place = torch.stack([(weight.sum(1) * columns).sum(1), (weight.sum(2) * rows).sum(1)], dim=1)
    return place, (weight[:, None] * maps[:, 1:]).sum((2, 3))


def normalized(x: Tensor) -> Tensor:
    """0-255 -> about -1..1."""
    return (x - 128.0) / 64.0
