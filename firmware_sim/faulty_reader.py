"""A completion reader that is wrong on purpose: late, NaN, blind to a hole, seeing one everywhere, or frozen once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from drivers.clock import Clock
from firmware_sim.faults import Fault

_DOUBT = 0.05
"""Between a completion that is held low and its upper bound."""


class RingReader(Protocol):
    """Reads one ring; answers with completion, upper and visible, (n,) each."""

    def read(self, image: npt.NDArray[np.uint8]) -> Any:
        """Of one picture."""


class Reader(Protocol):
    """Makes readers of rings."""

    def over(
        self, ring_px: npt.NDArray[np.float64], ball_px: float, *, reference: npt.NDArray[np.uint8] | None
    ) -> RingReader:
        """Of one ring."""


@dataclass(frozen=True)
class _Answer:
    completion: npt.NDArray[np.float64]
    upper: npt.NDArray[np.float64]
    visible: npt.NDArray[np.bool_]


class FaultyReader:
    """Stands before the real reader; the faults' time counts from where a ring is first read."""

    def __init__(self, reader: Reader, faults: Sequence[Fault], clock: Clock, *, seed: int) -> None:
        """``faults`` of the families ``vision`` and ``host``.

        ``seed`` chooses where one point or an arc lies, and a value of a range.
        """
        self._reader = reader
        self._faults = [fault.drawn(seed) for fault in faults]
        self._clock = clock
        self._seed = seed

    def over(
        self, ring_px: npt.NDArray[np.float64], ball_px: float, *, reference: npt.NDArray[np.uint8] | None
    ) -> "_FaultyRing":
        """A reader of one ring."""
        ring = self._reader.over(ring_px, ball_px, reference=reference)
        return _FaultyRing(ring, self._faults, self._clock, len(ring_px), self._seed)


class _FaultyRing:
    def __init__(self, ring: RingReader, faults: Sequence[Fault], clock: Clock, n: int, seed: int) -> None:
        self._ring = ring
        self._faults = faults
        self._clock = clock
        self._started_s = clock.now_s()
        self._first = int(np.random.default_rng([seed, 4712]).integers(n))
        self._n = n
        self._paused = False

    def read(self, image: npt.NDArray[np.uint8]) -> _Answer:
        """What the reader says, spoiled by every fault that has begun."""
        reading = self._ring.read(image)
        completion, upper = np.array(reading.completion), np.array(reading.upper)
        since_s = self._clock.now_s() - self._started_s
        for fault in self._faults:
            if fault.after_s is not None and since_s < fault.after_s:
                continue
            reached = self._reached(fault)
            if fault.name == "vision.low":
                completion[reached] = np.minimum(completion[reached], fault.value)
                upper[reached] = np.minimum(upper[reached], min(1.0, fault.value + _DOUBT))
            elif fault.name == "vision.high":
                completion[reached], upper[reached] = 1.0, 1.0
            elif fault.name == "vision.nan":
                completion[:] = np.nan
            elif fault.name == "vision.slow":
                self._clock.sleep_s(fault.value)
            elif fault.name == "host.stop" and not self._paused:
                self._paused = True
                self._clock.sleep_s(fault.value)
        return _Answer(completion, upper, np.asarray(reading.visible))

    def _reached(self, fault: Fault) -> npt.NDArray[np.intp]:
        count = {"one": 1, "arc": max(1, self._n // 4), "all": self._n}.get(fault.reach, self._n)
        return np.asarray((self._first + np.arange(count)) % self._n, dtype=np.intp)
