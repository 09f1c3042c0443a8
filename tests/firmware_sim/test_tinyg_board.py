"""The emulated g2core board, asked by hand (g2core wiki: JSON, status reports, feedhold, homing, alarms)."""

import json
from collections.abc import Iterator
from typing import Any

import pytest

from drivers.errors import ConfigError
from firmware_sim.bench import ORIGIN_MM, Bench, open_in_process
from firmware_sim.clock import SimClock
from firmware_sim.faults import parse_faults
from firmware_sim.specimen import Specimen


class Rig:
    """A bench with a g2core board, and a host that speaks to it by hand."""

    def __init__(self, *faults: str) -> None:
        self.clock = SimClock()
        self.bench = Bench(Specimen(seed=1), motion="tinyg", faults=parse_faults(faults))
        self.line, self.bus, _, _ = open_in_process(self.bench, self.clock)

    def say(self, data: bytes, wait_s: float = 0.02) -> list[Any]:
        self.line.write(data)
        self.clock.sleep_s(wait_s)
        return [json.loads(line) for line in self.line.read(0.0).splitlines()]

    def value(self, name: str) -> Any:
        return self.say(b'{"%s":null}\n' % name.encode())[-1]["r"][name]

    def ready(self) -> "Rig":
        self.clock.sleep_s(0.5)
        self.say(b'{"jv":5}\n{"sv":0}\n')
        return self

    def home(self) -> None:
        self.say(b"G28.2X0Y0Z0\n", 12.0)
        assert self.value("home") == 1


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig().ready()
    yield rig
    rig.bus.shutdown()


def test_power_up_says_who_it_is() -> None:
    rig = Rig()
    ready = rig.say(b"", 0.4)[0]
    assert ready["r"]["msg"] == "SYSTEM READY"
    assert ready["r"]["fb"] == 101.03
    assert ready["r"]["id"] == f"mill-bench-{rig.bench.serial_number}"
    assert ready["f"] == [1, 0, 0]


def test_settings_are_read_written_and_refused(rig: Rig) -> None:
    assert rig.say(b'{"xtn":null}\n') == [{"r": {"xtn": -35}, "f": [1, 0, 13]}]
    assert rig.say(b"{ztn:-5.5}\n") == [{"r": {"ztn": -5.5}, "f": [1, 0, 11]}], "relaxed JSON"
    assert rig.value("z")["tn"] == -5.5
    assert rig.say(b'{"nonsense":1}\n')[0]["f"][1] == 100
    assert rig.say(b'{"fb":1}\n')[0]["f"][1] == 104
    assert rig.say(b'{"sl":7}\n')[0]["f"][1] == 109
    assert rig.say(b'{"sl":\n')[0] == {"r": {"err": '{"sl":'}, "f": [1, 111, 7]}


def test_a_checksum_is_verified_and_the_line_is_repeated(rig: Rig) -> None:
    assert rig.say(b"N1G21*59\n") == [{"r": {"gc": "N1G21*59", "n": 1}, "f": [1, 0, 9]}]
    assert rig.say(b"N1G21*58\n")[0]["f"][1] == 118
    assert rig.say(b"G21*68\n")[0]["f"][1] == 120


@pytest.mark.parametrize(
    ("block", "status"),
    [("G1X1", 142), ("G99", 131), ("M99", 132), ("G1", 134), ("G0G1X1", 133), ("X--1", 102), ("Q1", 101)],
)  # fmt: skip
def test_a_block_that_cannot_be_is_refused(rig: Rig, block: str, status: int) -> None:
    assert rig.say(block.encode() + b"\n")[0]["f"][1] == status
    assert rig.value("stat") == 1


def test_homing_puts_zero_at_the_switches(rig: Rig) -> None:
    rig.home()
    assert rig.value("stat") == 3
    position = [rig.value(f"mpo{axis}") for axis in "xyz"]
    assert position == [-1, -1, -1]
    tip = [machine - origin for machine, origin in zip(position, ORIGIN_MM, strict=True)]
    assert rig.bench.machine.tip_mm == pytest.approx(tip, abs=0.02)


def test_a_move_waits_for_more_then_runs_at_its_feed(rig: Rig) -> None:
    rig.home()
    rig.say(b"G90G1X-11F600\n", 0.01)
    assert rig.say(b'{"stat":null,"vel":null,"qr":null}\n')[0]["r"] == {"stat": 5, "vel": 0, "qr": 47}
    rig.clock.sleep_s(0.4)
    assert rig.value("vel") == pytest.approx(600, rel=0.15)
    rig.clock.sleep_s(1.0)
    assert (rig.value("stat"), rig.value("vel"), rig.value("qr"), rig.value("mpox")) == (3, 0, 48, -11)


def test_a_hold_slows_down_resumes_and_flushes_only_when_held(rig: Rig) -> None:
    rig.home()
    rig.say(b"G1X-21F600\n", 0.5)
    rig.say(b"%\n", 0.1)
    assert rig.value("stat") == 5, "a queue flush without a hold is none"
    rig.say(b"!")
    assert rig.value("stat") == 6
    rig.clock.sleep_s(0.2)
    held = rig.value("mpox")
    assert rig.say(b"G1X-5\n", 0.3) == [], "no G-code is read in a hold"
    assert (rig.value("vel"), rig.value("mpox")) == (0, held)
    rig.say(b"~", 0.3)
    assert rig.value("mpox") < held
    rig.say(b"!%", 0.5)
    assert (rig.value("stat"), rig.value("qr")) == (3, 48)
    assert -20 < rig.value("mpox") < held


def test_a_killed_job_stands_forgets_and_says_so(rig: Rig) -> None:
    rig.home()
    rig.say(b"G1X-21F600\nG1X-31\n", 0.5)
    told = rig.say(b"\n!\x04\n", 0.3)
    assert [line["er"]["st"] for line in told if "er" in line] == [207]
    assert (rig.value("stat"), rig.value("qr"), rig.value("home")) == (4, 48, 1)


def test_a_soft_limit_alarms_until_it_is_cleared(rig: Rig) -> None:
    rig.say(b"G1Z1F600\n", 0.3)
    assert rig.value("stat") == 3, "an axis that was not homed is not checked"
    rig.home()
    told = rig.say(b"G1Z-28.01F600\n")
    assert [line["er"]["st"] for line in told if "er" in line] == [225]
    assert rig.value("stat") == 2
    assert rig.say(b"G1Z-5\n")[0]["f"][1] == 204
    assert rig.say(b'{"ztn":-30}\n')[0]["f"][1] == 204
    rig.say(b'{"clear":null}\n')
    assert rig.value("stat") == 3
    rig.say(b"G1Z-2F600\n", 1.0)
    assert rig.value("mpoz") == -2


def test_a_reset_forgets_the_position_and_how_it_was_to_speak(rig: Rig) -> None:
    rig.home()
    told = rig.say(b"\x18", 0.4)
    assert told[0]["r"]["msg"] == "SYSTEM READY"
    rig.say(b'{"jv":5}\n')
    assert (rig.value("home"), rig.value("mpox"), rig.value("sv"), rig.value("xtn")) == (0, 0, 1, -35)


def test_reports_come_by_themselves_where_they_are_wanted(rig: Rig) -> None:
    rig.home()
    rig.say(b'{"sv":1}\n{"qv":1}\n{"si":100}\n')
    told = rig.say(b"G1X-6F600\n", 0.6)
    assert {"qr": 47} in told
    assert any("posx" in line.get("sr", {}) for line in told)


@pytest.mark.parametrize(("code", "status"), [(1, 203), (2, 220)])
def test_an_alarm_is_planted(code: int, status: int) -> None:
    rig = Rig(f"motion.alarm={code}@0s").ready()
    rig.bench.machine.turn(rig.clock.now_s(), 2000.0)
    assert status in [line["er"]["st"] for line in rig.say(b"", 0.1) if "er" in line]


def test_the_other_faults_of_a_motion_board_are_planted() -> None:
    rig = Rig("motion.no_soft_limits", "motion.settings_changed", "motion.firmware=100.26", "motion.lost_steps=20")
    rig.ready()
    assert (rig.value("sl"), rig.value("xvm"), rig.value("fb")) == (0, 600, 100.26)
    assert rig.bench.machine.lost_mm[2] == pytest.approx(-0.02)
    rig = Rig("motion.reset@0s").ready()
    rig.bench.machine.turn(rig.clock.now_s(), 2000.0)
    assert "SYSTEM READY" in str(rig.say(b"", 0.4))


@pytest.mark.parametrize("fault", ["motion.alarm=5", "motion.firmware=1.1f"])
def test_a_fault_that_this_board_cannot_have_is_refused_by_name(fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        Rig(fault)
