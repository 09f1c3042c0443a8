"""Which pixel of the right picture shows what a pixel of the left one shows, to a fraction of a pixel.

Classical on purpose: dense inverse search (DIS) in both directions, kept only where the two agree. It knows no
millimetre. The right picture is first warped to the left one's rows by an affine map, so what is left to find is
small: the relief of the bone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

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
WORSE = 2.0
"""A view of the colours that is less sure than grey by more than this tells nothing: there is no colour in it."""
LEAST_FOR_DOME = 200
"""Matches from which the dome is taken out."""
STILL_MATCHED = 0.8
"""Share of them that must be found again without it."""
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
    lefts: Sequence[Image],
    rights: Sequence[Image],
    *,
    right_from_left: npt.NDArray[np.float64] | None = None,
    region: tuple[float, float, float, float] | None = None,
) -> Matches:
    """Match a region of the left picture with the right picture.

    Args:
        lefts: (H, W, 3) each, of one scene; their mean is what is matched.
        rights: (H, W, 3) each.
        right_from_left: (2, 3) affine that takes left pixels to right pixels for a plane near the surface; identity
            where None.
        region: x0, y0, x1, y1 in left pixels; the whole picture where None.

    Returns:
        Matches on a grid of ``STEP_PX``; fewer than asked for, even none, where the pictures do not agree.
    """
    left, right = averaged(lefts), averaged(rights)
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
    window = left[outer[1] : outer[3], outer[0] : outer[2]]
    frame = _Frame(affine, outer)
    first = _compared(window, right, frame, inner)
    if len(first.at_px) < LEAST_FOR_DOME:
        return first.matches(frame)
    # What smooths a dome lays it too low: with the dome taken out of the picture there is nothing left to bend.
    domed = replace(frame, dome=_dome(first, frame))
    second = _compared(window, right, domed, inner)
    if len(second.at_px) < STILL_MATCHED * len(first.at_px):
        # The cubic through matches on one side may run wild on the other.
        return first.matches(frame)
    return second.matches(domed)


@dataclass(frozen=True, eq=False)
class _Frame:
    """Where the right picture shows what a window of the left one shows, as far as it is known."""

    affine: npt.NDArray[np.float64]
    outer: tuple[int, int, int, int]
    """x0, y0, x1, y1 of the window in the left picture."""
    dome: npt.NDArray[np.float64] | None = None
    """(terms, 2) shift within the window before ``affine``, see ``_terms``."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the window."""
        return self.outer[2] - self.outer[0], self.outer[3] - self.outer[1]

    def right_px(self, at_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(n, 2) in the right picture of (n, 2) in the window."""
        moved = at_px if self.dome is None else at_px + _terms(at_px, self.size) @ self.dome
        return np.asarray((moved + self.outer[:2]) @ self.affine[:, :2].T + self.affine[:, 2])

    def warped(self, right: Image) -> tuple[Image, npt.NDArray[np.bool_]]:
        """The right picture as the window would show it, and where there is one."""
        rows, columns = np.mgrid[: self.size[1], : self.size[0]]
        places = self.right_px(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64))
        x, y = (places[:, k].reshape(rows.shape).astype(np.float32) for k in (0, 1))
        seen = (x >= 0) & (y >= 0) & (x <= right.shape[1] - 1) & (y <= right.shape[0] - 1)
        return cv2.remap(right, x, y, cv2.INTER_CUBIC, borderValue=(0, 0, 0)).astype(np.uint8), seen


@dataclass(frozen=True, eq=False)
class _Pairs:
    """(n, 2) places in the window and in the warped right picture that match, and the error to expect."""

    at_px: npt.NDArray[np.float64]
    to_px: npt.NDArray[np.float64]
    sigma_px: npt.NDArray[np.float64]

    def matches(self, frame: _Frame) -> Matches:
        """The same in pixels of both pictures."""
        return Matches(self.at_px + frame.outer[:2], frame.right_px(self.to_px), self.sigma_px)


def _compared(left: Image, right: Image, frame: _Frame, inner: tuple[int, int, int, int]) -> _Pairs:
    """Match the window in each of ``VIEWS``; of each place, the mean of what they tell."""
    warped, seen = frame.warped(right)
    grid = np.mgrid[
        inner[1] - frame.outer[1] : inner[3] - frame.outer[1] : STEP_PX,
        inner[0] - frame.outer[0] : inner[2] - frame.outer[0] : STEP_PX,
    ]
    y, x = (axis.ravel() for axis in grid)
    clear, clear_right = ~_glares(left), ~_glares(warped) & seen
    found = [_in_view(_even(view(left)), _even(view(warped)), x, y, clear, clear_right) for view in VIEWS]
    limit = WORSE * _median(found[0][1])
    told = [view for k, view in enumerate(found) if k == 0 or _median(view[1]) <= limit]
    # Views share their pixels: their mean is no surer than they are, and one place stays one match.
    there, sigma = (np.ma.mean(np.ma.masked_invalid([view[k] for view in told]), axis=0).filled(np.nan) for k in (0, 1))
    good = np.isfinite(sigma)
    at_px = np.stack([x, y], axis=1).astype(np.float64)[good]
    return _Pairs(at_px, at_px + there[good], sigma[good])


def _in_view(
    one: npt.NDArray[np.uint8],
    two: npt.NDArray[np.uint8],
    x: npt.NDArray[np.intp],
    y: npt.NDArray[np.intp],
    clear: npt.NDArray[np.bool_],
    clear_right: npt.NDArray[np.bool_],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Shift (n, 2) and the error to expect (n,) at each (x, y); NaN where nothing matches without doubt."""
    size = (one.shape[1], one.shape[0])
    flow, back = _flow(one, two), _flow(two, one)
    there = flow[y, x].astype(np.float64)
    at = np.stack([x, y], axis=1).astype(np.float64)
    target = at + there
    returned = cv2.remap(
        back, target[:, 0].astype(np.float32), target[:, 1].astype(np.float32), cv2.INTER_LINEAR, borderValue=(1e3, 1e3)
    ).reshape(-1, 2)
    miss = np.hypot(*(there + returned).T)
    landing = np.clip(np.round(target).astype(int), 0, np.array(size) - 1)
    good = (miss < AGREE_PX) & clear[y, x] & clear_right[landing[:, 1], landing[:, 0]]
    if not good.any():
        return np.full_like(there, np.nan), np.full(len(there), np.nan)
    good &= np.abs(there[:, 1] - np.median(there[good, 1])) < ROW_PX
    unexplained = _unexplained(one, two, flow)
    good &= unexplained[y, x] < UNEXPLAINED * _SPREAD**2
    sigma = _sigma(one, unexplained[y, x], x, y, miss)
    good &= _near_surface(_terms(at, size), there[:, 0], good)
    return np.where(good[:, None], there, np.nan), np.where(good, sigma, np.nan)


def _median(values: npt.NDArray[np.float64]) -> float:
    """Of those that are there."""
    return float(np.nanmedian(values)) if np.isfinite(values).any() else np.inf


def _terms(at_px: npt.NDArray[np.float64], size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """(n, terms) of a cubic over the window."""
    x, y = at_px[:, 0] / size[0], at_px[:, 1] / size[1]
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def _dome(pairs: _Pairs, frame: _Frame) -> npt.NDArray[np.float64]:
    """(terms, 2) of the smooth shift that the pairs tell of."""
    shift = pairs.to_px - pairs.at_px
    return np.asarray(np.linalg.lstsq(_terms(pairs.at_px, frame.size), shift, rcond=None)[0])


def _glares(picture: Image) -> npt.NDArray[np.bool_]:
    return cv2.dilate((picture.min(axis=2) >= GLARE).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0


def _nothing() -> Matches:
    return Matches(left_px=np.zeros((0, 2)), right_px=np.zeros((0, 2)), sigma_px=np.zeros(0))


def _grey(picture: Image) -> npt.NDArray[np.float32]:
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _without(channel: int) -> Callable[[Image], npt.NDArray[np.float32]]:
    """Red less another channel, in linear light: highlights, being white, are not in it."""
    linear = (256.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.float32)

    def view(picture: Image) -> npt.NDArray[np.float32]:
        return np.asarray(linear[picture[..., 0]] - linear[picture[..., channel]], dtype=np.float32)

    return view


VIEWS = (_grey, _without(1), _without(2))
"""A highlight on a dome is the light's mirror image below it: it matches, and lies too deep. Grey has the least noise,
the differences of colours have no highlights; what is wrong with one is not wrong with the others."""


def _even(view: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """With the slow change of light taken out, which the two eyes see differently, and of one contrast everywhere."""
    slow = cv2.GaussianBlur(view, (0, 0), SLOW_PX)
    spread = np.sqrt(cv2.GaussianBlur((view - slow) ** 2, (0, 0), 12.0)) + 1.0
    return np.clip(128.0 + _SPREAD * (view - slow) / spread, 0, 255).astype(np.uint8)


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
    # Whole numbers are off by a third; where there is no slope at all, not even that can be told from a shift.
    variance = SIGMA_SCALE**2 * (unexplained + 0.3) / (hold[y, x] + 0.3) + 0.5 * miss**2 + 0.05**2
    return np.asarray(np.sqrt(variance), dtype=np.float64)


def _near_surface(
    terms: npt.NDArray[np.float64], disparity: npt.NDArray[np.float64], good: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Whether each match lies near one cubic surface, fitted to those that agree with it."""
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
