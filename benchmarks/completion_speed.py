"""How fast completion is read on one core, beside a network of the paper's kind in the same run.

    python -m benchmarks.completion_speed

The reference is what the paper describes, as far as it does: ResNet-101, single-shot box heads with deconvolutions and
a heat map, of the whole picture, in torch as it comes. What its weights are does not change its speed. Absolute times
move between machines; the ratio is what counts.
"""

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.completion import CompletionReader

SIZE_PX = (960, 540)
POINTS = 32
RING_PX, BALL_PX = 50.7, 12.7
"""A ring of 2 mm and a ball of 0.5 mm at the paper's scale."""
BLOCKS = (3, 4, 23, 3)
"""Of ResNet-101."""


class PaperKind(nn.Module):
    """Boxes and a heat map of a whole picture, as DSSD does it."""

    def __init__(self, blocks: tuple[int, ...] = BLOCKS, width: int = 64) -> None:
        super().__init__()
        self.stem = nn.Sequential(_convolved(3, width, 7, 2), nn.MaxPool2d(3, 2, 1))
        stages, inputs = [], width
        for level, count in enumerate(blocks):
            inner = width * 2**level
            layers = [
                _Bottleneck(inputs if k == 0 else 4 * inner, inner, 2 if k == 0 < level else 1) for k in range(count)
            ]
            stages.append(nn.Sequential(*layers))
            inputs = 4 * inner
        self.stages = nn.ModuleList(stages)
        self.extra = nn.ModuleList([_convolved(inputs, 512, 3, 2), _convolved(512, 256, 3, 2)])
        below = [width * 4 * 2**level for level in range(1, 4)] + [512, 256]
        self.lateral = nn.ModuleList(nn.Conv2d(channels, 256, 1) for channels in below)
        self.up = nn.ModuleList(nn.ConvTranspose2d(256, 256, 2, 2) for _ in below[1:])
        self.boxes = nn.Conv2d(256, 4 * (4 + 2), 3, padding=1)
        self.heat = nn.Sequential(
            nn.ConvTranspose2d(256, 64, 2, 2), nn.ReLU(), nn.ConvTranspose2d(64, 32, 2, 2), nn.ReLU(),
            nn.ConvTranspose2d(32, 1, 2, 2),
        )  # fmt: skip

    def forward(self, pictures: Tensor) -> tuple[list[Tensor], Tensor]:
        """(N, 3, H, W) -> box heads of each level, and a heat map (N, 1, about H, about W)."""
        x = self.stem(pictures)
        levels = []
        for index, stage in enumerate(self.stages):
            x = stage(x)
            if index:
                levels.append(x)
        for layer in self.extra:
            x = layer(x)
            levels.append(x)
        merged = self.lateral[-1](levels[-1])
        boxes = [self.boxes(merged)]
        for index in range(len(levels) - 2, -1, -1):
            raised = functional.interpolate(self.up[index](merged), levels[index].shape[2:])
            merged = functional.relu(raised * self.lateral[index](levels[index]))
            boxes.append(self.boxes(merged))
        return boxes, self.heat(merged)


class _Bottleneck(nn.Module):
    def __init__(self, inputs: int, inner: int, stride: int) -> None:
        super().__init__()
        self.path = nn.Sequential(
            _convolved(inputs, inner, 1, 1), _convolved(inner, inner, 3, stride),
            nn.Conv2d(inner, 4 * inner, 1, bias=False), nn.BatchNorm2d(4 * inner),
        )  # fmt: skip
        same = inputs == 4 * inner and stride == 1
        self.beside = nn.Identity() if same else nn.Conv2d(inputs, 4 * inner, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.path(x) + self.beside(x))


def _convolved(inputs: int, outputs: int, size: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


def measure(*, reference: nn.Module | None = None, readings: int = 300, looks: int = 3) -> dict[str, float]:
    """Median rates on one thread, from the decoded picture on.

    Args:
        reference: what is compared with; a ``PaperKind`` where left out.
        readings: of ours.
        looks: of the reference.

    Returns:
        ``ring_rate_hz`` (completion, bound and visibility at 32 points), ``frame_rate_hz`` (besides, the kerf's box and
        the heat map of the whole picture), ``paper_kind_rate_hz``, and ``speedup``, the ratio of the latter two.
    """
    angles = np.arange(POINTS) * 2 * np.pi / POINTS
    ring_px = np.array(SIZE_PX) / 2 + RING_PX * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    picture = np.random.default_rng(0).integers(0, 255, (SIZE_PX[1], SIZE_PX[0], 3), dtype=np.uint8)
    reader = CompletionReader.load().over(ring_px, BALL_PX, reference=picture)
    network = (reference or PaperKind()).eval()
    x = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255.0

    def whole() -> None:
        reading = reader.read(picture)
        assert reading.heat_map.shape == picture.shape[:2]
        reading.box_px  # noqa: B018  (it is computed when it is asked for)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            paper_s = _median_s(lambda: network(x), looks)
    finally:
        torch.set_num_threads(threads)
    frame_s = _median_s(whole, readings)
    return {
        "ring_rate_hz": 1.0 / _median_s(lambda: reader.read(picture), readings),
        "frame_rate_hz": 1.0 / frame_s,
        "paper_kind_rate_hz": 1.0 / paper_s,
        "speedup": paper_s / frame_s,
    }


def _median_s(work: Callable[[], object], times: int) -> float:
    work()
    spent = []
    for _ in range(times):
        begun = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begun)
    return float(np.median(spent))


if __name__ == "__main__":
    for name, value in measure().items():
        print(f"{name:20} {value:.4g}")
