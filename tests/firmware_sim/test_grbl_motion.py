"""How the board moves: acceleration, look-ahead, the bounded queue, holds, cancels, overrides."""

import math

import numpy as np
import pytest
from grbl_bench import FAST, Host, homed, unlocked

DIALECTS = ["gnea", "grblhal"]
BLOCKS = {"gnea": 15, "grblhal": 100}
ACCELERATION = 500.0


def stream(host: Host, lines: list[bytes], limit: int) -> None:
    """Write lines as fast as the receive buffer takes them, counting characters."""
    in_flight: list[int] = []
    seen = len(host.lines)
    for line in lines:
        while sum(in_flight) + len(line) > limit:
            host.run(0.001)
            for _, reply in host.lines[seen:]:
                assert reply == "ok"
                in_flight.pop(0)
            seen = len(host.lines)
        host.board.receive(line)
        in_flight.append(len(line))


def speeds(host: Host, since_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and speeds of the motors over 10 ms."""
    times = np.array([time_s for time_s, _ in host.desk.track])
    places = np.array([place for _, place in host.desk.track])
    grid = np.arange(since_s, host.time_s, 0.01)
    at = np.stack([np.interp(grid, times, places[:, axis]) for axis in range(3)], axis=1)
    return grid[1:], np.linalg.norm(np.diff(at, axis=0), axis=1) / 0.01


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_move_speeds_up_cruises_and_slows_down(dialect):
    host = homed(dialect)
    start_s, start = host.time_s, host.desk.axes_mm
    host.ask(b"G91G1X-6F600\n")
    host.wait_for_state("Idle")
    assert host.desk.axes_mm[0] - start[0] == pytest.approx(-6.0, abs=1e-9)
    _, speed = speeds(host, start_s)
    assert speed.max() == pytest.approx(10.0, abs=0.15)
    assert np.abs(np.diff(speed)).max() / 0.01 < 1.3 * ACCELERATION
    moving_s = np.count_nonzero(speed > 0.05) * 0.01
    assert moving_s == pytest.approx(0.6 + 10.0 / ACCELERATION, abs=0.03)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_short_blocks_on_a_line_run_at_full_speed_and_corners_slow_down(dialect):
    host = homed(dialect)
    start_s = host.time_s
    host.ask(b"G91\n")
    stream(host, [b"G1X-0.2F600\n"] * 40, 120)
    host.wait_for_state("Idle")
    _, speed = speeds(host, start_s)
    cruising = speed[speed > 9.5]
    assert len(cruising) * 0.01 == pytest.approx(0.8, abs=0.1), "no stutter between blocks"
    start_s = host.time_s
    stream(host, [b"G1Y-2F600\n", b"G1X2\n"], 120)
    host.wait_for_state("Idle")
    times, speed = speeds(host, start_s)
    corner = speed[(times > start_s + 0.15) & (times < start_s + 0.32)].min()
    expected = math.sqrt(ACCELERATION * math.sqrt(2) * 0.01 * math.sqrt(0.5) / (1 - math.sqrt(0.5)))
    assert corner == pytest.approx(expected, abs=1.0)
    assert host.desk.axes_mm == pytest.approx((12.0 - 1.0 - 8.0 + 2.0, 10.0 - 1.0 - 2.0, 9.0), abs=2e-3)


def test_two_blocks_in_flight_stutter():
    """Each block must be able to stop at the end of the next: too little ahead costs speed."""
    host = homed("gnea")
    start_s = host.time_s
    host.ask(b"G91\n")
    for _ in range(30):
        host.ask(b"G1X-0.05F600\n", 0.0)
        while int(host.report()["Bf"].split(",")[0]) <= 13:
            pass
    host.wait_for_state("Idle")
    _, speed = speeds(host, start_s)
    assert speed.max() < 9.0


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_queue_is_bounded_and_ok_means_planned(dialect):
    host = homed(dialect)
    host.ask(b"G91\n")
    blocks = BLOCKS[dialect]
    first = len(host.lines)
    for _ in range(blocks + 4):
        host.board.receive(b"G1X-.5F6\n")
    host.run(1.0 if dialect == "gnea" else 1.5)
    assert [line for _, line in host.lines[first:]] == ["ok"] * blocks
    assert host.report()["Bf"].startswith("0,")
    assert host.desk.axes_mm[0] > 10.7, "hardly begun"


@pytest.mark.parametrize(("dialect", "arrive"), [("gnea", False), ("grblhal", True)])
def test_what_does_not_fit_into_the_receive_buffer_is_lost(dialect, arrive):
    host = homed(dialect)
    if dialect == "gnea":
        host.ask(b"G91G1X-2F60\n" * BLOCKS[dialect], 0.3)
    first = len(host.lines)
    lines = [b"G1X-0.001F600\n"] * 61
    for line in lines:
        host.board.receive(line)
    host.run(60.0 if dialect == "gnea" else 3.0)
    answers = [line for _, line in host.lines[first:]]
    assert (len(answers) >= 61) is arrive


@pytest.mark.parametrize("dialect", DIALECTS)
def test_counting_characters_loses_nothing(dialect):
    host = homed(dialect)
    host.ask(b"G91\n")
    first = len(host.lines)
    stream(host, [b"G1X-0.02F600\n"] * 61, {"gnea": 128, "grblhal": 1023}[dialect])
    host.wait_for_state("Idle")
    assert [line for _, line in host.lines[first:] if line == "ok"] == ["ok"] * 61
    assert host.desk.axes_mm[0] == pytest.approx(11.0 - 61 * 0.02, abs=1e-6)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_hold_stays_on_the_path_and_a_reset_at_standstill_keeps_the_position(dialect):
    host = homed(dialect)
    start = np.array(host.desk.axes_mm)
    host.ask(b"G91G1X-8Y-4Z-2F600\n", 0.5)
    asked_s = host.time_s
    host.ask(b"!", 0.02)
    assert host.state() == "Hold:1"
    host.wait_for_state("Hold:0", 1.0)
    assert 0.06 < host.time_s - asked_s < 0.25
    away = np.array(host.desk.axes_mm) - start
    direction = np.array([-8.0, -4.0, -2.0]) / math.sqrt(84.0)
    assert np.linalg.norm(away - direction * (away @ direction)) < 0.002
    at = host.position_mm()
    lines = host.ask(b"\x18", 0.3)
    assert not any("ALARM" in line or "unlock" in line for line in lines)
    assert (host.state(), host.position_mm()) == ("Idle", at)
    host.ask(b"G90G53G0X-1Y-1Z-1\n")
    host.wait_for_state("Idle")
    assert host.desk.axes_mm == pytest.approx(tuple(start), abs=1e-6), "no step was lost"


@pytest.mark.parametrize("dialect", DIALECTS)
def test_resume_goes_on_to_the_end(dialect):
    host = homed(dialect)
    host.ask(b"G91G1X-2F600\nG1Y-2\n", 0.15)
    host.ask(b"!")
    host.wait_for_state("Hold:0", 1.0)
    assert host.ask(b"G21\n", 0.2) == [], "lines wait while held"
    assert "ok" in host.ask(b"~", 0.05)
    host.wait_for_state("Idle")
    assert host.desk.axes_mm == pytest.approx((9.0, 7.0, 9.0), abs=1e-6)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_hold_over_several_short_blocks(dialect):
    host = homed(dialect)
    host.ask(b"G91\n")
    host.ask(b"G1X-0.02F600\n" * 12, 0.07)
    host.ask(b"!")
    host.wait_for_state("Hold:0", 1.0)
    host.ask(b"~")
    host.wait_for_state("Idle")
    assert host.desk.axes_mm[0] == pytest.approx(11.0 - 0.24, abs=1e-6)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_reset_in_motion_stops_dead_loses_the_position_and_throws_input_away(dialect):
    host = homed(dialect)
    host.ask(b"G91G1X-8F600\n", 0.4)
    at = host.desk.axes_mm[0]
    lines = host.ask(b"\x18G4P0\n", 1.0)
    assert lines[0] == "ALARM:3"
    assert lines[-1] == "[MSG:'$H'|'$X' to unlock]"
    assert "ok" not in lines
    assert at - host.desk.axes_mm[0] < 0.02
    assert host.state() == "Alarm"
    assert host.ask(b"G1X1F10\n") == ["error:9"]
    assert host.ask(b"$H\n", 10.0)[-1] == "ok"
    assert host.position_mm() == (-1.0, -1.0, -1.0)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_jog_can_be_cancelled_without_an_alarm(dialect):
    host = homed(dialect)
    host.ask(b"$J=G91X-8F600\n", 0.3)
    assert host.state() == "Jog"
    assert host.ask(b"G1X1F10\n") == ["error:9"]
    host.ask(b"\x85", 0.25)
    assert host.state() == "Idle"
    assert -5.5 < host.position_mm()[0] < -3.5


def test_a_jog_that_waits_for_room_survives_the_cancel_on_1_1h_only():
    """The chord: the planner is full of jogs, one more waits, and runs straight to its old target."""
    for dialect, lines in (("gnea", 17), ("grblhal", 125)):
        host = homed(dialect)
        stream(host, [b"$J=G91X-.5F600\n"] * (lines - 1), 120)
        host.board.receive(b"$J=G53G90X-20Y-20F600\n")
        host.run(0.01)
        assert host.report()["Bf"].startswith("0,")
        host.ask(b"\x85", 0.5)
        host.wait_for_state("Idle")
        chord = host.position_mm()[:2] == (-20.0, -20.0)
        assert chord is (dialect == "gnea")


@pytest.mark.parametrize("dialect", DIALECTS)
def test_feed_override_acts_on_what_is_queued(dialect):
    host = homed(dialect)
    start_s = host.time_s
    host.ask(b"G91G1X-10F600\n", 0.3)
    for _ in range(5):
        host.ask(b"\x92", 0.01)
    host.run(0.2)
    assert host.report()["FS"] == "300,0"
    host.ask(b"\x90", 0.2)
    assert host.report()["FS"] == "600,0"
    host.wait_for_state("Idle")
    _, speed = speeds(host, start_s)
    assert np.abs(np.diff(speed)).max() / 0.01 < 1.3 * ACCELERATION
    assert host.position_mm()[0] == -11.0


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_same_in_steps_of_any_length(dialect):
    def tell(step_s: float) -> list[str]:
        host = Host(dialect, FAST)
        host.run_until(0.1, step_s)
        for data in (b"$X\n$H\n", b"G91G1X-3Y-1F600\nX-1\nG38.3Z-30F300\n", b"?", b"!", b"?", b"~", b"\x18"):
            host.board.receive(data)
            host.run_until(round(host.time_s + (6.0 if b"$H" in data else 0.3), 9), step_s)
        return [line for _, line in host.lines]

    fine = tell(0.0005)
    assert len(fine) > 10
    assert tell(0.002) == fine
    assert tell(0.1) == fine


def test_an_idle_board_is_cheap(mocker):
    host = unlocked("gnea")
    steps = mocker.spy(host.board, "_step")
    host.run_until(host.time_s + 180.0, 1.0)
    assert steps.call_count == 0


@pytest.mark.parametrize(
    ("dialect", "stop", "state", "measured_s"),
    [
        ("gnea", b"!", "Hold:0", 0.097),
        ("grblhal", b"!", "Hold:0", 0.111),
        ("gnea", b"\x85", "Idle", 0.128),
        ("grblhal", b"\x85", "Idle", 0.050),
    ],
)
def test_stopping_takes_as_long_as_on_the_real_firmware(dialect, stop, state, measured_s):
    """Measured at F600 and 500 mm/s2."""
    host = homed(dialect)
    host.ask(b"$J=G91X-8F600\n" if state == "Idle" else b"G91G1X-8F600\n", 0.3)
    begin_s = host.time_s
    host.ask(stop, 0.0)
    host.wait_for_state(state, 1.0)
    assert host.time_s - begin_s == pytest.approx(measured_s, abs=0.025)


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("seed", range(3))
def test_no_step_is_lost_whatever_interrupts_a_stream(dialect, seed):
    random = np.random.default_rng(seed)
    host = homed(dialect)
    start_s, start = host.time_s, np.array(host.desk.axes_mm)
    moves = np.round(random.uniform(-0.4, 0.2, (60, 3)), 3)
    host.ask(b"G91\n")
    for first in range(0, 60, 3):
        host.run(random.uniform(0.1, 0.5))
        for x, y, z in moves[first : first + 3]:
            host.board.receive(f"G1X{x:.3f}Y{y:.3f}Z{z:.3f}F{random.integers(300, 1200)}\n".encode())
        if random.random() < 0.3:
            host.ask(bytes([random.choice([0x90, 0x91, 0x92, 0x95, 0x97])]), 0.01)
        if random.random() < 0.1:
            host.ask(b"!", random.uniform(0.0, 0.2))
            host.wait_for_state("Hold:0", 1.0)
            host.ask(b"~", 0.01)
    host.wait_for_state("Idle")
    np.testing.assert_allclose(np.array(host.desk.axes_mm) - start, moves.sum(axis=0), atol=1e-6)
    _, speed = speeds(host, start_s)
    assert np.abs(np.diff(speed)).max() / 0.01 < 2.5 * ACCELERATION, "the longest axis alone may use its acceleration"


@pytest.mark.parametrize("seed", range(20))
def test_no_bytes_break_the_board(seed):
    random = np.random.default_rng(seed)
    host = Host(DIALECTS[seed % 2], FAST)
    pieces = [
        *("G0", "G1", "G2", "G4", "G10", "G28", "G30", "G38.2", "G43.1", "G53", "G59.1", "G80", "G91", "G92", "G93"),
        *("M0", "M2", "M3", "M5", "P1", "L20", "S100", "F600", "X1", "Y-2", "Z-3", "X-.1", "(", "%", ";"),
        *("$X", "$H", "$$", "$#", "$J=", "$100=0", "$110=0", "$120=0", "$27=0", "$21=1", "$20=1", "$24=0", "$RST=*"),
        *("$C", "$SLP"),
        *("G" + "9" * 60, "X" + "9" * 60, "P" + "9" * 60, "\n", "\n", "\n"),
    ]  # fmt: skip
    for _ in range(60):
        text = "".join(random.choice(pieces, random.integers(1, 5)))
        host.board.receive(text.encode() + b"\n" * int(random.integers(0, 2)))
        host.board.receive(bytes([random.choice([0x18, 0x84, 0x85, 0x21, 0x7E, 0x3F, 0x91, 0x97, 0x9E, 0xFF])]))
        host.run_until(host.time_s + random.choice([0.001, 0.02, 0.3]), 0.01)
    host.ask(b"\x18", 2.0)
    host.ask(b"\x18", 2.0)
    assert host.state()
