import math

import pytest

from drivers.errors import ConfigError
from firmware_sim.bench import ORIGIN_MM, Bench, open_in_process
from firmware_sim.clock import SimClock
from firmware_sim.faults import parse_faults


def say(line, text: bytes, until: bytes, timeout_s: float = 30.0) -> bytes:
    """Write, then read until an answer holds ``until``."""
    line.write(text)
    heard = b""
    while until not in heard:
        data = line.read(timeout_s)
        assert data, f"{text!r}: heard only {heard!r}"
        heard += data
    return heard


@pytest.fixture(scope="module")
def bench():
    return Bench(seed=3)


def test_one_seed_gives_one_world_and_another_gives_another():
    assert Bench(seed=3).specimen == Bench(seed=3).specimen
    assert Bench(seed=3).specimen != Bench(seed=4).specimen


def test_the_whole_bench_over_in_process_wires(bench):
    clock = SimClock()
    line, bus, left, right = open_in_process(bench, clock)

    # Homing puts machine zero at the switches, and the tip where the rig file's origin says.
    line.read(0.1)
    say(line, b"$H\n", b"ok\r\n")
    report = say(line, b"?", b">\r\n").decode()
    machine_mm = [float(value) for value in report.split("MPos:")[1].split("|")[0].split(",")]
    tip_mm = [machine - origin for machine, origin in zip(machine_mm, ORIGIN_MM, strict=True)]
    assert tip_mm == pytest.approx([24.0, 9.0, 19.0])
    assert bench.machine.tip_mm == pytest.approx(tip_mm, abs=0.02)

    # The drive turns the shaft of the same world.
    boot = bus.recv(timeout=0.0)
    assert boot.arbitration_id == 0x701
    for key, value, size in (((0x6060, 0), 3, 1), ((0x60FF, 0), 40_000, 4)):
        bench.drive.write_object(key, value.to_bytes(size, "little"))
    for word in (6, 7, 15):
        bench.drive.write_object((0x6040, 0), word.to_bytes(2, "little"))
    clock.sleep_s(1.5)
    assert bench.machine.spindle_rpm == pytest.approx(40_000, rel=0.01)
    assert int.from_bytes(bench.drive.read_object((0x6077, 0)), "little") > 20

    # Moving the stage changes both pictures, and the truth with them.
    before = [source.wait_newer(clock.now_s(), 1.0)[0] for source in (left, right)]
    say(line, b"G21G90G53G1X-20Y-20Z-15F1200\n", b"ok\r\n")
    clock.sleep_s(3.0)
    after = [source.wait_newer(clock.now_s(), 1.0)[0] for source in (left, right)]
    for old, new in zip(before, after, strict=True):
        assert abs(old.astype(int) - new).mean() > 1.0
    assert bench.truth()["tip_mm"] == pytest.approx([5.0, -10.0, 5.0], abs=0.02)
    assert bench.truth()["membrane_touched"] is False
    assert bench.depth_mm < 0


def run_a_little(dialect) -> tuple[bytes, float, float]:
    bench = Bench(seed=5, dialect=dialect)
    clock = SimClock()
    clock.attach(bench.advance_to)
    heard = b""
    bench.board.receive(b"$H\n?")
    for _ in range(100):
        clock.sleep_s(0.05)
        heard += bench.board.transmit()
    x, y, z = bench.machine.tip_mm
    return heard, math.fsum((x, y, z)), bench.now_s


@pytest.mark.parametrize("dialect", ["gnea", "grblhal"])
def test_the_same_bench_does_the_same_twice(dialect):
    assert run_a_little(dialect) == run_a_little(dialect)


@pytest.mark.parametrize("fault", ["serial.drop", "motion.lost_steps", "motion.firmware", "port.held"])
def test_a_robot_has_no_faults_of_a_grbl_board(fault: str) -> None:
    with pytest.raises(ConfigError, match="this bench has a robot"):
        Bench(motion="bcap", faults=parse_faults([fault]))
