"""The calibration file: whole, readable, and of one rig only."""

import hashlib
import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from instant_rig import Eyes, InstantStage, StillClock

from calib.calibration_file import Calibration, Provenance, RigIdentity
from calib.procedure import calibrate
from drivers.errors import CalibrationError, ConfigError


@pytest.fixture(scope="module")
def calibration():
    stage = InstantStage()
    eyes = Eyes(stage)
    return calibrate(
        stage,
        eyes,
        eyes.find_tip,
        clock=StillClock(),
        tool_offset_mm=(0.32, 0.0, 0.38),
        spindle_identity="drive 9",
        provenance=Provenance(date="2026-01-02T03:04:05+00:00", software="0.1.0", weights={"tip": "ab" * 32}),
    )


@pytest.fixture
def path(calibration, tmp_path):
    calibration.save(tmp_path / "calibration.toml")
    return tmp_path / "calibration.toml"


def reseal(path: Path, old: str, new: str) -> None:
    """Change the text and seal it again, as somebody who knows the seal might."""
    body = path.read_text().split("\n", 1)[1]
    assert old in body
    body = body.replace(old, new, 1)
    path.write_text(f'sha256 = "{hashlib.sha256(body.encode()).hexdigest()}"\n{body}')


def test_what_is_saved_is_what_is_loaded(calibration, path):
    loaded = Calibration.load(path, calibration.rig, for_milling=True)
    points = np.array([[5.0, -10.0, -2.5], [0.0, 0.0, 10.0]])
    assert np.array_equal(np.hstack(loaded.project(points)), np.hstack(calibration.project(points)))
    assert np.array_equal(loaded.sigma_at(points), calibration.sigma_at(points))
    assert loaded.setpoints == calibration.setpoints
    assert loaded.provenance == calibration.provenance
    assert (loaded.model, loaded.recipe, loaded.rmse_mm) == (calibration.model, "default", calibration.rmse_mm)
    assert loaded.predicted_rmse_mm == calibration.predicted_rmse_mm


@pytest.mark.parametrize(
    ("now", "max_age_h", "says"),
    [
        ("2026-01-02T13:04:05+00:00", 9.9, r"10 h old, allowed 9\.9 h .* run `mill calibrate` again"),
        ("2026-01-02T02:04:05+00:00", 9.9, "yet to come; set this machine's clock"),
    ],
)
def test_a_calibration_expires(calibration, path, now, max_age_h, says):
    with pytest.raises(CalibrationError, match=says):
        Calibration.load(path, calibration.rig, now=datetime.fromisoformat(now), max_age_h=max_age_h)


def test_a_fresh_calibration_is_loaded(calibration, path):
    now = datetime(2026, 1, 2, 13, tzinfo=UTC)
    assert Calibration.load(path, calibration.rig, now=now, max_age_h=10.1).rig == calibration.rig


def test_an_undated_calibration_is_of_no_known_age(calibration, path):
    reseal(path, "2026-01-02T03:04:05+00:00", "yesterday")
    with pytest.raises(CalibrationError, match=r"provenance\.date: found 'yesterday'"):
        Calibration.load(path, calibration.rig, now=datetime(2026, 1, 2, 13, tzinfo=UTC), max_age_h=99.0)


def test_another_exposure_is_another_calibration(calibration, path):
    brighter = calibration.rig.model_copy(update={"camera_settings": "exposure 300"})
    with pytest.raises(CalibrationError, match="cameras set to what it does not say; they are set to exposure 300 now"):
        Calibration.load(path, brighter)


def test_a_person_can_read_it(path):
    text = path.read_text()
    for line in ('motion = "stage 7"', 'camera = "eyes L1 R2"', 'date = "2026-01-02T03:04:05+00:00"', "[[setpoints]]"):
        assert line in text


def test_the_same_calibration_gives_the_same_bytes(calibration, path, tmp_path):
    calibration.save(tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("field", "value"),
    [("motion", "stage 8"), ("camera", "eyes R2 L1"), ("spindle", ""), ("center_from_tip_mm", (0.3, 0.0, 0.38))],
)
def test_another_rig_is_refused_and_the_difference_named(calibration, path, field, value):
    other = calibration.rig.model_copy(update={field: value})
    with pytest.raises(CalibrationError, match=rf"another rig \({field}: calibrated .*, found .*mill calibrate"):
        Calibration.load(path, other)
    with pytest.raises(CalibrationError, match="another rig"):
        calibration.save(path, other)


def test_a_file_may_be_looked_at_without_a_rig(path):
    assert Calibration.load(path, None).rig.motion == "stage 7"


def test_paper_recipe_is_refused_for_milling_only(tmp_path):
    stage = InstantStage()
    eyes = Eyes(stage)
    paper = calibrate(stage, eyes, eyes.find_tip, clock=StillClock(), recipe="paper")
    paper.save(tmp_path / "paper.toml")
    assert Calibration.load(tmp_path / "paper.toml", paper.rig).not_for_milling
    with pytest.raises(CalibrationError, match=r"not_for_milling.*default recipe"):
        Calibration.load(tmp_path / "paper.toml", paper.rig, for_milling=True)


def test_absent_file(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml: no such calibration file; run `mill calibrate` first"):
        Calibration.load(tmp_path / "none.toml", None)


def test_any_flipped_byte_or_torn_end_is_refused(path):
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for place in [0, 5, 12, len(whole) - 1, *rng.integers(0, len(whole), 60)]:
        damaged = bytearray(whole)
        damaged[place] ^= 0x04
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"calibration\.toml: .*run `mill calibrate` again"):
            Calibration.load(path, None)
    for length in [0, 40, 77, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(ConfigError):
            Calibration.load(path, None)


def test_a_file_that_is_no_text_is_refused(path):
    path.write_bytes(b"\xff\xfe\x00" * 30)
    with pytest.raises(ConfigError, match="cannot be read"):
        Calibration.load(path, None)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 2", "schema = 1", "key schema: found 1, allowed 2"),
        ('recipe = "default"', 'recipe = "default"\nspeed = 3', "key speed: found 3: Extra inputs"),
        ("half_diagonal_px = 5", "half_diagonal_px = -5", r"key optics\.half_diagonal_px: found -5.*greater than 0"),
        ("not_for_milling = false", 'not_for_milling = "maybe"', r"key not_for_milling: found 'maybe'"),
        ("rmse_mm = 0", "rmse_mm = nan #", "key rmse_mm: found nan"),
        ('handedness = "right-handed"', "", "key handedness: Field required"),
        ("[rig]", "[rig", "no TOML"),
    ],
)
def test_wrong_keys_are_named_in_one_line(path, old, new, message):
    reseal(path, old, new)
    with pytest.raises(ConfigError, match=message) as refusal:
        Calibration.load(path, None)
    assert "\n" not in str(refusal.value)
    assert str(path) in str(refusal.value)


def test_a_failing_disk_leaves_the_old_file_and_no_litter(calibration, path, mocker):
    before = path.read_bytes()
    mocker.patch("os.fsync", side_effect=OSError(28, os.strerror(28)))
    with pytest.raises(ConfigError, match=r"calibration\.toml: cannot be written .*No space left"):
        calibration.save(path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_rig_identity_has_no_unknown_keys():
    with pytest.raises(ValueError, match="Extra inputs"):
        RigIdentity(motion="a", camera="b", colour="red")
