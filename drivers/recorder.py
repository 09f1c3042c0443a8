"""What calib and milling write their events to."""

import contextlib
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from drivers.trace_file import Trace


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


class ForgivingRecorder:
    """Passes everything on, and goes on where the disk takes no more: a safe machine comes before its record."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def event(self, kind: str, **fields: Any) -> None:
        """Pass it on, if that can be."""
        with contextlib.suppress(OSError):
            self._recorder.event(kind, **fields)

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Pass it on, if that can be."""
        with contextlib.suppress(OSError):
            self._recorder.frame(name, image)


class TracedRecorder:
    """Passes everything on, and writes the events into a trace as well."""

    def __init__(self, recorder: Recorder, trace: Trace) -> None:
        self._recorder = recorder
        self._trace = trace

    def event(self, kind: str, **fields: Any) -> None:
        """Into both."""
        self._trace.event(kind, **fields)
        self._recorder.event(kind, **fields)

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Pass it on."""
        self._recorder.frame(name, image)
