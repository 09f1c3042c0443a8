"""A recorder whose disk fails on purpose: full, or slow now and then."""

import errno
import os
from collections.abc import Sequence
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from drivers.clock import Clock
from firmware_sim.faults import Fault

_SLOW_EVERY_S: Final = 1.0


class Recorder(Protocol):
    """As ``drivers.recorder.Recorder``."""

    def event(self, kind: str, **fields: Any) -> None:
        """Append one event."""

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Keep one picture."""


class FaultyDisk:
    """Stands before the real recorder; the faults' time counts from when the drill is first told to be at speed."""

    def __init__(self, recorder: Recorder, faults: Sequence[Fault], clock: Clock) -> None:
        """``faults`` of the ``disk`` family count, others do not."""
        self._recorder = recorder
        self._faults = [fault for fault in faults if fault.name.startswith("disk.")]
        self._clock = clock
        self._turning_since_s: float | None = None
        self._slow_at_s = float("-inf")
        self._told = False

    def event(self, kind: str, **fields: Any) -> None:
        """Append one event, if the disk takes it.

        Raises:
            OSError: it is full; told once, as ``milling.record`` tells it.
        """
        if kind == "spindle" and self._turning_since_s is None:
            self._turning_since_s = self._clock.now_s()
        for fault in self._faults:
            if not self._has_begun(fault):
                continue
            if fault.name == "disk.full":
                if not self._told:
                    self._told = True
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "events.jsonl")
                return
            if self._clock.now_s() - self._slow_at_s >= _SLOW_EVERY_S:
                self._clock.sleep_s(fault.value)
                self._slow_at_s = self._clock.now_s()
        self._recorder.event(kind, **fields)

    def frame(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Keep one picture."""
        self._recorder.frame(name, image)

    def _has_begun(self, fault: Fault) -> bool:
        if fault.after_s is None:
            return True
        return self._turning_since_s is not None and self._clock.now_s() - self._turning_since_s >= fault.after_s
