"""Shape of the bone: what the file says is what stands in {R}."""

from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError
from firmware_sim.skull import Grid, Skull
from firmware_sim.specimen import SkullShape, Specimen


def skull(**shape: object) -> Skull:
    return Skull(Specimen(skull=SkullShape.model_validate(shape)))


def test_landmarks_stand_where_the_file_says() -> None:
    bone = skull(tilt_deg={"pitch": 4.0, "roll": -3.0, "yaw": 30.0})
    middle = 0.5 * (bone.bregma_mm + bone.lambda_mm)
    assert middle[:2] == pytest.approx([5.0, -10.0])
    assert np.linalg.norm(bone.bregma_mm - bone.lambda_mm) == pytest.approx(4.2, abs=1e-3)
    nose = bone.bregma_mm - bone.lambda_mm
    assert np.rad2deg(np.arctan2(-nose[1], -nose[0])) == pytest.approx(30.0)
    assert nose[2] == pytest.approx(4.2 * np.sin(np.deg2rad(4.0)))


def test_the_surface_goes_through_the_center_and_bends_as_told() -> None:
    bone = skull(tilt_deg={"pitch": 0.0, "roll": 0.0, "yaw": 0.0})
    assert bone.surface.outer_z(5.0, -10.0) == pytest.approx(-2.5)
    # Without yaw the lateral direction is y: a circle of 7 mm drops 0.292 mm at 2 mm.
    assert bone.surface.outer_z(5.0, -8.0) == pytest.approx(-2.5 - (7 - np.sqrt(49 - 4)))
    assert bone.surface.outer_z(3.0, -10.0) == pytest.approx(-2.5 - (12 - np.sqrt(144 - 4)))


def test_the_skull_drops_behind_lambda_as_measured() -> None:
    bone = skull(tilt_deg={"pitch": 0.0, "roll": 0.0, "yaw": 0.0})
    lambda_x = bone.lambda_mm[0]
    for behind, drop in ((0.5, 0.18), (1.5, 0.35), (3.0, 0.70), (4.48, 2.12)):
        z = float(bone.surface.outer_z(lambda_x + behind, -10.0))
        assert bone.lambda_mm[2] - z == pytest.approx(drop, abs=0.01)


def test_completion_is_the_share_of_the_local_thickness() -> None:
    bone = skull()
    thickness = float(bone.remaining_at(5.0, -10.0))
    assert bone.completion_at(5.0, -10.0) == 0.0
    bone.top_z -= np.float32(0.25 * thickness)
    assert bone.completion_at(5.0, -10.0) == pytest.approx(0.25, abs=1e-3)
    bone.top_z -= np.float32(2.0)
    assert bone.completion_at(5.0, -10.0) == 1.0
    assert bone.remaining_at(5.0, -10.0) == 0.0
    assert np.isnan(bone.completion_at(100.0, 0.0))


def test_maps_replace_the_models(tmp_path: Path) -> None:
    # A slope to the animal's right only; rows run from the nose back, columns to the right.
    height = np.tile(np.linspace(-0.4, 0.4, 401, dtype=np.float32), (301, 1))
    np.save(tmp_path / "height.npy", height)
    np.save(tmp_path / "thickness.npy", np.full((301, 401), 0.3, np.float32))
    flat = {"pitch": 0.0, "roll": 0.0, "yaw": 0.0}
    bone = skull(
        height_map=tmp_path / "height.npy", thickness_map=tmp_path / "thickness.npy", tilt_deg=flat, grid_mm=0.02
    )
    assert bone.surface.outer_z(5.0, -9.0) == pytest.approx(-2.5 + 0.1, abs=1e-4)
    assert bone.surface.outer_z(4.0, -10.0) == pytest.approx(-2.5, abs=1e-4)
    assert bone.remaining_at(5.0, -9.0) == pytest.approx(0.3, abs=1e-4)


def test_bone_too_high_is_refused() -> None:
    with pytest.raises(ConfigError, match="highest bone"):
        skull(center_mm=[5.0, -10.0, -0.5])


def test_a_bad_map_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "height.npy", np.zeros(5))
    with pytest.raises(ConfigError, match=r"skull\.height_map"):
        skull(height_map=tmp_path / "height.npy")


def test_sampling_is_bilinear() -> None:
    grid = Grid(0.0, 0.0, 0.5, 3, 3)
    field = np.array([[0, 1, 2], [10, 11, 12], [20, 21, 22]], np.float32)
    assert grid.sample(field, 0.25, 0.75) == pytest.approx(6.5)
    assert np.isnan(grid.sample(field, -0.01, 0.0))
