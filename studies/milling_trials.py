"""Experiment 3 of the paper on virtual mice: whole windows, policy beside policy on the same mice.

Every trial is a bench that was just switched on: calibration, landmarks, surface, contact, milling, verdict, with full
pixels and the shipped networks, or (``statistical``) with pictures of numbers that are as wrong as full pixels were
measured to be. Success is the paper's: the flap can be lifted and the membrane was never touched; a run that holds is
a failure.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from drivers.errors import MillError
from firmware_sim.bench import Bench
from firmware_sim.clock import SimClock
from firmware_sim.faults import parse_faults
from firmware_sim.faulty_reader import FaultyReader
from milling import loop
from milling.eyes import CompletionReader, RingReader
from milling.job import Job, PolicyName
from milling.record import RunRecorder
from studies.perception import Readings, donors
from studies.ring_truth import RingTruth
from studies.statistical import NumberEyes
from studies.trials import Figures, World, share_of
from studies.virtual_runs import Ended, mill, networks
from vision.runtime import Image

Floats = npt.NDArray[np.float64]

POLICIES: Final[tuple[PolicyName, ...]] = ("default", "paper", "previous")
RELOOK_S: Final = 5.0
"""A window whose drill was aside for longer than this, the last look apart, or that was held, is a nuisance."""
PUBLISHED: Final = {"success_rate": 6 / 7, "time_min_mean": 2.1}
"""The paper's 6 of 7 mice and 2.1 (1.8) minutes."""


def mill_one(world: World, policy: PolicyName, faults: Sequence[str], statistical: bool, keep: Path | None) -> Figures:
    """One window of one mouse.

    Args:
        world: the mouse.
        policy: how to go deeper.
        faults: planted in the bench or in what reads completion.
        statistical: pictures of numbers in place of light.
        keep: receives the record, and the readings for ``studies.perception``; None keeps nothing.
    """
    specimen = world.specimen()
    # An eggshell has no landmarks: there the ring's middle is told.
    job = Job(policy=policy, center_mm=specimen.skull.center_mm if specimen.kind == "eggshell" else None)
    bench = Bench(specimen, faults=parse_faults(faults, place="bench"))
    own = parse_faults(faults, place="host")
    name = f"mouse-{world.name}-{policy}"
    if keep is not None:
        # What a trial that was interrupted left behind.
        shutil.rmtree(keep / name, ignore_errors=True)
    eyes = NumberEyes(bench, donors(), seed=world.seed) if statistical else None
    log: list[Readings] = []
    relooks: Relooks | None = None

    def finders(clock: SimClock) -> loop.Finders:
        found = networks(clock) if eyes is None else eyes.finders()
        reader: CompletionReader = found.completion
        if eyes is None and keep is not None and policy == "default" and not faults:
            reader = _Logged(reader, bench, log)
        reader = FaultyReader(reader, own, clock, seed=world.seed) if own else reader
        return loop.Finders(found.find_tip, found.find_landmarks, reader, found.match)

    with TemporaryDirectory() as scratch:

        def recorder(clock: SimClock) -> Relooks:
            nonlocal relooks
            header = {
                "seed": world.seed,
                "clock": "virtual",
                "specimen": None if world.file is None else str(world.file),
                "faults": list(faults),
                "statistical": statistical,
            }
            # Events tell what happened; thousands of pictures would fill a disk.
            relooks = Relooks((keep or Path(scratch)) / name, header, clock, frame_period_s=1e9)
            return relooks

        try:
            ended = mill(
                bench, recorder, job=job, finders=finders, render=None if eyes is None else eyes.render, disk=own
            )
        except MillError as error:
            # Before the loop: a device that does not open, a calibration that fails. A mouse of this kind counts too.
            ended = Ended(loop.RunResult("aborted", str(error), 0.0, 0.0), bench.truth())
    if keep is not None and log:
        np.save(keep / f"{name}.readings.npy", log[0].condensed())
    result, truth = ended.result, ended.truth
    return {
        "seed": world.seed,
        "recipe": policy,
        "failed": None,
        "outcome": result.outcome,
        "reason": result.reason,
        "success": bool(truth["success"]) and result.outcome == "complete",
        "flap_free": truth["flap_free"],
        "membrane_touched": truth["membrane_touched"],
        "membrane_overrun_mm": truth["membrane_overrun_mm"],
        "milling_time_min": result.milling_time_s / 60.0,
        "laps": result.laps,
        "relook_s": 0.0 if relooks is None else relooks.spent_s,
        "heat_rise_c": truth["heat_rise_c"],
        "donor": None if eyes is None else eyes.donor,
    }


def trials_of(
    mice: Iterable[World], policies: Sequence[PolicyName], faults: Sequence[str], statistical: bool, keep: Path | None
) -> dict[str, tuple[Any, ...]]:
    """Name and arguments of every trial: each mouse with every policy."""
    return {
        f"mouse-{mouse.name}-{policy}": (mouse, policy, tuple(faults), statistical, keep)
        for mouse in mice
        for policy in policies
    }


def summary(trials: Mapping[str, Figures]) -> dict[str, Figures]:
    """By policy: how many succeeded (Wilson's interval), what was harmed, how long the windows took that succeeded."""
    result: dict[str, Figures] = {}
    for policy in dict.fromkeys(trial["recipe"] for trial in trials.values()):
        mine = [trial for trial in trials.values() if trial["recipe"] == policy]
        successes = sum(trial["success"] for trial in mine)
        figures: Figures = {"trials": len(mine), **share_of("success_rate", successes, len(mine))}
        figures["wilson_95"] = [figures["success_rate_low"], figures["success_rate_high"]]
        touched = sum(trial["membrane_touched"] for trial in mine)
        figures["membranes_touched"] = touched
        figures |= share_of("damage_rate", touched, len(mine))
        figures["holds"] = sum(trial["outcome"] == "held" for trial in mine)
        nuisances = sum(trial["outcome"] == "held" or trial["relook_s"] > RELOOK_S for trial in mine)
        figures |= share_of("nuisance_rate", nuisances, len(mine))
        figures["aborts"] = sum(trial["outcome"] == "aborted" for trial in mine)
        figures["false_completes"] = sum(trial["outcome"] == "complete" and not trial["flap_free"] for trial in mine)
        times = [trial["milling_time_min"] for trial in mine if trial["success"]]
        if times:
            figures["time_min_median"], figures["time_min_p95"] = (float(np.percentile(times, q)) for q in (50, 95))
            figures["time_min_mean"] = float(np.mean(times))
        lenders = {trial.get("donor") for trial in mine} - {None}
        if lenders:
            # Mice that borrow from one donor are alike: with few of them the interval is narrower than is known.
            figures["donors"] = len(lenders)
        figures["heat_rise_c_worst"] = max(trial["heat_rise_c"] for trial in mine)
        figures["membrane_overrun_mm_worst"] = max(trial["membrane_overrun_mm"] for trial in mine)
        result[policy] = figures
    return result


class Relooks(RunRecorder):
    """A record that also tells how long the drill was aside for looks after which milling went on."""

    spent_s = 0.0
    _aside_at_s: float | None = None

    def event(self, kind: str, **fields: Any) -> None:
        """Append one event."""
        super().event(kind, **fields)
        if kind != "stage":
            return
        if fields["stage"] == "look":
            self._aside_at_s = self._clock.now_s()
        elif fields["stage"] == "mill" and self._aside_at_s is not None:
            self.spent_s += self._clock.now_s() - self._aside_at_s
            self._aside_at_s = None


@dataclass
class _Logged:
    """A reader whose readings are kept beside the truth."""

    reader: CompletionReader
    bench: Bench
    log: list[Readings]

    def over(self, ring_px: Floats, ball_px: float, *, reference: Image | None) -> "_LoggedRing":
        self.log.append(Readings(RingTruth(self.bench, ring_px), []))
        return _LoggedRing(self.reader.over(ring_px, ball_px, reference=reference), self.log[-1])


@dataclass
class _LoggedRing:
    ring: RingReader
    readings: Readings

    def read(self, image: Image) -> Any:
        reading = self.ring.read(image)
        self.readings.add(reading.completion, reading.upper, reading.visible)
        return reading
