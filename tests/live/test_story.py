"""What a page shows, from events alone; and how a stop is told."""

import os
import select
from collections.abc import Callable

import numpy as np
import pytest

from live.stop import ASK_AFTER_S, Stop
from live.story import Story


class Straight:
    def project(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return points_mm[:, :2], points_mm[:, :2] + 1.0


def event(kind: str, t: float = 1.0, **fields: object) -> dict[str, object]:
    return {"t": t, "kind": kind, **fields}


def started(n: int = 4) -> Story:
    story = Story()
    story.take(event("state", 0.0, state="start", job={"n_points": n, "thickness_high_mm": 0.5}))
    return story


def test_what_was_not_told_is_unknown() -> None:
    told = started().told()
    assert told["points"]["completion"] == [None] * 4
    assert told["points"]["permission"] == [None] * 4
    assert told["torque"] is None


def test_a_permission_that_is_withheld_keeps_its_reason_until_the_next_question() -> None:
    story = started()
    story.take(event("asked", point=2, reason="no fresh frame"))
    assert story.told()["points"]["permission"] == [None, "no fresh frame", None, None]
    story.take(event("asked", point=2, reason=""))
    assert story.told()["points"]["permission"][1] == ""


def test_a_point_behind_the_drill_keeps_what_was_seen_of_it() -> None:
    story = started(2)
    story.take(event("reading", age_s=0.02, completion=[0.1, 0.2], upper=[0.3, 0.4], shown="ss"))
    story.take(event("reading", age_s=0.02, completion=[0.9, float("nan")], upper=[0.9, 0.9], shown="bh"))
    told = story.told()["points"]
    assert (told["completion"], told["upper"], told["shown"]) == ([0.1, 0.2], [0.3, 0.4], ["b", "h"])


def test_faults_and_the_end_are_told_in_words() -> None:
    story = started()
    assert not story.stopping
    story.take(event("latched", reaction="RETRACT", reason="spindle: silent"))
    assert story.stopping
    assert not story.over
    story.take(event("outcome", outcome="aborted", reason="spindle: silent", points=[]))
    assert story.over
    assert [(each["what"], each["why"]) for each in story.news] == [
        ("RETRACT", "spindle: silent"),
        ("aborted", "spindle: silent"),
    ]


def test_the_drill_is_drawn_where_it_was_when_the_picture_was_taken() -> None:
    story = started()
    story.look_through(Straight(), (0.0, 0.0, 0.5))
    for step in range(3):
        story.take(event("load", 1.0 + 0.2 * step, torque=0.1, rpm=1.0, tip_mm=[step * 1.0, step**2 * 1.0, 0.0]))
    story.pictured(1.5)
    (center, *_), (right, *_) = story.told()["tip_px"]
    assert center == pytest.approx([2.5, 6.25], abs=0.06)
    assert right == pytest.approx([3.5, 7.25], abs=0.06)
    story.pictured(9.0)
    assert story.told()["tip_px"] is None


def test_bregma_and_lambda_are_drawn_in_both_pictures() -> None:
    story = started()
    told = {"bregma_px": [1, 2], "lambda_px": [3, 4], "bregma_right_px": [5, 6], "lambda_right_px": [7, 8]}
    story.take(event("trajectory", fit_mm=[[0.00049, 1.0, 2.0]] * 4, **told))
    assert story.scene["marks_px"] == [{"bregma": [1, 2], "lambda": [3, 4]}, {"bregma": [5, 6], "lambda": [7, 8]}]
    assert story.scene["path_mm"][0] == [0.0, 1.0, 2.0]
    assert story.scene["ring_px"] is None, "without a calibration nobody knows where it is in the pictures"


def test_the_surface_is_kept_to_the_micrometre() -> None:
    story = started()
    number = story.scene_number
    story.take(
        event("surface", x_mm=np.array([0.0, 0.1]), y_mm=[1.0, 2.0], z_mm=[[0.12345, 0.2], [0.3, 0.4]], matches=9)
    )
    assert story.scene["surface"] == {"x": [0.0, 0.1], "y": [1.0, 2.0], "z": [[0.123, 0.2], [0.3, 0.4]]}
    assert story.scene_number == number + 1


def test_setpoints_are_visited_in_order_and_one_that_is_not_seen_is_a_fault() -> None:
    story = Story()
    story.take(event("calibration.setpoints", targets_mm=[[0, 0, 0], [1, 0, 0], [2, 0, 0]]))
    seen = {"point_mm": [0, 0, 0.5], "left_px": [10, 20], "right_px": [30, 40]}
    story.take(event("calibration.sighting", target_mm=[0, 0, 0], **seen))
    assert story.told()["tip_px"] == [[[10, 20]], [[30, 40]]]
    story.take(event("calibration.hidden", target_mm=[1, 0, 0], reason="glare"))
    story.take(event("calibration.missed", target_mm=[1, 0, 0], reason="seen in 0 of 4 left pictures"))
    assert [each["state"] for each in story.scene["setpoints"]] == ["seen", "missed", "waiting"]
    assert story.told()["tip_px"] is None, "where it was is not where it is"
    told = ("the drill is not seen", "seen in 0 of 4 left pictures", True)
    assert [(each["what"], each["why"], each["fault"]) for each in story.news] == [told]
    assert not story.stopping
    story.take(
        event("calibration.fit", model="affine", rmse_mm=0.03, predicted_rmse_mm=0.04, left_out=[], outliers_mm=[])
    )
    assert story.scene["fit"] == {"model": "affine", "rmse_mm": 0.03, "predicted_rmse_mm": 0.04}


def test_checks_are_told_as_they_come() -> None:
    story = Story()
    check = {"name": "motion: homes", "value": 1.0, "unit": "mm", "limit": "at most 2", "verdict": "pass"}
    story.take(event("check", **check))
    story.take(event("check", **check | {"verdict": "fail", "advice": "look"}))
    assert story.scene["checks"] == [check, {**check, "verdict": "fail", "advice": "look"}]
    assert not story.stopping, "an examination goes on after a check that failed"


def test_curves_stay_bounded() -> None:
    story = started()
    for number in range(5000):
        story.now["t"] = float(number)
        story.curve()
    assert len(story.rows) <= 1200
    assert (story.rows[0][0], story.rows[-1][0]) == (0.0, 4999.0)


@pytest.mark.parametrize("kind", ["voided", "something new", "stalled"])
def test_events_that_no_page_shows_change_nothing(kind: str) -> None:
    story = started()
    before = story.told()
    story.take(event(kind, 0.0, points=[1]))
    assert story.told() == before


def test_a_stop_tells_the_supervisor_at_once_and_asks_the_run_later_and_once() -> None:
    hears, end = os.pipe()
    stop = Stop(None)
    assert not stop.possible
    stop.take(end)
    assert stop.immediate
    later: list[tuple[float, Callable[[], None]]] = []
    for _ in range(3):
        stop.press(lambda after_s, ask: later.append((after_s, ask)))
    assert os.read(hears, 64) == b"!\n" * 3
    assert [after_s for after_s, _ in later] == [ASK_AFTER_S]
    stop.close()
    assert os.read(hears, 64) == b"", "the supervisor must see that everybody is gone"
    os.close(hears)


def test_without_a_supervisor_the_run_is_asked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr("live.stop.signal.pidfd_send_signal", lambda fd, number: asked.append(number))
    stop = Stop(os.pidfd_open(os.getpid()))
    stop.press(lambda *_: None)
    stop.press(lambda *_: None)
    assert asked == [2]
    stop.close()
    stop.press(lambda *_: None)
    assert asked == [2]


def test_a_supervisor_that_is_gone_is_passed_over() -> None:
    hears, end = os.pipe()
    os.close(hears)
    stop = Stop(None)
    stop.take(end)
    stop.press(lambda *_: None)
    assert not select.select([], [], [], 0)[0]
    stop.close()
