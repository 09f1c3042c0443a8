"""A rig file that cannot be used is refused in one line: file, key, value, what is allowed."""

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from pytest_mock import MockerFixture
from rig_file import GOOD

from cli.config import GrblMotion, OtherBackend, load_rig
from cli.rig import silence_s
from drivers.backends import ENTRY_POINT_GROUP
from drivers.errors import ConfigError


def write(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text)
    return path


def test_a_good_file_loads_with_the_defaults_of_the_field(tmp_path: Path) -> None:
    rig = load_rig(write(tmp_path, GOOD))
    assert isinstance(rig.motion, GrblMotion)
    assert rig.motion.baud == 115200
    assert rig.motion.settings == {"$100": 1000.0}
    assert rig.tool.ball_radius_mm == 0.5
    assert sum(value**2 for value in rig.tool.center_from_tip_mm) == pytest.approx(0.25)


@pytest.mark.parametrize(("reply_s", "heartbeat_s", "waits_s"), [(0.05, 0.1, 0.55), (0.5, 0.25, 1.75)])
def test_a_supervisor_is_as_patient_as_both_wires(
    tmp_path: Path, reply_s: float, heartbeat_s: float, waits_s: float
) -> None:
    patient = GOOD.replace("[motion]", f"[motion]\nreply_s = {reply_s}")
    patient = patient.replace("[spindle]", f"[spindle]\nheartbeat_s = {heartbeat_s}")
    assert silence_s(load_rig(write(tmp_path, patient))) == pytest.approx(waits_s)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("[camera]", "[camera]\nshutter = 3", ["camera.shutter", "unknown key", "exposure"]),
        ('name = "bench"', 'name = "bench"\ncolour = 3', ["colour", "unknown key", "motion"]),
        ("[motion.settings]", "[motion.setings]", ["motion.setings", "unknown key", "settings"]),
        ("schema = 1", "schema = 2", ["schema", "2", "1"]),
        ("origin_mm = [-25.0, -10.0, -20.0]", "origin_mm = [-25.0, -10.0]", ["motion.origin_mm"]),
        ("origin_mm = [-25.0, -10.0, -20.0]", "origin_mm = [nan, 0.0, 0.0]", ["motion.origin_mm", "nan"]),
        ('port = "/dev/mill-motion"', "", ["motion.port", "missing"]),
        ('left = "/dev/mill-left"', "left = 7", ["camera.left", "7"]),
        ('backend = "cia402"', 'backend = "cia402"\nnode_id = 200', ["spindle.node_id", "200", "126"]),
        ("exposure = 150", "", ["camera.exposure", "None", "fixed exposure"]),
        ('backend = "cia402"', 'backend = "cia402"\nspeed_rpm = 7e4', ["spindle.max_speed_rpm", "60000", "70000"]),
        ('backend = "grbl"', 'backend = "acme"', ["motion.backend", "acme", "grbl"]),
        ('backend = "cia402"', "backend = [1]", ["spindle.backend", "[1]", "cia402"]),
        ('backend = "cia402"', 'backend = "cia402"\nbitrate = 300000', ["spindle.bitrate", "300000", "250000"]),
        ('"$100" = 1000.0', '"x-steps" = 1000.0', ["motion.settings.x-steps", "pattern"]),
        ("[camera]", "[camera", ["not TOML", "line"]),
    ],
)
def test_a_bad_file_is_named_with_its_key(tmp_path: Path, old: str, new: str, says: list[str]) -> None:
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    message = str(caught.value)
    assert "\n" not in message
    for words in [str(path), *says]:
        assert words in message


def test_weights_of_ones_own_count_from_the_rig_file(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(GOOD + '\n[weights]\nlandmarks = "nets/landmarks.onnx"\n')
    weights = load_rig(path).weights
    assert (weights.landmarks, weights.tip) == (tmp_path / "nets/landmarks.onnx", None)
    path.write_text(GOOD + '\n[weights]\nlandmark = "x.onnx"\n')
    with pytest.raises(ConfigError, match=r"weights\.landmark: unknown key; allowed: tip, landmarks, completion"):
        load_rig(path)


def test_a_file_that_is_not_there_names_the_next_step(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no-rig\.toml: no such rig file; `mill emulate"):
        load_rig(tmp_path / "no-rig.toml")


def test_a_third_party_backend_keeps_its_keys(tmp_path: Path, mocker: MockerFixture) -> None:
    installed = EntryPoint("motion.acme", "acme.mill:Stage", ENTRY_POINT_GROUP)
    mocker.patch("drivers.backends.entry_points", return_value=[installed])
    rig = load_rig(write(tmp_path, GOOD.replace('backend = "grbl"', 'backend = "acme"\nspeed = 3', 1)))
    assert isinstance(rig.motion, OtherBackend)
    assert rig.motion.model_dump()["speed"] == 3
