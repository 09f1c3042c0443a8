"""CiA 402 as words: controlword in, statusword out, and what the shaft does; typed from the manual."""

import itertools

import pytest
from fake_load import FakeLoad

from firmware_sim.cia402_drive import Cia402Drive, State

SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, FAULT_RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80
HALT = 0x100
STATE_MASK = 0x6F


class Host:
    """Writes and reads objects; checks nothing."""

    def __init__(self, load: FakeLoad | None = None) -> None:
        self.load = load or FakeLoad()
        self.drive = Cia402Drive(self.load)
        self.emergencies: list[bytes] = []
        self.run(0.1)

    def run(self, duration_s: float) -> None:
        self.drive.advance_to(self.drive.time_s + duration_s)
        self.emergencies += [data for can_id, data in self.drive.transmit() if can_id == 0x081]

    def write(self, index: int, value: int, size: int, subindex: int = 0) -> None:
        data = value.to_bytes(size, "little", signed=value < 0)
        self.drive.write_object((index, subindex), data)

    def read(self, index: int, *, signed: bool = False) -> int:
        return int.from_bytes(self.drive.read_object((index, 0)), "little", signed=signed)

    def control(self, *words: int) -> int:
        for word in words:
            self.write(0x6040, word, 2)
        return self.status

    @property
    def status(self) -> int:
        return self.read(0x6041)

    @property
    def speed_rpm(self) -> int:
        return self.read(0x606C, signed=True)

    def beat(self, times: int = 1) -> None:
        for _ in range(times):
            self.drive.receive(0x77F, b"\x05")
            self.run(0.1)

    def turn(self, speed_rpm: int, after_s: float = 1.5) -> None:
        self.write(0x6060, 3, 1)
        self.write(0x60FF, speed_rpm, 4)
        self.control(SHUTDOWN, SWITCH_ON, ENABLE)
        self.run(after_s)


# Controlwords from power-up, the statusword's state bits in the end.
WALKS = [
    ([], 0x40),
    ([SHUTDOWN], 0x21),
    ([SWITCH_ON], 0x40),
    ([ENABLE], 0x40),
    ([SHUTDOWN, SWITCH_ON], 0x23),
    ([SHUTDOWN, ENABLE], 0x27),
    ([SHUTDOWN, SWITCH_ON, ENABLE], 0x27),
    ([SHUTDOWN, SWITCH_ON, SHUTDOWN], 0x21),
    ([SHUTDOWN, DISABLE_VOLTAGE], 0x40),
    ([SHUTDOWN, QUICK_STOP], 0x40),
    ([SHUTDOWN, SWITCH_ON, DISABLE_VOLTAGE], 0x40),
    ([SHUTDOWN, SWITCH_ON, QUICK_STOP], 0x40),
    ([SHUTDOWN, SWITCH_ON, ENABLE, SHUTDOWN], 0x21),
    ([SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE], 0x40),
    ([SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP], 0x07),
    ([SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, DISABLE_VOLTAGE], 0x40),
    ([FAULT_RESET], 0x40),
]


@pytest.mark.parametrize(("words", "state_bits"), WALKS)
def test_walks_through_the_states(words, state_bits):
    assert Host().control(*words) & STATE_MASK == state_bits


def test_before_boot_up_the_drive_is_not_ready():
    assert Cia402Drive(FakeLoad()).state is State.NOT_READY


def test_run_up_follows_the_ramp_and_reaches_the_target():
    host = Host()
    host.write(0x6083, 20_000, 4)
    host.turn(30_000, after_s=0.75)
    assert host.speed_rpm == pytest.approx(15_000, rel=0.03)
    assert not host.status & 0x400
    assert not host.status & 0x1000
    host.run(1.0)
    assert host.speed_rpm == pytest.approx(30_000, abs=30)
    assert host.status & 0x400
    host.write(0x60FF, 10_000, 4)
    host.run(0.002)
    assert not host.status & 0x400


def test_torque_follows_the_load_in_per_mille():
    host = Host(FakeLoad(torque=0.0))
    host.turn(30_000, after_s=3.0)
    assert host.read(0x6077, signed=True) == pytest.approx(0, abs=3)
    host.load.torque = 0.35
    host.run(0.3)
    assert host.read(0x6077, signed=True) == pytest.approx(350, abs=10)


def test_a_sudden_load_droops_the_speed():
    host = Host()
    host.turn(30_000, after_s=3.0)
    host.load.torque = 0.5
    host.run(0.02)
    assert 29_000 < host.speed_rpm < 29_900


def test_reversal_passes_standstill():
    host = Host()
    host.turn(10_000)
    host.write(0x60FF, -10_000, 4)
    host.run(1.0)
    assert host.speed_rpm == pytest.approx(-10_000, abs=30)


@pytest.mark.parametrize(("index", "size"), [(0x607F, 4), (0x6080, 4)])
def test_speed_limits_hold_and_show(index, size):
    host = Host()
    host.write(index, 20_000, size)
    host.turn(50_000)
    assert host.speed_rpm == pytest.approx(20_000, abs=30)
    assert host.status & 0x800


def test_without_a_mode_nothing_turns():
    host = Host()
    host.write(0x60FF, 20_000, 4)
    host.control(SHUTDOWN, SWITCH_ON, ENABLE)
    host.run(1.0)
    assert host.speed_rpm == 0


def test_halt_stops_in_operation_and_lets_go_again():
    host = Host()
    host.turn(30_000)
    host.control(ENABLE | HALT)
    host.run(1.0)
    assert host.status & STATE_MASK == 0x27
    assert host.speed_rpm == 0
    assert host.status & 0x1000
    assert host.status & 0x400
    host.control(ENABLE)
    host.run(1.0)
    assert host.speed_rpm == pytest.approx(30_000, abs=30)


@pytest.mark.parametrize(
    ("option", "stopped_within_s", "state_bits"),
    [(0, 1.9, 0x40), (1, 1.1, 0x40), (2, 0.45, 0x40), (5, 1.1, 0x07), (6, 0.45, 0x07)],
)
def test_quick_stop_options(option, stopped_within_s, state_bits):
    host = Host()
    host.write(0x605A, option, 2)
    host.write(0x6084, 40_000, 4)
    host.write(0x6085, 100_000, 4)
    host.turn(40_000)
    host.control(QUICK_STOP)
    host.run(stopped_within_s * 0.8)
    assert host.speed_rpm > 100
    host.run(stopped_within_s * 0.3)
    assert host.speed_rpm < 100
    assert host.status & STATE_MASK == state_bits


def test_operation_resumes_from_a_quick_stop_that_stays():
    host = Host()
    host.write(0x605A, 6, 2)
    host.turn(40_000)
    host.control(QUICK_STOP)
    host.run(0.1)
    host.control(ENABLE)
    assert host.status & STATE_MASK == 0x27
    host.run(1.0)
    assert host.speed_rpm == pytest.approx(40_000, abs=30)


def test_disable_operation_ramps_down_before_it_leaves():
    host = Host()
    host.turn(30_000)
    host.control(SWITCH_ON)
    host.run(0.1)
    assert host.status & STATE_MASK == 0x27
    host.run(1.0)
    assert host.status & STATE_MASK == 0x23
    assert host.speed_rpm < 60


def test_disable_voltage_coasts():
    host = Host()
    host.turn(30_000)
    host.control(DISABLE_VOLTAGE)
    host.run(0.5)
    assert host.speed_rpm > 10_000
    assert host.read(0x6077, signed=True) == 0


def test_a_blocked_shaft_is_fault_7121():
    host = Host()
    host.turn(30_000, after_s=3.0)
    host.load.torque = 5.0
    host.run(0.3)
    assert host.emergencies == [bytes.fromhex("21 71 21 00 00 00 00 00")]
    assert host.status & STATE_MASK == 0x08
    assert host.read(0x603F) == 0x7121
    assert host.read(0x1001) == 0x21
    assert host.control(ENABLE) & STATE_MASK == 0x08
    assert host.control(FAULT_RESET) & STATE_MASK == 0x40
    assert host.read(0x1001) == 0
    host.run(0.1)
    assert host.emergencies[-1] == bytes(8)


def test_a_load_beyond_the_limit_is_fault_2310_before_the_shaft_stands():
    host = Host()
    host.turn(40_000, after_s=3.0)
    host.load.torque = 1.2
    host.run(0.3)
    assert host.emergencies == [bytes.fromhex("10 23 03 00 00 00 00 00")]
    assert host.status & STATE_MASK == 0x0F
    assert host.speed_rpm > 1000
    host.run(1.0)
    assert host.status & STATE_MASK == 0x08
    assert host.speed_rpm == 0


def test_fault_reset_needs_a_rising_edge():
    host = Host()
    host.turn(30_000)
    host.control(ENABLE | FAULT_RESET)
    host.load.torque = 5.0
    host.run(1.0)
    assert host.control(ENABLE | FAULT_RESET) & STATE_MASK == 0x08
    assert host.control(0x00, FAULT_RESET) & STATE_MASK == 0x40


@pytest.mark.parametrize(
    ("option", "state_bits", "speed_after_half_a_second"),
    [(0, 0x27, 30_000), (1, 0x08, 0), (2, 0x40, 17_500), (3, 0x40, 0)],
)
def test_a_lost_heartbeat_acts_by_6007(option, state_bits, speed_after_half_a_second):
    host = Host()
    host.write(0x6007, option, 2)
    host.write(0x1016, 0x7F << 16 | 250, 4, subindex=1)
    host.turn(30_000)
    host.beat(5)
    assert host.speed_rpm == pytest.approx(30_000, abs=30)
    host.run(0.25 + 0.5 - 0.1)
    assert host.status & STATE_MASK == state_bits
    assert host.speed_rpm == pytest.approx(speed_after_half_a_second, abs=1500)
    assert host.emergencies == [bytes.fromhex("30 81 11 00 00 00 00 00")]
    assert host.read(0x603F) == 0x8130


def test_reset_by_the_network_takes_the_current_away():
    host = Host()
    host.turn(30_000)
    host.drive.receive(0x000, b"\x81\x01")
    host.run(0.2)
    assert host.status & STATE_MASK == 0x40
    assert 1000 < host.speed_rpm < 30_000
    host.run(2.0)
    assert host.speed_rpm == 0


def test_the_world_sees_every_speed_in_order():
    host = Host()
    host.turn(30_000)
    times = [time_s for time_s, _ in host.load.speeds]
    assert times == sorted(times)
    assert max(b - a for a, b in itertools.pairwise(times)) <= 0.01
    assert host.load.speeds[-1][1] == pytest.approx(30_000, abs=30)
