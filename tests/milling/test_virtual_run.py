"""The whole job on the virtual clock: real drivers, emulated boards, no thread, no wall clock."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from true_eyes import THIN, VirtualRig, virtual_rig

from drivers.errors import ConnectionLostError
from milling.job import Job
from milling.loop import Progress, RunResult
from milling.record import Run, read_run
from vision.completion import CompletionReading

JOB = Job(n_points=24, thickness_low_mm=0.1, thickness_high_mm=0.3)


@pytest.fixture
def bench() -> Iterator[VirtualRig]:
    rig = virtual_rig()
    yield rig
    rig.close()


class AfterLaps:
    """Does something once, when so many laps are milled."""

    def __init__(self, laps: int, act: Callable[[], None]) -> None:
        self._laps = laps
        self._act = act
        self.done = False

    def __call__(self, progress: Progress) -> None:
        if not self.done and progress.lap >= self._laps:
            self.done = True
            self._act()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunResult, VirtualRig, Run, Path]:
    rig = virtual_rig()
    folder = tmp_path_factory.mktemp("run") / "first"
    threads = threading.active_count()
    result = rig.run(folder, JOB)
    assert threading.active_count() == threads
    rig.close()
    return result, rig, read_run(folder), folder


def test_the_window_is_milled_and_the_membrane_is_whole(finished: tuple[RunResult, VirtualRig, Run, Path]) -> None:
    result, rig, _, _ = finished
    truth = rig.bench.machine.truth()
    assert result.outcome == "complete", result.reason
    assert truth.flap_free
    assert not truth.membrane_touched
    assert rig.bench.machine.spindle_rpm == 0.0


def test_no_point_went_deeper_than_the_prior_and_none_faster_than_the_rate(
    finished: tuple[RunResult, VirtualRig, Run, Path],
) -> None:
    result, _, run, _ = finished
    assert max(point["depth_mm"] for point in result.points) <= JOB.thickness_high_mm
    laps = [np.array(event["depth_mm"]) for event in run.of_kind("lap")]
    bites = np.diff(laps, axis=0)
    assert bites.max() <= 2 * 1.1 * JOB.removal_rate_mm2_s / JOB.feed_mm_s, (
        "two visits at most between two laps' reports"
    )
    assert bites.min() >= 0.0


def test_the_record_tells_the_whole_story(finished: tuple[RunResult, VirtualRig, Run, Path]) -> None:
    result, _, run, folder = finished
    assert run.damage is None
    assert run.result is not None
    assert run.result["outcome"] == result.outcome
    stages = [event["stage"] for event in run.of_kind("stage")]
    order = [
        "home",
        "verify",
        "park",
        "landmarks",
        "surface",
        "trajectory",
        "approach",
        "spindle",
        "contact",
        "mill",
        "look",
    ]
    assert [stages.index(stage) for stage in order] == sorted(stages.index(stage) for stage in order)
    assert len(list(run.of_kind("contact"))) == JOB.n_points
    assert list(run.of_kind("spindle"))[-1]["state"] == "off, confirmed"
    floor = next(run.of_kind("floor"))
    lowest = min(event["tip_mm"][2] for event in run.of_kind("load"))
    assert floor["z_mm"] <= floor["read_back_mm"] < lowest
    assert (folder / "frames").is_dir()


def test_contact_is_found_within_a_step(finished: tuple[RunResult, VirtualRig, Run, Path]) -> None:
    """Against the bone as it was: within one step, run-out and backlash."""
    _, rig, run, _ = finished
    skull, tool = rig.bench.machine.skull, rig.bench.specimen.tool
    trajectory = next(run.of_kind("trajectory"))
    x, y = np.meshgrid(np.arange(-0.5, 0.5, 0.02), np.arange(-0.5, 0.5, 0.02))
    inside = x**2 + y**2 < 0.24
    for event, ball in zip(run.of_kind("contact"), trajectory["ball_mm"], strict=True):
        outer = skull.surface.outer_z(ball[0] + x[inside], ball[1] + y[inside])
        touching = float(np.max(outer + np.sqrt(0.25 - x[inside] ** 2 - y[inside] ** 2)))
        assert abs(event["z_mm"] + tool.ball_radius_mm * tool.axis[2] - touching) < 0.03


@pytest.mark.slow
def test_the_same_seed_gives_the_same_events_byte_for_byte(
    finished: tuple[RunResult, VirtualRig, Run, Path], bench: VirtualRig, tmp_path: Path
) -> None:
    bench.run(tmp_path / "second", JOB)
    assert (tmp_path / "second" / "events.jsonl").read_bytes() == (finished[3] / "events.jsonl").read_bytes()


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_ctrl_c_while_milling_lifts_stops_and_closes_within_a_second(dialect: str, tmp_path: Path) -> None:
    rig = virtual_rig(dialect=dialect)
    asked: list[float] = []
    depth: list[float] = []

    def ask() -> None:
        asked.append(rig.clock.now_s())
        depth.append(float(rig.bench.machine.tip_mm[2]))

    result = rig.run(tmp_path / "run", JOB, progress=AfterLaps(1, ask), stop_requested=lambda: bool(asked))
    ended_s = rig.clock.now_s()
    assert (result.outcome, result.reason) == ("aborted", "stopped by a person")
    assert ended_s - asked[0] <= 1.0
    assert rig.bench.machine.tip_mm[2] >= depth[0] + 1.0
    assert rig.bench.machine.spindle_rpm < 1000
    run = read_run(tmp_path / "run")
    assert list(run.of_kind("spindle"))[-1]["state"] == "off, confirmed"
    assert run.damage is None
    assert run.result is not None
    rig.close()


def test_a_lost_motion_wire_kills_and_loses_nothing_of_the_record(bench: VirtualRig, tmp_path: Path) -> None:
    def cut_the_wire() -> None:
        def gone(*_: object) -> bytes:
            raise ConnectionLostError("in-process:motion: unplugged")

        bench.motion._session._line.read = gone  # type: ignore[method-assign]
        bench.motion._session._line.write = gone  # type: ignore[method-assign, assignment]

    result = bench.run(tmp_path / "run", JOB, progress=AfterLaps(1, cut_the_wire))
    assert result.outcome == "aborted"
    assert "unplugged" in result.reason
    assert "position is not trusted" in result.reason
    bench.clock.sleep_s(2.0)
    assert bench.bench.machine.spindle_rpm == 0.0
    assert read_run(tmp_path / "run").damage is None


def test_a_network_that_says_nan_ends_in_a_hold(bench: VirtualRig, tmp_path: Path) -> None:
    def nan() -> None:
        bench.reader.fails = lambda reading: replace(reading, completion=np.full(JOB.n_points, np.nan))

    result = bench.run(tmp_path / "run", JOB, progress=AfterLaps(1, nan))
    assert result.outcome == "held"
    assert "NaN" in result.reason
    assert len(list(read_run(tmp_path / "run").of_kind("bad_reading"))) == 5
    assert bench.bench.machine.spindle_rpm == 0.0


def test_a_frozen_camera_gives_no_bite_and_ends_in_a_hold(bench: VirtualRig, tmp_path: Path) -> None:
    def freeze() -> None:
        stuck = bench.camera.latest()
        bench.camera.latest = lambda: stuck  # type: ignore[method-assign]

    result = bench.run(tmp_path / "run", JOB, progress=AfterLaps(1, freeze))
    assert result.outcome == "held"
    assert "no fresh frame" in result.reason
    assert not bench.bench.machine.truth().membrane_touched


@pytest.mark.long
def test_a_robot_fed_every_8_ms_mills_the_same_window(tmp_path: Path) -> None:
    rig = virtual_rig(make="bcap")
    result = rig.run(tmp_path / "run", JOB)
    truth = rig.bench.machine.truth()
    rig.close()
    assert result.outcome == "complete", result.reason
    assert truth.flap_free
    assert not truth.membrane_touched
    assert rig.bench.machine.spindle_rpm == 0.0


@pytest.mark.long
def test_a_picture_that_never_says_done_is_stopped_by_the_load(bench: VirtualRig, tmp_path: Path) -> None:
    """The failure of the paper: completion stays low after penetration."""

    def low(reading: CompletionReading) -> CompletionReading:
        return replace(reading, completion=np.full(JOB.n_points, 0.3), upper=np.full(JOB.n_points, 0.4))

    bench.reader.fails = low
    # A prior that leaves every point a few sound passes to learn its own load from, as the default one does.
    result = bench.run(tmp_path / "run", replace(JOB, thickness_low_mm=0.12))
    assert result.outcome in ("complete", "held")
    assert not bench.bench.machine.truth().membrane_touched


@pytest.mark.long
@pytest.mark.parametrize("policy", ["paper", "previous"])
def test_published_policies_run(policy: str, bench: VirtualRig, tmp_path: Path) -> None:
    job = replace(JOB, policy=policy)
    result = bench.run(tmp_path / "run", job)
    assert result.outcome == "complete"
    assert bench.bench.machine.spindle_rpm == 0.0


@pytest.mark.long
def test_another_make_of_motion_board_mills_the_same_window(tmp_path: Path) -> None:
    rig = virtual_rig(make="tinyg")
    result = rig.run(tmp_path / "run", JOB)
    rig.close()
    truth = rig.bench.machine.truth()
    assert result.outcome == "complete", result.reason
    assert truth.flap_free
    assert not truth.membrane_touched
    assert rig.bench.machine.spindle_rpm == 0.0


def test_a_calibration_of_something_else_moves_no_drill_near_bone(bench: VirtualRig, tmp_path: Path) -> None:
    find_tip = bench.finders.find_tip

    def elsewhere(image: object) -> object:
        tip = find_tip(image)  # type: ignore[arg-type]
        return replace(tip, x_px=tip.x_px + 15.0)  # type: ignore[type-var]

    bench.finders = replace(bench.finders, find_tip=elsewhere)  # type: ignore[arg-type]
    result = bench.run(tmp_path / "run", JOB)
    assert result.outcome == "aborted"
    assert "calibrate" in result.reason
    assert bench.bench.machine.tip_mm[2] > 0.0
    assert not list(read_run(tmp_path / "run").of_kind("floor"))


def test_landmarks_too_near_to_each_other_are_something_else(bench: VirtualRig, tmp_path: Path) -> None:
    find_landmarks = bench.finders.find_landmarks

    def confused(image: object) -> object:
        bregma, lambda_ = find_landmarks(image)  # type: ignore[arg-type]
        halfway = (bregma.x_px + lambda_.x_px) / 2, (bregma.y_px + lambda_.y_px) / 2
        return replace(bregma, x_px=halfway[0], y_px=halfway[1]), lambda_  # type: ignore[type-var]

    bench.finders = replace(bench.finders, find_landmarks=confused)  # type: ignore[arg-type]
    result = bench.run(tmp_path / "run", JOB)
    assert result.outcome == "aborted"
    assert "mm apart" in result.reason
    assert not list(read_run(tmp_path / "run").of_kind("floor"))


def test_the_thin_specimen_is_what_the_job_was_cut_for() -> None:
    assert THIN.skull.thickness_mm.max < JOB.thickness_high_mm


def test_a_given_centre_needs_no_landmarks(bench: VirtualRig, tmp_path: Path) -> None:
    """An eggshell has none."""

    def nothing(image: object) -> object:
        raise AssertionError("nobody looks for landmarks")

    bench.finders = replace(bench.finders, find_landmarks=nothing)  # type: ignore[arg-type]
    center_mm, stages = bench.bench.specimen.skull.center_mm, list[str]()
    result = bench.run(
        tmp_path / "run",
        replace(JOB, center_mm=center_mm),
        progress=lambda progress: stages.append(progress.stage),
        stop_requested=lambda: "spindle" in stages,
    )
    assert (result.outcome, "landmarks" in stages) == ("aborted", False)
    planned = next(read_run(tmp_path / "run").of_kind("trajectory"))
    assert planned["center_mm"][:2] == pytest.approx(center_mm[:2], abs=0.1)
    assert "bregma_px" not in planned
