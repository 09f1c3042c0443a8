"""A window that one run began and another one ends, on the virtual clock with eyes that are told the truth."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from true_eyes import THIN, VirtualRig, virtual_rig

from drivers.errors import ConfigError, PlanError
from firmware_sim.clock import SimClock
from milling.job import Job
from milling.loop import Progress, RunResult
from milling.point import PointState
from milling.record import Run, RunRecorder, read_run
from milling.standing import MOVED_PX, require_unmoved, standing_of, touch_again

JOB = Job(n_points=24, thickness_low_mm=0.1, thickness_high_mm=0.3)
STOPPED_AFTER_LAPS = 6


class Stop:
    """Asks for a stop once so many laps are milled."""

    def __init__(self, laps: int) -> None:
        self._laps = laps
        self.asked = False

    def heard(self, progress: Progress) -> None:
        self.asked = self.asked or progress.lap >= self._laps


@pytest.fixture(scope="module")
def halved(tmp_path_factory: pytest.TempPathFactory) -> tuple[VirtualRig, Path, RunResult]:
    rig, folder, stop = virtual_rig(THIN), tmp_path_factory.mktemp("resume") / "first", Stop(STOPPED_AFTER_LAPS)
    result = rig.run(folder, JOB, progress=stop.heard, stop_requested=lambda: stop.asked)
    assert result.outcome == "aborted"
    return rig, folder, result


def copied(folder: Path, to: Path, change: Callable[[list[dict]], list[dict]] = lambda events: events) -> Path:
    """The same record with its events changed."""
    run = read_run(folder)
    header = {key: value for key, value in run.header.items() if key != "schema"}
    with RunRecorder(to, header, SimClock()) as recorder:
        for event in change([dict(event) for event in run.events]):
            recorder.event(event["kind"], **{key: event[key] for key in event if key not in {"t", "kind"}})
    for picture in (folder / "frames").iterdir():
        (to / "frames" / picture.name).write_bytes(picture.read_bytes())
    return to


def test_the_journal_tells_where_every_point_stands(halved: tuple[VirtualRig, Path, RunResult]) -> None:
    _, folder, result = halved
    standing = standing_of(read_run(folder), JOB)
    ledger = standing.ledger(JOB)
    assert [ledger.cut_mm(i) for i in range(JOB.n_points)] == pytest.approx(
        [point["depth_mm"] for point in result.points], abs=1e-6
    )
    assert max(ledger.cut_mm(i) for i in range(JOB.n_points)) > 0.03
    assert {point.state for point in ledger.points} <= {PointState.OPEN, PointState.STOPPED}
    assert standing.trajectory.n == JOB.n_points
    assert standing.top_z_mm == pytest.approx([point["contact_mm"] for point in result.points], abs=1e-5)


@pytest.mark.slow
def test_a_window_is_ended_by_a_second_run(halved: tuple[VirtualRig, Path, RunResult], tmp_path: Path) -> None:
    rig, folder, before = halved
    standing = standing_of(read_run(folder), JOB)
    rig.motion.halt()
    rig.motion.home()
    result = rig.run(tmp_path / "second", JOB, standing=standing)
    truth = rig.bench.machine.truth()
    assert result.outcome == "complete", result.reason
    assert truth.flap_free
    assert not truth.membrane_touched
    run = read_run(tmp_path / "second")
    depths = [np.array(event["depth_mm"]) for event in run.of_kind("lap")]
    assert (depths[-1] >= np.array([point["depth_mm"] for point in before.points]) - 1e-6).all()
    touched = [event["detail"] for event in run.of_kind("stage") if "floor under point" in event.get("detail", "")]
    assert len(touched) >= 3
    # The second record is whole by itself: with nothing but it, every point stands where it ended.
    again = standing_of(_unfinished(run.folder, tmp_path / "third"), JOB).ledger(JOB)
    assert [again.cut_mm(i) for i in range(JOB.n_points)] == pytest.approx(
        [point["depth_mm"] for point in result.points], abs=1e-6
    )


def _unfinished(folder: Path, to: Path) -> Run:
    copied(folder, to)
    return read_run(to)


@pytest.fixture(scope="module")
def half_cut(tmp_path_factory: pytest.TempPathFactory) -> tuple[VirtualRig, Path]:
    """A window that nobody has gone on with."""
    rig, folder, stop = virtual_rig(THIN), tmp_path_factory.mktemp("half") / "first", Stop(STOPPED_AFTER_LAPS)
    rig.run(folder, JOB, progress=stop.heard, stop_requested=lambda: stop.asked)
    return rig, folder


@pytest.mark.parametrize(("off_mm", "says"), [(-0.06, "off the journal|should be air"), (0.06, "no bone felt down to")])
def test_a_floor_that_is_elsewhere_is_not_cut(
    half_cut: tuple[VirtualRig, Path], tmp_path: Path, off_mm: float, says: str
) -> None:
    """A tip that stands 60 um too high or too low against the journal: both ways it goes no deeper than it may feel."""
    rig, folder = half_cut

    def moved(events: list[dict]) -> list[dict]:
        for event in events:
            if event["kind"] == "contact":
                event["z_mm"] += off_mm
        return events

    depth = rig.bench.machine.truth().depth_mm.copy()
    wrong = read_run(copied(folder, tmp_path / "wrong", moved))
    result = rig.run(tmp_path / "second", JOB, standing=standing_of(wrong, JOB))
    assert result.outcome in {"held", "aborted"}
    assert re.search(says, result.reason), result.reason
    assert (rig.bench.machine.truth().depth_mm - depth).max() <= 0.03


def test_a_floor_that_is_felt_a_little_lower_counts_as_cut(halved: tuple[VirtualRig, Path, RunResult]) -> None:
    _, folder, _ = halved
    standing = standing_of(read_run(folder), JOB)
    for off_mm in (-0.02, 0.02):
        ledger = standing.ledger(JOB)
        before = [ledger.cut_mm(index) for index in range(JOB.n_points)]
        tops = touch_again(standing, ledger, FeelsAt(off_mm), lambda index, z: None)
        deeper = np.array([ledger.cut_mm(index) for index in range(JOB.n_points)]) - before
        assert deeper == pytest.approx(np.full(JOB.n_points, max(0.0, -off_mm)))
        assert np.array(tops) - standing.top_z_mm == pytest.approx(np.full(JOB.n_points, max(0.0, off_mm)))


class FeelsAt:
    """A finder that feels every floor off by so much."""

    def __init__(self, off_mm: float) -> None:
        self._off_mm = off_mm

    def find_all(self, xy_mm, start_z_mm, predicted_z_mm, told, *, across_z_mm, lowest_z_mm):
        found = [z + self._off_mm for z in predicted_z_mm]
        for index, z in enumerate(found):
            told(index, z)
        return found


@pytest.mark.parametrize(
    ("change", "job", "says"),
    [
        (lambda events: [e for e in events if e["kind"] != "contact"], JOB, "before all contacts were known"),
        (lambda events: [e for e in events if e["kind"] != "cut"], JOB, "no cut is in its journal"),
        (lambda events: [e for e in events if e["kind"] != "frame"], JOB, "picture of the unmilled skull"),
        (lambda events: events, Job(n_points=24, policy="paper"), "felt nothing"),
    ],
)
def test_what_cannot_be_resumed_says_why(halved, tmp_path: Path, change, job: Job, says: str) -> None:
    _, folder, _ = halved
    run = read_run(copied(folder, tmp_path / "copy", change))
    with pytest.raises(ConfigError, match=says):
        standing_of(run, job)


def test_a_complete_window_is_not_resumed(halved, tmp_path: Path) -> None:
    _, folder, _ = halved
    run = read_run(copied(folder, tmp_path / "copy"))
    (run.folder / "result.json").write_text(json.dumps({"outcome": "complete"}))
    with pytest.raises(ConfigError, match="its window is complete"):
        standing_of(read_run(run.folder), JOB)


@pytest.mark.parametrize("shift_px", [0, 1, 6])
def test_a_skull_that_was_moved_is_noticed(halved, shift_px: int) -> None:
    _, folder, _ = halved
    standing = standing_of(read_run(folder), JOB)
    ring_px = np.array([[400.0, 200.0], [500.0, 200.0], [500.0, 300.0], [400.0, 300.0]])
    now = np.roll(standing.reference, shift_px, axis=1)
    if shift_px <= MOVED_PX:
        assert require_unmoved(standing, now, ring_px) == pytest.approx(shift_px, abs=0.3)
        return
    with pytest.raises(PlanError, match=r"shifted by 6\.0 px"):
        require_unmoved(standing, now, ring_px)
