"""The completion network, in torch: it reads the ring unrolled, see `vision.strip`."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.networks import normalized
from vision.strip import ACROSS_PX, CELL_PX

WIDTHS = (32, 48, 64)
WRAP_CELLS = 4
"""So much of the strip's end is put before its beginning, and the other way round. Along the ring the layers reach 10
cells, so the first and last few cells know a little less of their neighbours; more cells cost more than that."""


class CompletionNet(nn.Module):
    """Says how far the kerf is milled, from the strip now and the strip before milling.

    Across the strip the network narrows to a line, along which it reads what concerns the ring's points; on the way
    back it draws the kerf. Convolutions are separable, so that one core reads more than a thousand rings a second.
    """

    def __init__(self) -> None:
        super().__init__()
        top, middle, low = WIDTHS
        self.stem = _conv(6, top, CELL_PX, stride=CELL_PX)
        self.upper = nn.Sequential(_Separable(top), _Separable(top))
        self.narrow = _conv(top, middle, (2, 1), stride=(2, 1))
        self.middle = nn.Sequential(_Separable(middle), _Separable(middle))
        self.narrower = _conv(middle, low, (2, 1), stride=(2, 1))
        self.lower = nn.Sequential(_Separable(low), _Separable(low))
        self.flat = _conv(low, low, (ACROSS_PX // CELL_PX[0] // 4, 1))
        self.everywhere = nn.Linear(low, low)
        self.along = nn.Sequential(_conv(low, low, (1, 5), padding=(0, 2)), _conv(low, low, (1, 5), padding=(0, 2)))
        self.line = nn.Conv2d(low, 4, 1)
        self.back = nn.ModuleList(nn.Conv2d(width, 16, 1) for width in (low, middle, top))
        self.map = nn.Sequential(_conv(16, 16, (3, 3), padding=(1, 1)), nn.Conv2d(16, 2, 1))

    def forward(self, strips: Tensor) -> tuple[Tensor, Tensor]:
        """Read (N, across, along, 6) uint8 strips, now and before.

        Returns:
            Along the ring (N, 4, cells): completion, its upper bound, and the logits of drill and hole.
            Of the strip (N, 2, cells across, cells along): logit of kerf, and completion.
        """
        x = normalized(strips.permute(0, 3, 1, 2).float())
        wrap = WRAP_CELLS * CELL_PX[1]
        x = torch.cat([x[..., -wrap:], x, x[..., :wrap]], dim=3)
        upper = self.upper(self.stem(x))
        middle = self.middle(self.narrow(upper))
        lower = self.lower(self.narrower(middle))
        inner = slice(WRAP_CELLS, -WRAP_CELLS)
        flat = self.flat(lower)
        # Light, hue of bone and bed are the same all round: each place is read in their knowledge.
        flat = functional.relu(flat + self.everywhere(flat[..., inner].mean((2, 3)))[:, :, None, None])
        line = self.line(self.along(flat))[:, :, 0, inner]
        completion = torch.sigmoid(line[:, :1])
        bound = completion + functional.softplus(line[:, 1:2])
        drawn = self.back[0](lower)
        for layer, level in ((self.back[1], middle), (self.back[2], upper)):
            drawn = functional.interpolate(drawn, scale_factor=(2.0, 1.0)) + layer(level)
        maps = self.map(functional.relu(drawn))[..., inner]
        return torch.cat([completion, bound, line[:, 2:]], dim=1), torch.cat(
            [maps[:, :1], torch.sigmoid(maps[:, 1:])], dim=1
        )


class _Separable(nn.Module):
    """A 3 x 3 convolution per channel, then a mix of the channels, beside what came in."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.each = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1, groups=width, bias=False), nn.BatchNorm2d(width), nn.ReLU()
        )
        self.mix = nn.Sequential(nn.Conv2d(width, width, 1, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: Tensor) -> Tensor:
        """(N, width, h, w) -> the same shape."""
        return functional.relu(x + self.mix(self.each(x)))


def _conv(
    inputs: int,
    outputs: int,
    size: tuple[int, int],
    *,
    stride: tuple[int, int] = (1, 1),
    padding: tuple[int, int] = (0, 0),
) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, padding, bias=False), nn.BatchNorm2d(outputs), nn.ReLU()
    )
