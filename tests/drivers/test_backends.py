import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints

import pytest
from pytest_mock import MockerFixture

from drivers.backends import BUILT_IN, backend_names, load_backend
from drivers.errors import ConfigError


def add_entry_point(mocker: MockerFixture, name: str, value: str) -> None:
    points = EntryPoints([EntryPoint(name, value, "mill.drivers")])
    mocker.patch("drivers.backends.entry_points", points.select)


@pytest.mark.parametrize("key", BUILT_IN)
def test_every_built_in_backend_can_be_loaded(key: str) -> None:
    kind, _, name = key.partition(".")
    assert callable(load_backend(kind, name))  # type: ignore[arg-type]


def test_an_unknown_backend_lists_the_known_ones() -> None:
    with pytest.raises(
        ConfigError, match=r"\[motion\] backend = 'marlin' is unknown; known are 'bcap', 'grbl', 'tinyg'"
    ):
        load_backend("motion", "marlin")


def test_a_third_party_adds_one_by_an_entry_point(mocker: MockerFixture) -> None:
    add_entry_point(mocker, "motion.marlin", "fractions:Fraction")
    assert backend_names("motion") == ["bcap", "grbl", "marlin", "tinyg"]
    assert load_backend("motion", "marlin")(1, 2) == 0.5


def test_an_entry_point_that_leads_nowhere_is_named(mocker: MockerFixture) -> None:
    add_entry_point(mocker, "camera.broken", "no_such_module:Camera")
    with pytest.raises(ConfigError, match=r"\[camera\] backend = 'broken': no_such_module:Camera.*reinstall"):
        load_backend("camera", "broken")


def test_the_table_imports_nothing_heavy() -> None:
    code = "import sys, drivers.backends, drivers.discovery; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"serial", "can", "canopen", "cv2", "numpy"} & set(modules)
