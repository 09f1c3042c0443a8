"""Records decided again: the same evidence gives the same decisions, other eyes and other policies part from them."""

from dataclasses import replace
from typing import Any

import pytest
from true_eyes import SHORT_JOB, virtual_rig

from drivers.errors import ConfigError
from milling.planner import policy_for
from milling.record import Run, read_run
from milling.replay import replay
from milling.trajectory import closed_path

JOB = SHORT_JOB


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, float]:
    rig, folder = virtual_rig(), tmp_path_factory.mktemp("replay") / "run"
    result = rig.run(folder, JOB)
    rig.close()
    assert result.outcome == "complete", result.reason
    run = read_run(folder)
    return run, pitch_mm(run)


def pitch_mm(run: Run) -> float:
    from math import pi

    import numpy as np

    tip_mm = np.array(next(run.of_kind("trajectory"))["tip_mm"])
    theta = 2 * pi * np.arange(1, JOB.n_points + 1) / JOB.n_points
    return float(closed_path(theta, tip_mm[:, :2]).x[-1]) / JOB.n_points


def test_the_same_evidence_gives_the_same_decisions(record: tuple[Run, float]) -> None:
    run, pitch = record
    again = replay(run, JOB, pitch)
    assert again.asked > 500
    assert again.readings > 100
    assert again.differences == []


def test_a_policy_that_asks_nobody_parts_where_permission_says_no(record: tuple[Run, float]) -> None:
    run, pitch = record
    paper = replay(run, JOB, pitch, policy=policy_for(replace(JOB, policy="paper")))
    assert paper.differences
    assert {each.now_why for each in paper.differences} <= {"", "published systems ask nobody"}
    assert all(each.recorded_mm != each.now_mm for each in paper.differences)
    assert paper.asked == replay(run, JOB, pitch).asked


def test_eyes_that_say_bone_for_ever_part_first_where_the_others_saw_a_hole(record: tuple[Run, float]) -> None:
    run, pitch = record
    seen: list[str] = []

    def stuck(picture: str) -> dict[str, Any]:
        seen.append(picture)
        return {"completion": [0.3] * JOB.n_points, "upper": [0.4] * JOB.n_points}

    other = replay(run, JOB, pitch, reread=stuck)
    assert other.readings - other.without_picture == len(seen) > 5
    assert all(each.now_why != "" or each.recorded_why != "" for each in other.differences)


def test_a_reading_whose_picture_was_not_kept_counts_on_neither_side(record: tuple[Run, float]) -> None:
    run, pitch = record
    blind = replay(run, JOB, pitch, reread=lambda _: None)
    assert blind.without_picture == blind.readings
    assert blind.differences == []


def test_a_record_without_decisions_is_refused(record: tuple[Run, float]) -> None:
    run, pitch = record
    empty = replace(run, events=[event for event in run.events if event["kind"] != "asked"])
    with pytest.raises(ConfigError, match="holds no decisions"):
        replay(empty, JOB, pitch)
    with pytest.raises(ConfigError, match="goes on from"):
        replay(replace(run, header=run.header | {"resumes": "runs/x"}), JOB, pitch)
