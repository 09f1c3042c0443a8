"""Branches of a run, what their table says, and how the overrun is found."""

import json
from pathlib import Path

import numpy as np
import pytest

from firmware_sim.clock import SimClock
from firmware_sim.faults import CATALOGUE
from milling.record import read_run
from studies.branches import BranchingRecorder, branch, end
from studies.fault_table import AT_FIRST, Phases, faults, summary
from studies.overrun import FELT_MM, Overrun


def test_a_branch_tells_its_figures_and_leaves_the_trunk_alone(tmp_path: Path) -> None:
    state = [1]

    def grow() -> dict[str, int]:
        state.append(2)
        return {"length": len(state)}

    assert branch(tmp_path / "b.json", grow) is False
    assert json.loads((tmp_path / "b.json").read_text()) == {"length": 2}
    assert state == [1]


def test_a_branch_that_only_plants_goes_on(tmp_path: Path) -> None:
    file, planted = tmp_path / "b.json", []

    def grow() -> None:
        planted.append(True)

    if branch(file, grow):
        end(file, {"planted": len(planted)})
    assert planted == []
    assert json.loads(file.read_text()) == {"planted": 1}


def test_a_branch_that_fails_leaves_why(tmp_path: Path) -> None:
    assert branch(tmp_path / "b.json", lambda: {"ratio": 1 / 0}) is False
    assert "ZeroDivisionError" in (tmp_path / "b.error").read_text()


def test_a_branch_writes_to_a_copy_of_the_record(tmp_path: Path) -> None:
    with BranchingRecorder(tmp_path / "trunk", {}, SimClock()) as recorder:
        recorder.event("stage", stage="mill")

        def grow() -> dict[str, int]:
            recorder.branch_to(tmp_path / "twig")
            recorder.event("error", where="here")
            return {"told": recorder.told}

        branch(tmp_path / "b.json", grow)
        recorder.event("stage", stage="look")
        assert recorder.told == 2
    assert [event["kind"] for event in read_run(tmp_path / "trunk").events] == ["stage", "stage"]
    assert [event["kind"] for event in read_run(tmp_path / "twig").events] == ["stage", "error"]


def ring(n: int = 32) -> Overrun:
    """A level ring of 2 mm at z = -1 mm, all of it touched."""
    overrun = Overrun()
    theta = 2 * np.pi * np.arange(1, n + 1) / n
    tip = np.column_stack([2 * np.cos(theta), 2 * np.sin(theta), np.zeros(n)])
    overrun.event("trajectory", {"tip_mm": tip.tolist()})
    for index in range(n):
        overrun.event("contact", {"point": index + 1, "z_mm": -1.0})
    return overrun


def place(point: float, z_mm: float, n: int = 32) -> np.ndarray:
    theta = 2 * np.pi * point / n
    return np.array([2 * np.cos(theta), 2 * np.sin(theta), z_mm])


def test_a_tip_at_what_it_was_granted_has_not_overrun() -> None:
    overrun = ring()
    overrun.event("asked", {"point": 3, "depth_mm": 0.05, "reason": ""})
    overrun.at(place(3, -1.05))
    overrun.at(place(9, -1.0 - FELT_MM))
    assert overrun.greatest_mm < 1e-3


@pytest.mark.parametrize(("point", "overrun_mm"), [(3, 0.02), (9, 0.07 - FELT_MM)])
def test_a_tip_below_what_it_was_granted_is_seen(point: float, overrun_mm: float) -> None:
    overrun = ring()
    overrun.event("asked", {"point": 3, "depth_mm": 0.05, "reason": ""})
    overrun.event("asked", {"point": 9, "depth_mm": 0.2, "reason": "no fresh frame"})
    overrun.at(place(point, -1.07))
    assert overrun.greatest_mm == pytest.approx(overrun_mm, abs=1e-3)


def test_beside_the_ring_nothing_is_permitted_or_asked() -> None:
    overrun = ring()
    overrun.at(np.array([0.0, 0.0, -2.0]))
    assert overrun.greatest_mm == 0.0


def test_each_phase_begins_once() -> None:
    phases, begun = Phases(4), []
    thin, thick = [0.01] * 8, [0.9] * 8
    for kind, fields in [
        ("contact", {}), ("contact", {}), ("contact", {}),
        ("lap", {"lap": 1, "left_probability": thick}),
        ("lap", {"lap": 4, "left_probability": thick}),
        ("lap", {"lap": 5, "left_probability": thick}),
        ("lap", {"lap": 20, "left_probability": thin}),
        ("lap", {"lap": 21, "left_probability": thin}),
        ("stage", {"stage": "look"}), ("stage", {"stage": "look"}),
    ]:  # fmt: skip
        begun += [phase] if (phase := phases.of(kind, fields)) else []
    assert begun == ["contact", "entry", "late", "look"]


def test_every_fault_that_can_begin_in_a_run_is_in_the_table() -> None:
    assert {name.partition("=")[0] for name in faults()} | set(AT_FIRST) == set(CATALOGUE)


def test_a_line_of_the_table() -> None:
    row = {
        "fault": "camera.off", "outcome": "held", "membrane_touched": False, "flap_free": False, "latched_after_s": 2.0,
        "safe_after_s": 0.5, "lower_after_latch_mm": 0.001, "overrun_mm": 0.002, "command_overrun_mm": 0.0,
    }  # fmt: skip
    other = {**row, "outcome": "complete", "latched_after_s": None, "safe_after_s": None, "membrane_touched": True}
    (line,) = summary([row, other])
    assert (line["branches"], line["held"], line["complete"], line["aborted"]) == (2, 1, 1, 0)
    assert (line["membranes_touched"], line["false_completes"]) == (1, 1)
    assert (line["latched_after_s"], line["safe_after_latch_s"]) == ([2.0, 2.0], 0.5)
    assert line["overrun_um"] == pytest.approx(2.0)
