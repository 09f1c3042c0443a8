"""Where a window stands whose run has ended too early, as the run's journal tells: what `mill resume` goes on from.

The journal is evidence and not truth: before anything is cut, the skull must lie where it lay, and the tip must feel
the kerf's floor where the journal says it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.camera.interface import Image
from drivers.errors import ConfigError, PlanError, SafetyStop
from drivers.recorder import Recorder
from milling.contact import ContactFinder
from milling.job import Job
from milling.load import LoadMeter
from milling.permission import Ledger
from milling.record import Run
from milling.thickness import Thickness
from milling.trajectory import Trajectory

Floats = npt.NDArray[np.float64]

MOVED_PX = 2.0
"""Most that the pictures of the skull may have shifted."""
FLOOR_MM = 0.04
"""Most that the kerf's floor may be felt off the journal: two steps of contact, run-out, a pass that was not told."""
SURE_MM, SURE = 0.03, 0.05
"""A floor may be touched where the bone is that thick below it, but for this probability."""
LEAST_TOUCHED, MOST_TOUCHED = 3, 6
ABOVE_MM = 0.08
"""Over the floor, where touching it begins."""
ACROSS_MM = 3.0
"""Over the highest start, on the way from one place to the next."""
_EVIDENCE = ("cut", "pass", "looked")


@dataclass(frozen=True, eq=False)
class Standing:
    """A ring, its contacts, and everything that was felt and seen of it."""

    trajectory: Trajectory
    top_z_mm: tuple[float, ...]
    """(n,) height of the tip at contact."""
    reference: Image
    """The left picture of the unmilled skull."""
    evidence: tuple[dict[str, Any], ...]
    """Events of the journal, oldest first."""

    def ledger(self, job: Job) -> Ledger:
        """All permits as they stood. It takes a while: not with the drill in the bone."""
        ledger = Ledger(
            job.n_points, job.limits, Thickness(job.n_points, job.limits, pitch_mm=self.trajectory.pitch_mm)
        )
        for index in range(job.n_points):
            ledger.touched(index)
        depth_mm = [0.0] * job.n_points
        for event in self.evidence:
            match event["kind"]:
                case "cut":
                    depth_mm[event["point"] - 1] = event["depth_mm"]
                    ledger.recall(event["point"] - 1, depth_mm=event["depth_mm"])
                case "pass":
                    index = event["point"] - 1
                    ledger.recall(index, depth_mm=depth_mm[index], ratio=event.get("ratio"))
                    ledger.restore(index, event["known"])
                case "looked":
                    for index, known in enumerate(event["known"]):
                        ledger.restore(index, known)
        return ledger

    def recall_loads(self, meter: LoadMeter) -> None:
        """What bone took at each point, as far as it was known."""
        for event in self.evidence:
            if event["kind"] == "pass" and event.get("sound") is not None:
                meter.recall(event["point"] - 1, event["sound"])

    def tell(self, recorder: Recorder) -> None:
        """Enter the evidence into a new record, so that this is whole by itself."""
        for event in self.evidence:
            recorder.event(event["kind"], **{key: event[key] for key in event if key not in {"t", "kind"}})


def standing_of(run: Run, job: Job) -> Standing:
    """Read a journal.

    Raises:
        ConfigError: the run cannot be resumed, and why.
    """
    no = f"{run.folder}: cannot be resumed: "
    if run.result is not None and run.result["outcome"] == "complete":
        raise ConfigError(no + "its window is complete; the flap can be lifted")
    if job.policy != "default":
        raise ConfigError(no + f"policy {job.policy!r} felt nothing and kept no depth from contact")
    told = list(run.of_kind("trajectory"))
    contacts = {event["point"]: event["z_mm"] for event in run.of_kind("contact")}
    if not told or len(contacts) < job.n_points:
        earlier = run.header.get("resumes")
        step = f"resume {earlier} again" if earlier else "nothing is milled; start a new run"
        raise ConfigError(no + f"it ended before all contacts were known; {step}")
    if any("medians" not in event["known"] for event in run.of_kind("pass")):
        raise ConfigError(
            no + "an earlier version of mill recorded it, which kept less of every point; finish it by hand"
        )
    reference = _reference(run)
    if reference is None:
        raise ConfigError(no + "the picture of the unmilled skull is not in the record")
    if not any(event["kind"] == "cut" for event in run.events):
        raise ConfigError(no + "no cut is in its journal; start a new run")
    ring = {key: np.array(told[-1][key]) for key in ("center_mm", "fit_mm", "normals", "sigma_mm", "ball_mm", "tip_mm")}
    trajectory = Trajectory(
        theta_rad=2 * pi * np.arange(1, job.n_points + 1) / job.n_points,
        offset_mm=told[-1]["offset_mm"],
        contact_z_mm=np.array(told[-1]["contact_z_mm"]),
        note=told[-1]["note"],
        **ring,
    )
    evidence = tuple(event for event in run.events if event["kind"] in _EVIDENCE)
    return Standing(trajectory, tuple(contacts[i] for i in range(1, job.n_points + 1)), reference, evidence)


def _reference(run: Run) -> Image | None:
    import cv2

    files = [event["file"] for event in run.of_kind("frame") if event["name"] == "reference_left"]
    picture = cv2.imread(str(run.folder / files[-1]), cv2.IMREAD_COLOR) if files else None
    return None if picture is None else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def require_unmoved(standing: Standing, now: Image, ring_px: Floats) -> float:
    """How far the skull's picture has shifted outside the ring, px.

    Raises:
        PlanError: too far, or the pictures show different things.
    """
    import cv2

    middle, radius = ring_px.mean(axis=0), 1.4 * float(np.linalg.norm(ring_px - ring_px.mean(axis=0), axis=1).mean())
    y, x = np.mgrid[: now.shape[0], : now.shape[1]]
    outside = np.hypot(x - middle[0], y - middle[1]) > radius
    before, after = (_masked(picture, outside) for picture in (standing.reference, now))
    (dx, dy), agreement = cv2.phaseCorrelate(before, after, cv2.createHanningWindow(before.shape[::-1], cv2.CV_64F))
    shift_px = float(np.hypot(dx, dy))
    if not (shift_px <= MOVED_PX and agreement > 0.05):
        raise PlanError(
            f"the skull is not where it was: its picture has shifted by {shift_px:.1f} px (agreement {agreement:.2f}), "
            f"allowed {MOVED_PX:g} px; this window must be finished by hand"
        )
    return shift_px


def _masked(picture: Image, keep: npt.NDArray[np.bool_]) -> Floats:
    import cv2

    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float64)
    # Structure, not light: a lamp that was moved a little is no skull that was.
    grey -= cv2.GaussianBlur(grey, (0, 0), 12.0)
    return np.asarray(np.where(keep, grey, 0.0))


def touch_again(
    standing: Standing, ledger: Ledger, finder: ContactFinder, told: Callable[[int, float], None]
) -> list[float]:
    """Contact heights (n,) in today's coordinates, from feeling the kerf's floor at a few points.

    A floor that is felt higher than the journal says lifts them. One that is felt lower may be a pass that the journal
    lost: then all points count as cut so much deeper.

    Raises:
        PlanError: too few points have bone below for certain, or bone is met where the kerf should be, or none at all.
        SafetyStop: the floor is not where the journal says.
    """
    chosen = _surely_bone(ledger)
    if len(chosen) < LEAST_TOUCHED:
        raise PlanError(
            f"bone is left for certain under {len(chosen)} points, {LEAST_TOUCHED} are needed to feel where the tip "
            "stands; finish this window by hand"
        )
    floor = [standing.top_z_mm[index] - ledger.cut_mm(index) for index in chosen]
    places = [(float(x), float(y)) for x, y in standing.trajectory.tip_mm[chosen, :2]]
    off: list[float] = []

    def judge(at: int, z: float) -> None:
        off.append(z - floor[at])
        if abs(off[at]) > FLOOR_MM:
            raise SafetyStop(
                f"point {chosen[at] + 1}: the kerf's floor is felt {1e3 * off[at]:+.0f} um off the journal, allowed "
                f"{1e3 * FLOOR_MM:.0f} um; this window must be finished by hand"
            )
        told(chosen[at], z)

    finder.find_all(
        places,
        [z + ABOVE_MM for z in floor],
        floor,
        judge,
        # Between two places of the kerf lies bone, and the flap stands higher than its rim.
        across_z_mm=float(standing.trajectory.tip_mm[:, 2].max()) + ACROSS_MM,
        lowest_z_mm=[z - FLOOR_MM for z in floor],
    )
    shift = float(np.median(off))
    for index in range(len(standing.top_z_mm)):
        ledger.recall(index, depth_mm=ledger.cut_mm(index) + max(0.0, -shift))
    return [z + max(0.0, shift) for z in standing.top_z_mm]


def _surely_bone(ledger: Ledger) -> list[int]:
    """Up to ``MOST_TOUCHED`` points, spread round the ring."""
    sure = [
        index
        for index, point in enumerate(ledger.points)
        if ledger.thickness.through(index, point.cut_mm + SURE_MM) < SURE
    ]
    return _spread(sure, MOST_TOUCHED)


def _spread(indices: Sequence[int], most: int) -> list[int]:
    if len(indices) <= most:
        return list(indices)
    return [indices[k * len(indices) // most] for k in range(most)]
