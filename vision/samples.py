"""What networks learn from: arrays of samples on disk, and the same picture under another light."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from vision.runtime import Image

Data = Mapping[str, npt.NDArray[Any]]
Arrays = Mapping[str, tuple[tuple[int | None, ...], str]]
"""What a data set must have: shape of one sample (None: any size) and NumPy's kind of number, by name."""


def load_data(folder: Path, split: str, task: str, arrays: Arrays) -> Data:
    """The arrays of ``folder/split``, mapped rather than read.

    Raises:
        ConfigError: there are none, they are damaged, or they are not what ``task`` learns from, which is ``arrays``.
    """
    files = {file.stem: file for file in sorted((folder / split).glob("*.npy"))}
    if not files:
        raise ConfigError(f"{folder / split}: found no .npy arrays; leave --data out to have pictures rendered")
    data: dict[str, npt.NDArray[Any]] = {}
    for name, (sizes, kind) in arrays.items():
        if name not in files:
            raise ConfigError(f"{folder / split}: no {name}.npy; is this a data set for {task}? Make it anew")
        try:
            data[name] = np.load(files[name], mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise ConfigError(f"{files[name]}: cannot be read: {error}; make the data set anew") from None
        found = data[name]
        fits = found.ndim == len(sizes) + 1 and found.dtype.kind == kind
        if not fits or any(size not in (None, have) for size, have in zip(sizes, found.shape[1:], strict=True)):
            wanted = ", ".join("any" if size is None else str(size) for size in ("N", *sizes))
            raise ConfigError(
                f"{files[name]}: {found.dtype} of shape {found.shape}; {task} takes ({wanted}); make the data set anew"
            )
    lengths = {len(array) for array in data.values()}
    if len(lengths) != 1 or lengths == {0}:
        raise ConfigError(f"{folder / split}: arrays of {sorted(lengths)} samples; allowed: as many in each, and some")
    return data


def relit(picture: Image, rng: np.random.Generator) -> Image:
    """The same picture under another light and through another camera: gain, gamma, tint, haze, blur, noise."""
    level = np.arange(256, dtype=np.float32) / 255.0
    gamma = np.exp(rng.uniform(-0.35, 0.35))
    gain = np.exp(rng.uniform(-0.25, 0.25) + rng.uniform(-0.1, 0.1, size=picture.shape[2]))
    offset = rng.uniform(-0.05, 0.05)
    table = np.clip(255.0 * (gain[None, :] * level[:, None] ** gamma + offset), 0, 255).astype(np.uint8)
    result = np.stack([cv2.LUT(picture[..., c], table[:, c]) for c in range(picture.shape[2])], axis=-1)
    if rng.random() < 0.25:
        result = cv2.GaussianBlur(result, (0, 0), rng.uniform(0.4, 1.6))
    if rng.random() < 0.3:
        noise = rng.normal(0.0, rng.uniform(1.0, 5.0), size=picture.shape).astype(np.float32)
        result = np.clip(result + noise, 0, 255)
    return np.asarray(result, dtype=np.uint8)
