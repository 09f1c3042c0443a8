"""The landmark network, in torch: a rough look at the whole picture, then close looks with the head set upright.

The rough look works with the head lying in any direction. It gives a line from bregma to lambda; the close looks
resample the picture so that this line always stands upright and always is ``SPAN_PX`` long, which leaves the fine half
only small differences to learn. Several such views, each turned and scaled a little differently, agree or do not: their
spread is part of the uncertainty.
"""

import math
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.keypoints import PICTURE_PX
from vision.networks import CELL_PX, COARSE, UNet, normalized, read_peak, reduced

VIEW_PX = 256
"""Side of a close view."""
SPAN_PX = 104.0
"""From bregma to lambda in a close view: about what a bench's picture has, so that nothing is lost."""
WINDOW_CELLS = 20
"""Half the side of the window that a place is averaged over: wider than the tip's, since along the midline people who
mark landmarks differ by tenths of a millimetre, and the mean of what they might say is nearest to most of them."""
SPANS_PX = (30.0, 400.0)
"""From bregma to lambda in the picture: shortest and longest that the close views follow."""
FIRST_LOOKS = ((0.0, 1.0, 1.0), (0.0, 1.0, -1.0))
LAST_LOOKS = tuple(
    (math.radians(turn), scale, mirror)
    for turn, scale in ((-8.0, 0.95), (8.0, 1.06), (0.0, 0.88), (0.0, 1.14))
    for mirror in (1.0, -1.0)
)
"""Views as (turn in rad, scale, 1 or -1 for mirrored): a first pair to aim better, then those that count."""


class LandmarkNet(nn.Module):
    """Finds bregma and lambda once each."""

    def __init__(self) -> None:
        super().__init__()
        self.coarse = UNet(3, 2, (16, 32, 48, 64))
        self.fine = UNet(3, 6, (16, 32, 48, 64, 80))

    def look(self, pictures: Tensor) -> Tensor:
        """The rough look: (N, 3, 144, 240) reduced pictures -> (N, 2, 72, 120) heat."""
        return cast(Tensor, self.coarse(pictures))

    def look_closely(self, views: Tensor) -> Tensor:
        """The close look: (N, 3, S, S) -> (N, 2, 3, S/2, S/2) heat, log of sigma and logit of visible per landmark."""
        maps = self.fine(views)
        return cast(Tensor, maps.reshape(maps.shape[0], 2, 3, *maps.shape[2:]))

    def forward(self, picture: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(540, 960, 3) uint8 -> places (V, 2, 2) px, log of sigma in px (V, 2) and logit of visible (V, 2)."""
        x = normalized(picture.permute(2, 0, 1)[None].float())
        places, _ = read_peak(self._rough(reduced(x))[0][:, None])
        step = COARSE * CELL_PX
        line = places * step + (step - 1) / 2
        first, _, _ = self._read(x, line, FIRST_LOOKS)
        return self._read(x, first.mean(0), LAST_LOOKS)

    def _rough(self, x: Tensor) -> Tensor:
        """What four rough looks agree on: as it is, mirrored, upside down, and both. (1, 2, h, w) log-probability."""
        looks = [self.look(x), *(self.look(x.flip(axes)).flip(axes) for axes in ([3], [2], [2, 3]))]
        agreed = torch.stack([functional.log_softmax(heat.flatten(2), dim=2) for heat in looks]).mean(0)
        return agreed.reshape(looks[0].shape)

    def _read(
        self, x: Tensor, line: Tensor, changes: tuple[tuple[float, float, float], ...]
    ) -> tuple[Tensor, Tensor, Tensor]:
        turned, middle = view_frames(line, torch.tensor(changes))
        side = torch.arange(VIEW_PX, dtype=torch.float32) - (VIEW_PX - 1) / 2
        across = side[None, :].expand(VIEW_PX, VIEW_PX)
        grid = torch.stack([across, across.t()], dim=-1)
        pixels = (grid.reshape(1, -1, 2) @ turned.transpose(1, 2) + middle).reshape(-1, VIEW_PX, VIEW_PX, 2)
        unit = torch.tensor([2.0 / (PICTURE_PX[0] - 1), 2.0 / (PICTURE_PX[1] - 1)])
        views = functional.grid_sample(x.expand(len(changes), -1, -1, -1), pixels * unit - 1.0, align_corners=True)
        maps = self.look_closely(views)
        cells, doubts = read_peak(maps.flatten(0, 1), WINDOW_CELLS)
        centered = cells.reshape(-1, 2, 2) * CELL_PX + 0.5 - (VIEW_PX - 1) / 2
        scale = torch.linalg.vector_norm(turned[:, :, 1], dim=1)[:, None]
        places = centered @ turned.transpose(1, 2) + middle
        log_sigma, visible = doubts.reshape(-1, 2, 2).unbind(2)
        return places, log_sigma + torch.log(scale), visible


def view_frames(line: Tensor, changes: Tensor) -> tuple[Tensor, Tensor]:
    """How close views lie in the picture: picture px = turned @ (view px from the view's centre) + middle.

    Args:
        line: (2, 2) bregma and lambda in the picture.
        changes: (V, 3) turn in rad, scale, 1 or -1.

    Returns:
        ``turned`` (V, 2, 2) and ``middle`` (2,).
    """
    along = line[1] - line[0]
    length = along.square().sum().sqrt().clamp(min=1e-3)
    down = along / length
    scale = length.clamp(*SPANS_PX) / SPAN_PX * changes[:, 1]
    cosine, sine = torch.cos(changes[:, 0]), torch.sin(changes[:, 0])
    # Columns: where the view's right and its downward direction point in the picture.
    upright = torch.stack([torch.stack([down[1], down[0]]), torch.stack([-down[0], down[1]])])
    turn = torch.stack([torch.stack([cosine, -sine], 1), torch.stack([sine, cosine], 1)], 1)
    mirror = torch.stack([changes[:, 2], torch.ones_like(changes[:, 2])], 1)
    return scale[:, None, None] * (upright @ turn) * mirror[:, None, :], line.mean(0)
