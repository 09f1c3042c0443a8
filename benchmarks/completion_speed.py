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

from milling.eyes import mean_radius
from studies.scenes import Array, Scene
from studies.trials import World
from vision.completion import CompletionReader
from vision.runtime import Image

POINTS = 32
RADIUS_MM = 2.0
READINGS, LOOKS = 300, 3
"""How often ours is timed, and the reference."""
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


def measure(reference: nn.Module | None = None) -> dict[str, float]:
    """Median rates on one thread, from the decoded picture of a ring that is half milled.

    Args:
        reference: what is compared with; a ``PaperKind`` where left out.

    Returns:
        ``ring_rate_hz`` (completion, bound and visibility at 32 points), ``frame_rate_hz`` (besides, the kerf's box and
        the heat map of the whole picture), ``paper_kind_rate_hz``, and ``speedup``, the ratio of the latter two.
    """
    before, picture, ring_px, ball_px = _half_milled()
    reader = CompletionReader.load().over(ring_px, ball_px, reference=before)
    network = (reference or PaperKind()).eval()
    x = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255.0

    def whole() -> None:
        reading = reader.read(picture)
        assert reading.box_px is not None
        assert reading.heat_map.any()

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            paper_s = _median_s(lambda: network(x), LOOKS)
    finally:
        torch.set_num_threads(threads)
    frame_s = _median_s(whole, READINGS)
    return {
        "ring_rate_hz": 1.0 / _median_s(lambda: reader.read(picture), READINGS),
        "frame_rate_hz": 1.0 / frame_s,
        "paper_kind_rate_hz": 1.0 / paper_s,
        "speedup": paper_s / frame_s,
    }


def _half_milled() -> tuple[Image, Image, Array, float]:
    """The left picture before and now, the ring (32, 2) in it and the ball's radius, in px."""
    scene = Scene(World(0).specimen(), np.random.default_rng(0))
    scene.park()
    before = scene.pictures()[0]
    angles = np.arange(POINTS) * 2 * np.pi / POINTS
    ring_mm = scene.center_mm + RADIUS_MM * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    scene.carve(ring_mm, np.full(POINTS, 0.5))
    ring_px = scene.microscope.project(np.column_stack([ring_mm, scene.outer_z(ring_mm)]))[0]
    ball_mm = scene.machine.specimen.tool.ball_radius_mm
    return before, scene.pictures()[0], ring_px, ball_mm / RADIUS_MM * mean_radius(ring_px)


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
