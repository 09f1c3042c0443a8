"""The spindles of a rig file: their tables, and what `mill emulate` writes for each make."""

from pathlib import Path

import pytest

from cli.config import GrblSpindleTable, ModbusSpindleTable, load_rig
from cli.emulate import rig_text
from drivers.errors import ConfigError
from firmware_sim.bench import Bench, SpindleMake
from firmware_sim.faults import parse_faults
from firmware_sim.serve import BenchService
from firmware_sim.specimen import Specimen

MODBUS = '[spindle]\nbackend = "modbus"\nport = "/dev/mill-spindle"\nrated_current_a = 3\n'
GRBL = '[spindle]\nbackend = "grbl"\n'


def rig(folder: Path, spindle: str) -> Path:
    motion = 'backend = "grbl"\nport = "/dev/mill-motion"\norigin_mm = [0, 0, 0]'
    path = folder / "rig.toml"
    camera = '[camera]\nleft = "http://127.0.0.1:1/l"\nright = "http://127.0.0.1:1/r"\n'
    path.write_text(f'schema = 1\nname = "a rig"\n[motion]\n{motion}\n{spindle}\n{camera}')
    return path


@pytest.mark.parametrize("make", ["cia402", "modbus", "grbl"])
def test_what_emulate_writes_is_a_rig_file_of_that_make(tmp_path: Path, make: SpindleMake) -> None:
    with BenchService(Bench(Specimen(seed=1), spindle=make)) as service:
        (tmp_path / "rig.toml").write_text(rig_text(service, "a bench"))
    spindle = load_rig(tmp_path / "rig.toml").spindle
    assert spindle.backend == make
    assert spindle.model_dump()["speed_rpm"] == 45_000


def test_the_tables_defaults(tmp_path: Path) -> None:
    modbus = load_rig(rig(tmp_path, MODBUS)).spindle
    assert isinstance(modbus, ModbusSpindleTable)
    assert (modbus.baud, modbus.framing, modbus.station, modbus.poles, modbus.heartbeat_s) == (38_400, "8N2", 1, 2, 0.3)
    grbl = load_rig(rig(tmp_path, GRBL)).spindle
    assert isinstance(grbl, GrblSpindleTable)
    assert grbl.run_up_s == 2.0


@pytest.mark.parametrize(
    ("spindle", "told"),
    [
        (MODBUS + "heartbeat_s = 0.25\n", "0.1 s"),
        (MODBUS + "poles = 3\n", "spindle.poles"),
        (MODBUS + "speed_rpm = 7e4\n", "spindle.max_speed_rpm"),
        (MODBUS.replace("rated_current_a = 3\n", ""), "spindle.rated_current_a: missing"),
        (GRBL + 'port = "/dev/ttyUSB0"\n', "spindle.port: unknown key"),
    ],
)
def test_what_is_wrong_is_told_by_its_key(tmp_path: Path, spindle: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        load_rig(rig(tmp_path, spindle))


def test_faults_of_a_bus_that_is_not_there_are_refused() -> None:
    with pytest.raises(ConfigError, match="no CAN bus"):
        Bench(Specimen(seed=1), spindle="modbus", faults=parse_faults(["can.drop=0.1"]))


@pytest.mark.parametrize("make", ["modbus", "grbl"])
def test_the_drive_of_either_make_can_be_broken(make: SpindleMake) -> None:
    bench = Bench(Specimen(seed=1), spindle=make, faults=parse_faults(["spindle.starts_by_itself"]))
    bench.advance_to(0.5)
    assert bench.machine.spindle_rpm == pytest.approx(5000.0, rel=0.05)
