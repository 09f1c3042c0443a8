"""Which pixel of the right picture shows what a pixel of the left one shows, to a fraction of a pixel.

Classical on purpose: dense inverse search (DIS) in both directions, kept only where the two agree. It knows no
millimetre. The right picture is first warped to the left one's rows by an affine map, so what is left to find is
small: the relief of the bone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vision.runtime import Image

STEP_PX = 2
"""Matches are given on a grid of this step."""
AGREE_PX = 0.5
"""Most that the way there and back may miss its start by."""
ROW_PX = 2.0
"""Most that a match may leave its row by, beyond the region's median: more is another object or a mirror image."""
RELIEF_PX = 5.0
"""Most that a match may stray from the smooth surface through the region: a drill, a hair, a highlight stand off."""
UNEXPLAINED = 0.5
"""Largest share of a patch's contrast that may differ between the two pictures."""
GLARE = 250
"""A pixel whose darkest channel reaches this carries no texture."""
SIGMA_SCALE = 1.5
"""Measured on rendered skulls: what differs within a patch is not independent from pixel to pixel."""
SLOW_PX = 4.0
"""Wider structures are taken out: light, and what shines through from under the bone and so lies too deep."""
PATCH_PX = 9
MARGIN_PX = 48
_SPREAD = 48.0


@dataclass(frozen=True)
class Matches:
    """Places in the left and the right picture that show the same point, and the error to expect along x."""

    left_px: npt.NDArray[np.float64]
    right_px: npt.NDArray[np.float64]
    sigma_px: npt.NDArray[np.float64]


def averaged(pictures: Sequence[Image]) -> Image:
    """The mean of several pictures of one scene: less noise."""
    return np.round(np.mean(pictures, axis=0, dtype=np.float32)).astype(np.uint8)


def match(
    left: Image,
    right: Image,
    *,
    right_from_left: npt.NDArray[np.float64] | None = None,
    region: tuple[float, float, float, float] | None = None,
) -> Matches:
    """Match a region of the left picture with the right picture.

    Args:
        left: (H, W, 3).
        right: (H, W, 3).
        right_from_left: (2, 3) affine that takes left pixels to right pixels for a plane near the surface; identity
            where None.
        region: x0, y0, x1, y1 in left pixels; the whole picture where None.

    Returns:
        Matches on a grid of ``STEP_PX``; fewer than asked for, even none, where the pictures do not agree.
    """
    affine = np.eye(2, 3) if right_from_left is None else np.asarray(right_from_left, dtype=np.float64)
    height, width = left.shape[:2]
    x0, y0, x1, y1 = region or (0.0, 0.0, float(width), float(height))
    inner = (max(int(x0), 0), max(int(y0), 0), min(int(np.ceil(x1)), width), min(int(np.ceil(y1)), height))
    outer = (
        max(inner[0] - MARGIN_PX, 0),
        max(inner[1] - MARGIN_PX, 0),
        min(inner[2] + MARGIN_PX, width),
        min(inner[3] + MARGIN_PX, height),
    )
    if inner[2] - inner[0] < PATCH_PX or inner[3] - inner[1] < PATCH_PX:
        return _nothing()
    near = left[outer[1] : outer[3], outer[0] : outer[2]]
    shift = affine @ np.array([[1.0, 0.0, outer[0]], [0.0, 1.0, outer[1]], [0.0, 0.0, 1.0]])
    size = (outer[2] - outer[0], outer[3] - outer[1])
    warped = cv2.warpAffine(right, shift, size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderValue=(0, 0, 0))
    seen = cv2.warpAffine(
        np.full(right.shape[:2], 255, np.uint8), shift, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )
    glare = cv2.dilate((near.min(axis=2) >= GLARE).astype(np.uint8), np.ones((5, 5), np.uint8))
    glare_right = cv2.dilate((warped.min(axis=2) >= GLARE).astype(np.uint8), np.ones((5, 5), np.uint8))

    one, two = _even(near), _even(warped.astype(np.uint8))
    flow = _flow(one, two)
    back = _flow(two, one)

    rows, columns = np.mgrid[
        inner[1] - outer[1] : inner[3] - outer[1] : STEP_PX, inner[0] - outer[0] : inner[2] - outer[0] : STEP_PX
    ]
    x, y = columns.ravel(), rows.ravel()
    there = flow[y, x].astype(np.float64)
    target = np.stack([x + there[:, 0], y + there[:, 1]], axis=1)
    returned = cv2.remap(
        back, target[:, 0].astype(np.float32), target[:, 1].astype(np.float32), cv2.INTER_LINEAR, borderValue=(1e3, 1e3)
    ).reshape(-1, 2)
    miss = np.hypot(*(there + returned).T)
    landing = np.clip(np.round(target).astype(int), 0, np.array(size) - 1)
    good = (
        (miss < AGREE_PX)
        & (glare[y, x] == 0)
        & (glare_right[landing[:, 1], landing[:, 0]] == 0)
        & (seen[landing[:, 1], landing[:, 0]] > 0)
    )
    if not good.any():
        return _nothing()
    good &= np.abs(there[:, 1] - np.median(there[good, 1])) < ROW_PX
    unexplained = _unexplained(one, two, flow)
    good &= unexplained[y, x] < UNEXPLAINED * _SPREAD**2
    sigma = _sigma(one, unexplained[y, x], x, y, miss)
    good &= _near_surface(x / size[0], y / size[1], there[:, 0], good)
    left_px = np.stack([x + outer[0], y + outer[1]], axis=1).astype(np.float64)[good]
    right_px = target[good] @ shift[:, :2].T + shift[:, 2]
    return Matches(left_px=left_px, right_px=right_px, sigma_px=sigma[good])


def _nothing() -> Matches:
    return Matches(left_px=np.zeros((0, 2)), right_px=np.zeros((0, 2)), sigma_px=np.zeros(0))


def _even(picture: Image) -> npt.NDArray[np.uint8]:
    """Grey, with the slow change of light taken out: the two eyes see it differently."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    slow = cv2.GaussianBlur(grey, (0, 0), SLOW_PX)
    spread = np.sqrt(cv2.GaussianBlur((grey - slow) ** 2, (0, 0), 12.0)) + 1.0
    return np.clip(128.0 + _SPREAD * (grey - slow) / spread, 0, 255).astype(np.uint8)


def _flow(one: npt.NDArray[np.uint8], two: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    engine.setPatchSize(PATCH_PX)
    engine.setPatchStride(4)
    engine.setFinestScale(0)
    engine.setGradientDescentIterations(25)
    flow = engine.calc(one, two, np.zeros((*one.shape, 2), np.float32))
    return np.asarray(flow, dtype=np.float32)


def _unexplained(
    one: npt.NDArray[np.uint8], two: npt.NDArray[np.uint8], flow: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Mean square difference between each patch and the one it is matched with."""
    height, width = one.shape
    grid_x, grid_y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    moved = cv2.remap(two, grid_x + flow[..., 0], grid_y + flow[..., 1], cv2.INTER_LINEAR)
    difference = (moved.astype(np.float32) - one.astype(np.float32)) ** 2
    return np.asarray(cv2.boxFilter(difference, -1, (PATCH_PX, PATCH_PX)), dtype=np.float32)


def _sigma(
    one: npt.NDArray[np.uint8],
    unexplained: npt.NDArray[np.float32],
    x: npt.NDArray[np.intp],
    y: npt.NDArray[np.intp],
    miss: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Least-squares error of a shift along x: what the patch leaves unexplained over the slope it has to hold on to."""
    slope = cv2.Scharr(one, cv2.CV_32F, 1, 0, scale=1.0 / 32.0) ** 2
    hold = cv2.boxFilter(slope, -1, (PATCH_PX, PATCH_PX)) * PATCH_PX**2
    variance = SIGMA_SCALE**2 * unexplained / (hold[y, x] + 1.0) + 0.5 * miss**2 + 0.05**2
    return np.asarray(np.sqrt(variance), dtype=np.float64)


def _near_surface(
    x: npt.NDArray[np.float64],
    y: npt.NDArray[np.float64],
    disparity: npt.NDArray[np.float64],
    good: npt.NDArray[np.bool_],
) -> npt.NDArray[np.bool_]:
    """Whether each match lies near one cubic surface, fitted to those that agree with it."""
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    kept = good.copy()
    near = kept
    for limit in (4.0 * RELIEF_PX, 2.0 * RELIEF_PX, RELIEF_PX, RELIEF_PX):
        if kept.sum() < 4 * terms.shape[1]:
            return good
        surface, *_ = np.linalg.lstsq(terms[kept], disparity[kept], rcond=None)
        offset = disparity - terms @ surface
        near = np.abs(offset - np.median(offset[kept])) < limit
        kept = good & near
    return near
