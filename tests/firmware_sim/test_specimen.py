"""The specimen file: every key optional, every mistake named."""

from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError
from firmware_sim.skull import Skull
from firmware_sim.specimen import Specimen, draw_specimen, load_specimen


def written(folder: Path, text: str) -> Path:
    path = folder / "specimen.toml"
    path.write_text(text)
    return path


def test_an_empty_file_is_the_default_specimen(tmp_path: Path) -> None:
    assert load_specimen(written(tmp_path, "")) == Specimen()


def test_the_documented_file_loads(tmp_path: Path) -> None:
    text = """
        schema = 1
        kind = "mouse"
        seed = 12
        [skull]
        bregma_lambda_mm = 4.2
        radius_of_curvature_mm = { lateral = 7.0, rostrocaudal = 12.0 }
        tilt_deg = { pitch = 3.0, roll = -2.0, yaw = 8.0 }
        center_mm = [5.0, -10.0, -2.5]
        thickness_mm = { mean = 0.38, min = 0.27, max = 0.51, waviness = 0.03 }
        grid_mm = 0.02
        [membrane]
        clearance_mm = 0.10
        [appearance]
        brightness = 1.0
        wetness = 0.5
        dust = 0.5
        [mechanics]
        stiffness_n_per_mm = 20.0
        flap_softening = 0.6
        [spindle]
        torque_noise = 0.03
        torque_ripple = 0.05
        torque_drift = 0.02
        [rig]
        seed = 3
        microscope_tilt_deg = 12.0
        toe_in_deg = 7.26
        perspective = 0.02
        distortion = 0.01
        noise_dn = 2.0
        backlash_mm = 0.005
        run_out_mm = 0.01
    """
    assert load_specimen(written(tmp_path, text)) == Specimen(seed=12)


def test_a_file_overrides_what_it_names(tmp_path: Path) -> None:
    base = draw_specimen(5)
    loaded = load_specimen(written(tmp_path, "[rig]\ntoe_in_deg = 7.0\n"), base)
    assert loaded.rig.toe_in_deg == 7.0
    assert loaded.rig.model_copy(update={"toe_in_deg": base.rig.toe_in_deg}) == base.rig
    assert loaded.skull == base.skull


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("[skul]\n", ["skul", "allowed", "skull, membrane"]),
        ("[rig]\ntoe_in = 7\n", ["rig.toe_in", "toe_in_deg"]),
        ("[skull]\ntilt_deg = { pich = 3 }\n", ["skull.tilt_deg.pich", "pitch, roll, yaw"]),
        ("[appearance]\nwetness = 2\n", ["appearance.wetness", "less than or equal to 1", "found 2"]),
        ("[skull]\nthickness_mm = { mean = 0.6 }\n", ["skull.thickness_mm", "min <= mean <= max"]),
        (
            '[appearance]\ntexture = "none.jpg"\nbregma_px = [1, 2]\nlambda_px = [1, 90]\n',
            ["appearance.texture", "none.jpg"],
        ),
        ('[appearance]\ntexture = "a.jpg"\n', ["bregma_px"]),
        ("schema = 2\n", ["schema", "found 2"]),
        ("kind = 'rat'\n", ["kind", "eggshell", "rat"]),
        ("seed = nan\n", ["seed"]),
        ("[[[", ["not TOML"]),
    ],
)
def test_a_mistake_is_named_with_file_and_key(tmp_path: Path, text: str, parts: list[str]) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        load_specimen(path)
    for part in parts:
        assert part in str(error.value)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.toml"):
        load_specimen(tmp_path / "absent.toml")


def test_a_drawing_is_repeatable_and_possible() -> None:
    assert draw_specimen(7) == draw_specimen(7)
    assert draw_specimen(7) != draw_specimen(8)
    for seed in range(12):
        for kind in ("mouse", "eggshell"):
            specimen = draw_specimen(seed, kind)  # type: ignore[arg-type]
            center = np.array(specimen.skull.center_mm)
            assert np.abs(center - (5, -10, -2.5)).max() <= 1.0
            skull = Skull(specimen)
            assert skull.outer_z.max() <= -1.0
            thickness = skull.outer_z - skull.inner_z
            assert thickness.min() > 0.2
            assert thickness.max() < 0.52
