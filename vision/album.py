"""An album: a lab's own photographs in ``images/``, and beside them tables of what people saw in them.

``keypoints.csv`` has a row per picture: ``image`` and ``NAME_x_px``, ``NAME_y_px`` of each point. An empty pair is a
point that is not to be seen; ``?`` is one of which nobody has said anything, and the row then teaches nothing of it.
``rings.csv`` has a row per picture of a ring that is being milled: ``image``, its middle, radius and the ball's radius
in px, ``reference``, the picture of the same view before milling, empty where there is none, and ``completion``, 0 to 1
at each point of the ring, ``?`` where it cannot be told. Point k of n lies at the angle 2 pi k / n, from the right
downwards. Places are px from the middle of the top left pixel.
"""

import re
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from vision.runtime import Image

IMAGES = "images"
KEYPOINTS = "keypoints.csv"
RINGS = "rings.csv"
EXPORTED = "annotations/exported.json"
"""Whose labels the tables hold, when `mill annotate` wrote them."""
POINTS = {"landmarks": ("bregma", "lambda"), "tip": ("tip",)}
"""Points by task, as they are called in the columns of ``keypoints.csv``."""
RING_COLUMNS = ("image", "center_x_px", "center_y_px", "radius_px", "ball_px", "reference", "completion")
UNTOLD = "?"
SUFFIXES = {".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}
SMALLEST_PX = 64
FEWEST_RING_POINTS, MOST_RING_POINTS = 3, 360


def pictures_in(folder: Path) -> list[str]:
    """Names of the pictures of an album, relative to its ``images/``, 9.jpg before 10.jpg.

    Raises:
        ConfigError: there are none.
    """
    images = folder / IMAGES
    found = [path for path in images.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file()]
    names = [path.relative_to(images).as_posix() for path in found]
    if not names:
        kinds = ", ".join(sorted(SUFFIXES))
        raise ConfigError(f"{images}: found no pictures; put some there ({kinds})")
    return sorted(names, key=natural)


def read_picture(file: Path) -> Image:
    """(H, W, 3) RGB, turned as its camera says.

    Raises:
        ConfigError: it is no picture, or a tiny one.
    """
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if picture is None:
        raise ConfigError(f"{file}: is no picture that OpenCV can read; replace it, or remove its row")
    height, width = picture.shape[:2]
    if min(height, width) < SMALLEST_PX:
        raise ConfigError(f"{file}: {width}x{height} px; allowed: at least {SMALLEST_PX} px a side")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8)


def ring_points(center_px: tuple[float, float], radius_px: float, n: int) -> npt.NDArray[np.float64]:
    """(n, 2) the points of a ring in the picture."""
    angles = np.arange(n) * 2 * np.pi / n
    return np.array(center_px) + radius_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def natural(name: str) -> list[tuple[int, str]]:
    """Sorts 9.jpg before 10.jpg."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
