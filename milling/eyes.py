"""Frames as evidence: fresh or nothing, checked at the boundary, and blind where the drill stands."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.camera.interface import Image, StereoCamera, StereoFrame
from drivers.clock import Clock
from drivers.errors import DetectionError, DeviceTimeoutError, SafetyStop
from drivers.recorder import Recorder

Floats = npt.NDArray[np.float64]

FRAME_AGE_S = 0.1
BAD_IN_A_ROW = 5
SHANK_MM = 12.0
SEEN, HIDDEN, BEHIND = "s", "h", "b"
RIGHT = {"left": "right", "look": "look_right"}
"""What the record calls a picture that is read, and what its right neighbour, which is there for people."""
HIDDEN_RADII = 1.25
"""The drill hides this many ball radii round its axis: shadow and blur included."""
FAR_RADII = 4.0
"""So far from its axis nothing can be the drill, were the calibration wrong by a millimetre; what a network takes for
it there is a clot, a pit, a reflection, and the bone round it is judged like any other."""


class Reading(Protocol):
    """What a picture says about the ring; see ``vision.completion``."""

    @property
    def completion(self) -> Floats:
        """(n,) best estimate."""

    @property
    def upper(self) -> Floats:
        """(n,) upper bound."""

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """(n,) False where the drill hides the point."""


class RingReader(Protocol):
    """Reads one ring from picture after picture; see ``vision.completion.RingReader``."""

    def read(self, image: Image) -> Reading:
        """Completion, its upper bound and visibility at each ring point."""


class CompletionReader(Protocol):
    """Reads rings; see ``vision.completion.CompletionReader``."""

    def over(self, ring_px: Floats, ball_px: float, *, reference: Image | None) -> RingReader:
        """A reader of one ring."""


def shown_as(visible: npt.NDArray[np.bool_], behind: npt.NDArray[np.bool_]) -> str:
    """A letter per point for the record: seen, hidden for the network, or behind the drill by calibration."""
    return "".join(np.where(behind, BEHIND, np.where(visible, SEEN, HIDDEN)))


class Projector(Protocol):
    """The part of a calibration that draws points."""

    def project(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Pixels in the left and the right picture of points in {R}."""


class Witness(Protocol):
    """Who takes the evidence."""

    def seen(self, index: int, *, completion: float, upper: float, exposed_at_s: float) -> None:
        """A frame shows the point."""


@dataclass(frozen=True, eq=False)
class RingView:
    """Where the ring and the drill are in the left picture."""

    projector: Projector
    ring_mm: Floats
    """(n, 3) on the unmilled surface under the ball's lowest point."""
    ball_radius_mm: float
    center_from_tip_mm: Floats

    @cached_property
    def ring_px(self) -> Floats:
        """(n, 2) in the left picture."""
        return self.projector.project(self.ring_mm)[0]

    @property
    def radius_px(self) -> float:
        """The ring's radius at the picture's mean scale."""
        return mean_radius(self.ring_px)

    @property
    def ball_px(self) -> float:
        """The ball's radius at that scale."""
        return self.ball_radius_mm * self.radius_px / mean_radius(self.ring_mm)

    def radii_off(self, tip_mm: Sequence[float]) -> Floats:
        """(n,) how far each point is from the axis of a drill at ``tip_mm``, ball and shank, in ball radii."""
        axis = self.center_from_tip_mm / np.linalg.norm(self.center_from_tip_mm)
        center = np.asarray(tip_mm, dtype=np.float64) + self.center_from_tip_mm
        beside = center + self.ball_radius_mm * np.array([0.0, 1.0, 0.0])
        ends = self.projector.project(np.stack([center, center + SHANK_MM * axis, beside]))[0]
        radius_px = float(np.linalg.norm(ends[2] - ends[0]))
        along = ends[1] - ends[0]
        offset = self.ring_px - ends[0]
        share = np.clip(offset @ along / float(along @ along), 0.0, 1.0)
        return np.asarray(np.linalg.norm(offset - share[:, None] * along, axis=1) / radius_px)

    def hidden(self, tip_mm: Sequence[float]) -> npt.NDArray[np.bool_]:
        """(n,) whether a drill at ``tip_mm`` may cover the point, ball or shank."""
        return np.asarray(self.radii_off(tip_mm) < HIDDEN_RADII)

    def inside(self, image: Image) -> npt.NDArray[np.bool_]:
        """(n,) whether the point lies in the picture."""
        limit = np.array([image.shape[1], image.shape[0]]) - 1
        return np.asarray(((self.ring_px >= 0) & (self.ring_px <= limit)).all(axis=1))


class Watch:
    """Turns frames into evidence. The age that counts is that of the exposure."""

    def __init__(
        self,
        camera: StereoCamera,
        reader: CompletionReader,
        view: RingView,
        reference: Image,
        witness: Witness,
        clock: Clock,
        recorder: Recorder,
    ) -> None:
        """``reference`` is the left picture of the unmilled skull."""
        self._camera = camera
        self._reader = reader.over(view.ring_px, view.ball_px, reference=reference)
        self._view = view
        self._witness = witness
        self._clock = clock
        self._recorder = recorder
        self._bad = 0
        self._index = -1
        self.frame_at_s = float("-inf")
        """Exposure of the newest frame that was read without fault."""
        self.completion = np.zeros(len(view.ring_mm))
        """(n,) the newest reading of each point, for people."""

    def glance(self, tip_mm: Sequence[float] | None) -> bool:
        """Read the freshest frame if it is new and young enough; whether it was.

        Raises:
            SafetyStop: several readings in a row make no sense.
        """
        frame = self._camera.latest()
        if frame is None or frame.index == self._index or self._clock.now_s() - frame.exposed_at_s > FRAME_AGE_S:
            return False
        self._read(frame, tip_mm)
        return True

    def stare(self, frames: int, tip_mm: Sequence[float]) -> None:
        """Read some new frames while the drill is aside.

        Raises:
            DeviceTimeoutError: the camera gives none.
            SafetyStop: the readings make no sense.
        """
        for _ in range(frames):
            self._read(self._camera.capture(), tip_mm, "look")

    def wait(self, timeout_s: float) -> None:
        """Wait for one fresh frame.

        Raises:
            DeviceTimeoutError: none in time.
        """
        frame = self._camera.capture(timeout_s)
        if self._clock.now_s() - frame.exposed_at_s > timeout_s:
            raise DeviceTimeoutError(f"camera: no fresh frame within {timeout_s:g} s")

    def _read(self, frame: StereoFrame, tip_mm: Sequence[float] | None, name: str = "left") -> None:
        self._index = frame.index
        try:
            reading = self._reader.read(frame.left)
            visible, behind = self._shown(reading, frame.left, tip_mm)
            completion, upper = self._checked(reading, visible)
        except DetectionError as error:
            self._bad += 1
            self._recorder.event("bad_reading", reason=str(error), in_a_row=self._bad)
            if self._bad >= BAD_IN_A_ROW:
                raise SafetyStop(f"{self._bad} readings in a row make no sense: {error}") from error
            return
        self._bad = 0
        self.frame_at_s = frame.exposed_at_s
        self._recorder.event(
            "reading",
            age_s=self._clock.now_s() - frame.exposed_at_s,
            completion=completion,
            upper=upper,
            shown=shown_as(visible, behind),
        )
        for index in np.flatnonzero(visible):
            self._witness.seen(
                int(index),
                completion=float(completion[index]),
                upper=float(upper[index]),
                exposed_at_s=frame.exposed_at_s,
            )
        self.completion = np.where(visible, completion, self.completion)
        self._recorder.frame(name, frame.left)
        self._recorder.frame(RIGHT[name], frame.right)

    def _shown(
        self, reading: Reading, image: Image, tip_mm: Sequence[float] | None
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """(n,) which points are seen, and which are behind a drill at ``tip_mm``, as far as that is known."""
        visible = np.asarray(reading.visible, dtype=bool)
        if visible.shape != (len(self._view.ring_mm),):
            raise DetectionError(f"visibility of shape {visible.shape}, ({len(self._view.ring_mm)},) is needed")
        if tip_mm is None:
            return visible, np.zeros_like(visible)
        off = self._view.radii_off(tip_mm)
        behind = off < HIDDEN_RADII
        return (visible | (off > FAR_RADII) & self._view.inside(image)) & ~behind, behind

    def _checked(self, reading: Reading, visible: npt.NDArray[np.bool_]) -> tuple[Floats, Floats]:
        if reading.completion.shape != visible.shape or reading.upper.shape != visible.shape:
            raise DetectionError(f"completion of shape {reading.completion.shape}, {visible.shape} is needed")
        seen = np.concatenate([reading.completion[visible], reading.upper[visible]])
        if not np.all(np.isfinite(seen)):
            raise DetectionError("a completion is NaN or infinite")
        if seen.size and (seen.min() < 0.0 or seen.max() > 1.0):
            raise DetectionError(f"completion from {seen.min():.3g} to {seen.max():.3g}, 0 to 1 is possible")
        return reading.completion, np.maximum(reading.upper, reading.completion)


def mean_radius(ring: Floats) -> float:
    """Mean distance of (n, k) points from their middle."""
    return float(np.linalg.norm(ring - ring.mean(axis=0), axis=1).mean())
