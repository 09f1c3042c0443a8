"""What networks would say of a picture: somewhere to begin, for a person to accept or move."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from annotate.labels import Ring
from drivers.errors import ConfigError
from vision.album import POINTS, ring_points
from vision.completion import CompletionReader
from vision.keypoints import Keypoint, LandmarkFinder, TipFinder, letterboxed
from vision.runtime import TASKS, WEIGHTS, Image, read_manifest, verify

Suggested = dict[str, dict[str, float]]


class Suggester:
    """The networks of mill, or others in their place; each is loaded when it is first asked."""

    def __init__(self, weights: Sequence[Path] = ()) -> None:
        """``weights`` tell by the manifest beside them what they are for.

        Raises:
            ConfigError: a file is missing, is not what its manifest says, or two are for the same.
        """
        self._weights = {task: WEIGHTS / f"{task}.onnx" for task in TASKS}
        given: dict[str, Path] = {}
        for file in weights:
            task = read_manifest(file.parent).get(file.name, {}).get("task", file.stem)
            if task not in TASKS:
                raise ConfigError(f"{file}: for what it was trained is not known; allowed: {', '.join(TASKS)}")
            if task in given:
                raise ConfigError(f"{file}: {given[task]} is for {task} as well; name one of them")
            verify(file, task)
            given[task] = file
        self._weights |= given
        self._loaded: dict[str, Any] = {}

    def points(self, task: str, picture: Image) -> Suggested:
        """Places of the points of ``task`` that are seen: ``x_px``, ``y_px`` and ``sigma_px`` by name."""
        if task == "landmarks":
            found: Sequence[Keypoint] = self._of("landmarks").find(picture)
            scale, corner = 1.0, np.zeros(2)
        else:
            boxed, scale, corner = letterboxed(picture)
            found = [self._of("tip").find(boxed)]
        told: Suggested = {}
        for name, each in zip(POINTS[task], found, strict=True):
            x, y = (np.array([each.x_px, each.y_px]) - corner) / scale
            if each.visible and 0 <= x <= picture.shape[1] - 1 and 0 <= y <= picture.shape[0] - 1:
                told[name] = {"x_px": float(x), "y_px": float(y), "sigma_px": each.sigma_px / scale}
        return told

    def ring(self, ring: Ring, picture: Image, reference: Image | None) -> list[float | None]:
        """Completion at each point of a ring, None where the network would not say."""
        points = ring_points((ring.center_x_px, ring.center_y_px), ring.radius_px, len(ring.completion))
        read = self._of("completion").over(points, ring.ball_px, reference=reference).read(picture)
        return [float(v) if seen else None for v, seen in zip(read.completion, read.visible, strict=True)]

    def _of(self, task: str) -> Any:
        if task not in self._loaded:
            kinds: dict[str, Any] = {"landmarks": LandmarkFinder, "tip": TipFinder, "completion": CompletionReader}
            self._loaded[task] = kinds[task].load(self._weights[task])
        return self._loaded[task]
