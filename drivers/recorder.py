"""What calib and milling write their events to."""

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt


class Recorder(Protocol):
    """Takes events in the order they happened; the caller's clock stamps them."""

    def event(self, kind: str, **fields: Any) -> None:
        """Append one event. Fields are JSON: numbers, strings, booleans, None, lists and dicts of these."""

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Keep one picture, (H, W, 3) uint8 RGB. Pictures are the first thing dropped when the disk fills."""


class NullRecorder:
    """Keeps nothing."""

    def event(self, kind: str, **fields: Any) -> None:
        """Drop the event."""

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Drop the picture."""
