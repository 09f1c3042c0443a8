"""The right picture is made from the left one by a known map, so the truth is exact."""

import cv2
import numpy as np
import pytest

from vision import disparity
from vision.disparity import match

HEIGHT, WIDTH = 270, 480
AFFINE = np.array([[1.0, 0.01, -30.0], [0.005, 1.0, 4.0]])
REGION = (120.0, 60.0, 360.0, 210.0)


def texture(seed):
    rng = np.random.default_rng(seed)
    waves = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)), (0, 0), 1.5)
    waves += 0.7 * cv2.GaussianBlur(rng.normal(0, 4, (HEIGHT, WIDTH)), (0, 0), 4)
    waves = waves / waves.std()
    return np.clip(140 + waves[..., None] * np.array([24.0, 21.0, 18.0]), 0, 240).astype(np.float32)


def pair(relief, seed=0, noise=2.0):
    """A left picture, and the right one in which the left pixel (x, y) went to AFFINE @ (x + relief(x, y), y)."""
    left = texture(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    source = x.copy()
    for _ in range(20):
        moved = cv2.remap(relief.astype(np.float32), source, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        source = x - moved
    middle = cv2.remap(left, source, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    right = cv2.warpAffine(middle, AFFINE, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    rng = np.random.default_rng(seed + 1)
    return tuple(np.clip(p + rng.normal(0, noise, p.shape), 0, 255).astype(np.uint8) for p in (left, right))


def framed(relief, **changed):
    return tuple([picture] for picture in pair(relief, **changed))


def errors_of(matches, relief):
    at = matches.left_px.astype(int)
    moved = matches.left_px + np.stack([relief[at[:, 1], at[:, 0]], np.zeros(len(at))], axis=1)
    return matches.right_px - (moved @ AFFINE[:, :2].T + AFFINE[:, 2])


@pytest.fixture(scope="module")
def waves():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return 3 + 2 * np.sin(x / 60) + 0.004 * (y - HEIGHT / 2)


def test_relief_is_found_to_a_fraction_of_a_pixel_with_an_honest_sigma(waves):
    matches = match(*framed(waves), right_from_left=AFFINE, region=REGION)
    errors = errors_of(matches, waves)
    assert len(matches.left_px) > 0.95 * 120 * 75
    assert np.sqrt((errors**2).mean(axis=0)) == pytest.approx([0, 0], abs=0.08)
    assert abs(errors[:, 0].mean()) < 0.02
    assert 0.5 < np.sqrt(np.mean((errors[:, 0] / matches.sigma_px) ** 2)) < 1.5
    assert (matches.left_px >= REGION[:2]).all()
    assert (matches.left_px < REGION[2:]).all()


def test_sigma_grows_with_noise(waves):
    quiet = match(*framed(waves, noise=1.0), right_from_left=AFFINE, region=REGION)
    loud = match(*framed(waves, noise=8.0), right_from_left=AFFINE, region=REGION)
    assert np.median(loud.sigma_px) > 1.5 * np.median(quiet.sigma_px)


def test_glare_is_left_out(waves):
    left, right = pair(waves)
    left[100:120, 200:230] = 255
    matches = match([left], [right], right_from_left=AFFINE, region=REGION)
    x, y = matches.left_px.T
    assert not ((x >= 200) & (x < 230) & (y >= 100) & (y < 120)).any()
    assert len(matches.left_px) > 0.7 * 120 * 75


def test_a_thing_far_above_the_surface_is_left_out(waves):
    relief = waves.copy()
    relief[110:150, 220:260] += 14.0
    matches = match(*framed(relief), right_from_left=AFFINE, region=REGION)
    x, y = matches.left_px.T
    # Its left rim shows the ground once more in these pictures, and is rightly matched as ground.
    on_it = (x >= 236) & (x < 254) & (y >= 116) & (y < 144)
    assert (on_it & (matches.sigma_px < 0.2)).sum() < 3
    assert on_it.sum() < 0.25 * 9 * 14
    far = (np.abs(x - 240) > 50) | (np.abs(y - 130) > 50)
    assert np.sqrt(np.mean(errors_of(matches, relief)[far, 0] ** 2)) < 0.12


def test_pictures_of_different_things_do_not_match():
    left, _ = pair(np.zeros((HEIGHT, WIDTH)), seed=1)
    _, right = pair(np.zeros((HEIGHT, WIDTH)), seed=50)
    matches = match([left], [right], right_from_left=AFFINE, region=REGION)
    assert len(matches.left_px) < 0.3 * 120 * 75


def test_an_empty_region_has_no_matches():
    left, right = pair(np.zeros((HEIGHT, WIDTH)))
    assert len(match([left], [right], region=(900.0, 10.0, 950.0, 50.0)).left_px) == 0


def test_a_dome_is_not_laid_too_low():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    dome = 12.0 - 2.5e-3 * ((x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2) / 2
    matches = match(*framed(dome), right_from_left=AFFINE, region=REGION)
    assert abs(errors_of(matches, dome)[:, 0].mean()) < 0.02


def reddish(picture, seed):
    """Texture in red alone, as blood in bone has it, over the grey one."""
    waves = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 14, picture.shape[:2]), (0, 0), 1.5) * 4.0
    return np.clip(picture * [1.2, 0.8, 0.7] + waves[..., None] * [1.0, 0.0, 0.0], 0, 235).astype(np.uint8)


def with_glints(picture, places):
    layer = np.zeros(picture.shape[:2], np.float32)
    for px, py in places:
        cv2.circle(layer, (round(16 * px), round(16 * py)), 24, 0.22, -1, cv2.LINE_AA, 4)
    # White light adds to what is there, in linear light.
    return np.round(255 * np.clip((picture / 255) ** 2.2 + layer[..., None], 0, 0.95) ** (1 / 2.2)).astype(np.uint8)


def test_highlights_that_lie_too_deep_mislead_less_than_grey_alone(monkeypatch):
    flat = np.zeros((HEIGHT, WIDTH))
    left, _ = pair(flat, noise=0.0)
    left = reddish(left, 3)
    right = cv2.warpAffine(left, AFFINE, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    places = np.random.default_rng(4).uniform((100, 40), (380, 230), (900, 2))
    glossy = with_glints(left, places)
    glossy_right = with_glints(right, (places - [1.5, 0.0]) @ AFFINE[:, :2].T + AFFINE[:, 2])
    everything = match([glossy], [glossy_right], right_from_left=AFFINE, region=REGION)
    monkeypatch.setattr(disparity, "VIEWS", disparity.VIEWS[:1])
    grey = match([glossy], [glossy_right], right_from_left=AFFINE, region=REGION)
    bias, bias_of_grey = (errors_of(matches, flat)[:, 0].mean() for matches in (everything, grey))
    assert bias_of_grey < -0.1
    assert abs(bias) < 0.6 * abs(bias_of_grey)


def test_a_picture_without_colour_is_matched_as_well_as_its_grey(waves):
    left, right = (np.repeat(cv2.cvtColor(p, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2) for p in pair(waves))
    errors = errors_of(match([left], [right], right_from_left=AFFINE, region=REGION), waves)
    assert np.sqrt((errors**2).mean(axis=0)) == pytest.approx([0, 0], abs=0.08)
