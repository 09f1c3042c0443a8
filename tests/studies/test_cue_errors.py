"""The truth that cues are compared with is the world's own: a ball lowered to it is through, one above it is not."""

from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError
from firmware_sim.clock import SimClock
from firmware_sim.cutting import carve_balls
from firmware_sim.skull import Skull
from firmware_sim.specimen import draw_specimen
from milling.record import RunRecorder, read_run
from studies.cue_errors import EDGES_MM, cues_of, main, table
from studies.ring_truth import through_z_mm

SEED = 5


def test_a_ball_lowered_by_it_has_just_come_through() -> None:
    specimen = draw_specimen(SEED)
    x, y, _ = specimen.skull.center_mm
    xy = np.array([[x + 2.0, y], [x, y - 2.0]])
    radius = specimen.tool.ball_radius_mm + specimen.rig.run_out_mm
    centre_z = through_z_mm(specimen, Skull(specimen), xy)
    for lower_mm, through in ((-0.01, False), (0.01, True)):
        skull = Skull(specimen)
        balls = np.column_stack([xy, centre_z - lower_mm])
        carve_balls(skull.top_z, skull.grid.x0_mm, skull.grid.y0_mm, skull.grid.step_mm, balls, radius)
        assert bool(np.any(skull.top_z < skull.inner_z)) is through


def record(folder: Path) -> float:
    """A run of one point that is cut in three laps, the middle one without a new load; its depth of coming through."""
    specimen = draw_specimen(SEED)
    x, y, z = specimen.skull.center_mm
    with RunRecorder(folder, {"seed": SEED}, SimClock()) as recorder:
        recorder.event("trajectory", ball_mm=[[x + 2.0, y, 0.0]])
        recorder.event("contact", point=1, z_mm=z)
        for depth, ratio, seen in ((0.1, 1.0, 0.3), (0.1, 1.0, 0.4), (0.2, 0.9, 0.6)):
            recorder.event("lap", depth_mm=[depth], load_ratio=[ratio], completion=[seen])
        recorder.close({})
    offset_mm = specimen.tool.ball_radius_mm * specimen.tool.axis[2]
    return float(z + offset_mm - through_z_mm(specimen, Skull(specimen), np.array([[x + 2.0, y]]))[0])


def test_each_load_counts_once_and_each_picture_by_its_depth(tmp_path: Path) -> None:
    through = record(tmp_path / "run-5")
    cues = cues_of(read_run(tmp_path / "run-5"))
    np.testing.assert_allclose(cues.load, [[0.1 - through, 1.0], [0.2 - through, 0.9]])
    np.testing.assert_allclose(cues.completion[:, 1], [0.3, 0.4, 0.6])
    np.testing.assert_allclose(cues.share, [[0.3, 0.1 / through], [0.4, 0.1 / through], [0.6, 0.2 / through]])


def test_tables_are_printed_by_excess(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "run-5")
    main([str(tmp_path)])
    assert "completion by excess" in capsys.readouterr().out
    lines = table("load ratio", "excess, um", np.array([[-0.03, 1.0], [-0.04, 0.9], [0.035, 0.8]]), EDGES_MM, 1e-3)
    assert [line.split()[3] for line in lines[2:]] == ["2", "1"]


def test_a_folder_without_runs_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no record with laps"):
        main([str(tmp_path)])
    (tmp_path / "run-1").mkdir()
    with pytest.raises(ConfigError, match="run-1"):
        main([str(tmp_path)])
