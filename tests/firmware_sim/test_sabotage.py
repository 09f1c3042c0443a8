"""Each fault of the bench, seen from its wire; and that there is none of it before its time."""

import re
from collections.abc import Iterator

import can
import numpy as np
import pytest

from drivers.errors import ConnectionLostError
from firmware_sim.bench import Bench, open_in_process
from firmware_sim.clock import SimClock
from firmware_sim.faults import parse_faults
from firmware_sim.faulty_reader import FaultyReader
from firmware_sim.sabotage import TURNING_RPM
from firmware_sim.specimen import Specimen

LATER_S = 1.0


class Rig:
    """A bench with faults, and a host that speaks to its wires by hand."""

    def __init__(self, *faults: str) -> None:
        self.clock, self.bench = SimClock(), Bench(Specimen(seed=1), faults=parse_faults(faults))
        self.line, self.bus, self.left, self.right = open_in_process(self.bench, self.clock, fps=20.0)

    def say(self, data: bytes, wait_s: float = 0.2) -> str:
        self.line.write(data)
        self.clock.sleep_s(wait_s)
        return self.line.read(0.0).decode("ascii", errors="replace")

    def turn(self) -> None:
        self.bench.machine.turn(self.clock.now_s(), 2 * TURNING_RPM)
        self.clock.sleep_s(0.01)

    def pictures(self) -> tuple[np.ndarray, np.ndarray, float, float]:
        self.clock.sleep_s(0.1)
        (left, left_at_s), (right, right_at_s) = self.left.newest(), self.right.newest()
        return left, right, self.clock.now_s() - left_at_s, self.clock.now_s() - right_at_s

    def heartbeats(self, duration_s: float = 0.5) -> int:
        self.bus.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("2b17100032000000"), is_extended_id=False))
        self.clock.sleep_s(duration_s)
        heard = 0
        while (message := self.bus.recv(timeout=0.0)) is not None:
            heard += message.arbitration_id == 0x701
        return heard


@pytest.fixture(scope="module")
def healthy() -> Iterator[Rig]:
    rig = Rig()
    rig.clock.sleep_s(1.0)
    yield rig
    rig.bus.shutdown()


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    rig = Rig(*request.param)
    rig.clock.sleep_s(1.0)
    yield rig
    rig.bus.shutdown()


def of(*faults: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("rig", [faults], indirect=True, ids=["+".join(faults)])


def test_a_healthy_bench_answers(healthy: Rig) -> None:
    assert healthy.say(b"$I\n").endswith("ok\r\n")
    assert healthy.heartbeats() >= 5


@of("serial.stall@1s")
def test_time_runs_from_where_the_drill_first_turns(rig: Rig) -> None:
    rig.clock.sleep_s(5.0)
    assert "ok" in rig.say(b"\n")
    rig.turn()
    rig.clock.sleep_s(0.5)
    assert "ok" in rig.say(b"\n")
    rig.clock.sleep_s(0.5)
    assert rig.say(b"\n") == ""
    rig.bench.machine.turn(rig.clock.now_s(), 0.0)
    rig.clock.sleep_s(5.0)
    assert rig.say(b"\n") == "", "what is broken stays broken"


@of("serial.drop=0.2")
def test_bytes_are_lost_both_ways(rig: Rig) -> None:
    rig.say(b"")
    answers = [rig.say(b"$G\n") for _ in range(40)]
    whole = sum(bool(re.fullmatch(r"\[GC:[^\]]*\]\r\nok\r\n", answer)) for answer in answers)
    assert whole < 5
    assert any(answers)


@of("serial.flip=0.05")
def test_bits_are_flipped_and_none_is_lost(rig: Rig, healthy: Rig) -> None:
    rig.say(b"")
    clean = healthy.say(b"?", 0.05)
    answers = [rig.say(b"?", 0.05) for _ in range(40)]
    assert any(answer != clean for answer in answers)


@of("serial.dup=0.2")
def test_bytes_come_twice(rig: Rig) -> None:
    rig.say(b"")
    answers = "".join(rig.say(b"?", 0.05) for _ in range(40))
    assert re.search(r"MMPPos|MPPos|MPooss|MPoos|PPos|<<|>>|II|dd", answers)


@of("serial.insert=0.05")
def test_bytes_come_out_of_nowhere(rig: Rig) -> None:
    rig.say(b"")
    answers = "".join(rig.say(b"?", 0.05) for _ in range(40))
    assert "MPos" in answers
    assert re.search(r"[^\x20-\x7e\r\n]", answers)


@of("serial.slice")
def test_answers_come_in_pieces_and_whole_in_the_end(rig: Rig) -> None:
    rig.say(b"")
    while rig.line.read(0.1):
        pass
    pieces = []
    for _ in range(10):
        rig.line.write(b"$G\n")
        found = b""
        while more := rig.line.read(0.05):
            pieces.append(more)
            found += more
        assert re.fullmatch(rb"\[GC:[^\]]*\]\r\nok\r\n", found)
    assert len(pieces) > 10


@of("serial.latency=300ms")
def test_answers_are_late(rig: Rig) -> None:
    while rig.line.read(0.5):
        pass
    rig.line.write(b"\n")
    assert rig.line.read(0.25) == b""
    assert rig.line.read(0.1) == b"ok\r\n"


@of("serial.unplug")
def test_a_port_that_is_pulled_is_gone(rig: Rig) -> None:
    with pytest.raises(ConnectionLostError, match="plug it in"):
        rig.line.write(b"?")
    with pytest.raises(ConnectionLostError):
        rig.line.read(0.0)


@of("motion.alarm=2@0s")
def test_an_alarm_is_told(rig: Rig) -> None:
    rig.say(b"")
    rig.turn()
    assert "ALARM:2" in rig.say(b"", 1.0)


@of("motion.reset@0s")
def test_a_restart_shows_its_banner(rig: Rig) -> None:
    rig.say(b"")
    rig.turn()
    assert "Grbl 1.1h" in rig.say(b"", 1.0)


@of("motion.no_soft_limits", "motion.settings_changed")
def test_settings_are_not_what_the_rig_file_says(rig: Rig) -> None:
    settings = rig.say(b"$$\n", 1.0)
    assert "$20=0" in settings
    assert "$110=600.000" in settings


@of("motion.backlash=0.05mm", "motion.scale_x=1.01", "motion.lost_steps=20")
def test_the_world_is_not_where_the_board_thinks(rig: Rig) -> None:
    machine = rig.bench.machine
    start = machine.tip_mm.copy()
    machine.move_to(rig.clock.now_s() + 1.0, (-10.0, 0.0, 0.0))
    machine.move_to(rig.clock.now_s() + 2.0, (-9.99, 0.0, 0.0))
    moved = machine.tip_mm - start
    assert moved[0] == pytest.approx(-10.1 + 0.025, abs=0.002), "1 % too far, and the table has not come back yet"
    assert machine.command_mm[2] - start[2] == pytest.approx(-0.02), "20 steps of 1 um lower than told"


@of("motion.slip=0.1mm")
def test_an_axis_slips(rig: Rig) -> None:
    machine = rig.bench.machine
    start = machine.tip_mm.copy()
    machine.move_to(rig.clock.now_s() + 1.0, (-10.0, 0.0, 0.0))
    assert machine.tip_mm[0] - start[0] == pytest.approx(-9.9, abs=0.01)


@of("can.silent")
def test_a_silent_drive_is_not_heard(rig: Rig) -> None:
    assert rig.heartbeats() == 0


@of("can.bus_off")
def test_nothing_passes_a_bus_that_is_off(rig: Rig) -> None:
    assert rig.heartbeats() == 0
    assert rig.bench.drive.dictionary[0x1017, 0] == 0, "nor does the host reach the drive"


@of("can.drop=0.5")
def test_some_frames_are_lost(rig: Rig) -> None:
    for _ in range(8):
        rig.heartbeats(0.05)
    assert 5 < rig.heartbeats(2.0) < 35


@of("can.short=0.5")
def test_some_frames_lack_a_byte(rig: Rig) -> None:
    lengths = lengths_heard(rig)
    assert {0, 1} <= lengths


@of("can.flip=0.5")
def test_some_frames_are_wrong(rig: Rig) -> None:
    states = set()
    for _ in range(8):
        rig.bus.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("4000100000000000"), is_extended_id=False))
        rig.clock.sleep_s(0.02)
        while (message := rig.bus.recv(timeout=0.0)) is not None:
            states.add(bytes(message.data))
    assert len(states) > 1


def lengths_heard(rig: Rig) -> set[int]:
    found = set()
    for _ in range(8):
        rig.bus.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("2b17100032000000"), is_extended_id=False))
        rig.clock.sleep_s(0.2)
        while (message := rig.bus.recv(timeout=0.0)) is not None:
            if message.arbitration_id == 0x701:
                found.add(len(message.data))
    return found


def run_up(rig: Rig) -> None:
    for index, value in ((0x6060, 3), (0x60FF, 30_000), (0x6040, 0x06), (0x6040, 0x07), (0x6040, 0x0F)):
        rig.bench.drive.write_object((index, 0), value.to_bytes({0x6060: 1, 0x60FF: 4}.get(index, 2), "little"))
        rig.clock.sleep_s(0.02)
    rig.clock.sleep_s(1.5)


@of("spindle.slow=10%")
def test_a_slow_drill_is_slow(rig: Rig) -> None:
    run_up(rig)
    assert rig.bench.drive.speed_rpm == pytest.approx(27_000, rel=0.02)


@of("spindle.overspeed@1s")
def test_a_drill_runs_away(rig: Rig) -> None:
    run_up(rig)
    rig.clock.sleep_s(2.0)
    assert rig.bench.drive.speed_rpm == pytest.approx(45_000, rel=0.02)


@of("spindle.stall@2s")
def test_a_blocked_drill_stands_and_says_so(rig: Rig) -> None:
    run_up(rig)
    assert rig.bench.drive.speed_rpm > 29_000
    rig.clock.sleep_s(2.0)
    assert rig.bench.drive.speed_rpm == 0.0
    assert rig.bench.drive.errors


@of("spindle.emcy=0x2310@1s")
def test_an_error_of_the_drives_own_stops_it(rig: Rig) -> None:
    run_up(rig)
    rig.clock.sleep_s(2.0)
    assert rig.bench.drive.errors == (0x2310,)
    assert rig.bench.drive.speed_rpm < 100


@of("spindle.starts_by_itself")
def test_a_drill_turns_that_nobody_started(rig: Rig) -> None:
    assert rig.bench.drive.speed_rpm > 1000


@of("spindle.no_consumer")
def test_a_drive_that_does_not_mind_silence_goes_on(rig: Rig) -> None:
    rig.bench.drive.write_object((0x1016, 1), (0x7F << 16 | 100).to_bytes(4, "little"))
    rig.bus.send(can.Message(arbitration_id=0x77F, data=b"\x05", is_extended_id=False))
    run_up(rig)
    assert rig.bench.drive.speed_rpm > 29_000


@of("camera.stuck@0s")
def test_a_stuck_camera_shows_one_moment_under_new_times(rig: Rig) -> None:
    one = rig.pictures()
    assert not np.array_equal(one[0], rig.pictures()[0]), "noise lives"
    rig.turn()
    first, second = rig.pictures(), rig.pictures()
    assert np.array_equal(first[0], second[0])
    assert second[2] < 0.1


@of("camera.off@0s")
def test_a_camera_that_is_off_shows_nothing_new(rig: Rig) -> None:
    assert rig.pictures()[2] < 0.1
    rig.turn()
    rig.clock.sleep_s(1.0)
    assert rig.pictures()[2] > 1.0


@of("camera.intermittent=0.5")
def test_some_pictures_do_not_arrive(rig: Rig) -> None:
    ages_s = [rig.pictures()[2] for _ in range(40) if rig.left.newest() is not None]
    assert 5 < sum(age_s < 0.1 for age_s in ages_s) < 35


@of("camera.torn")
def test_a_torn_picture_shows_two_moments(rig: Rig) -> None:
    def plain(value: int) -> tuple[np.ndarray, np.ndarray]:
        return np.full((4, 6, 3), value, np.uint8), np.full((4, 6, 3), value + 1, np.uint8)

    for moment in (10, 20):
        shot = rig.bench.shoot(rig.clock.now_s(), render=lambda _, moment=moment: plain(moment))
    assert shot.left[:, 0, 0].tolist() == [20, 20, 10, 10]
    assert shot.right[:, 0, 0].tolist() == [21, 21, 11, 11]


@of("camera.size")
def test_pictures_of_another_size(rig: Rig, healthy: Rig) -> None:
    assert rig.pictures()[0].shape != healthy.pictures()[0].shape


@of("camera.slow=200ms")
def test_a_slow_camera_shows_the_past(rig: Rig) -> None:
    assert rig.left.newest() is None
    for _ in range(5):
        rig.clock.sleep_s(0.1)
        rig.left.newest()
    assert rig.pictures()[2] > 0.2


@of("camera.skew=40ms")
def test_eyes_that_are_out_of_step_show_two_moments(rig: Rig) -> None:
    for _ in range(3):
        rig.clock.sleep_s(0.1)
        rig.left.newest()
    _, _, left_age_s, right_age_s = rig.pictures()
    assert right_age_s - left_age_s >= 0.04


@pytest.mark.parametrize(
    ("fault", "as_it_is"),
    [
        ("camera.black", lambda left, right, clean, other: left.max() == 0),
        ("camera.swapped", lambda left, right, clean, other: close(left, other) and close(right, clean)),
        ("camera.mirrored", lambda left, right, clean, other: close(left[:, ::-1], clean) and close(right, other)),
        ("camera.exposure=2x", lambda left, right, clean, other: left.mean() > 1.15 * clean.mean()),
        ("camera.moved=1mm", lambda left, right, clean, other: close(np.roll(left, -25, axis=1), clean)),
        ("camera.glare", lambda left, right, clean, other: (left == 255).all(axis=2).sum() > 5000),
        ("camera.blur", lambda left, right, clean, other: detail(left) < 0.2 * detail(clean)),
    ],
)
def test_pictures_are_spoiled(healthy: Rig, fault: str, as_it_is) -> None:
    spoiled = Rig(fault)
    spoiled.clock.sleep_s(1.0)
    left, right, _, _ = spoiled.pictures()
    clean, other, _, _ = healthy.pictures()
    assert as_it_is(left, right, clean, other)
    assert not as_it_is(clean, other, clean, other)
    spoiled.bus.shutdown()


def close(one: np.ndarray, two: np.ndarray) -> bool:
    return float(np.abs(one.astype(int) - two).mean()) < 4.0


def detail(picture: np.ndarray) -> float:
    return float(np.abs(np.diff(picture.astype(int), axis=1)).mean())


class EvenReader:
    """Reads 0.9 with an upper bound of 0.95 everywhere."""

    def over(self, ring_px, ball_px, *, reference):
        return self

    def read(self, image):
        self.completion, self.upper = np.full(32, 0.9), np.full(32, 0.95)
        self.visible = np.ones(32, bool)
        return self


@pytest.mark.parametrize(("reach", "count"), [("one", 1), ("arc", 8), ("all", 32)])
def test_completion_stays_low_where_it_is_told_to(reach: str, count: int) -> None:
    clock = SimClock()
    faults = parse_faults([f"vision.low=0.7:{reach}@2s"])
    ring = FaultyReader(EvenReader(), faults, clock, seed=3).over(np.zeros((32, 2)), 5.0, reference=None)
    assert (ring.read(np.zeros(1)).completion == 0.9).all()
    clock.sleep_s(2.0)
    reading = ring.read(np.zeros(1))
    assert (reading.completion == 0.7).sum() == count
    assert (reading.upper == 0.75).sum() == count


def test_other_faults_of_reading() -> None:
    clock = SimClock()

    def read(fault: str):
        return (
            FaultyReader(EvenReader(), parse_faults([fault]), clock, seed=3)
            .over(np.zeros((32, 2)), 5.0, reference=None)
            .read(np.zeros(1))
        )

    assert np.isnan(read("vision.nan").completion).all()
    assert (read("vision.high").completion == 1.0).all()
    before_s = clock.now_s()
    read("vision.slow=500ms")
    assert clock.now_s() - before_s == pytest.approx(0.5)
