"""Locks, limits, alarms, probing, the spindle, and what a reset keeps."""

import pytest
from grbl_bench import FAST, Desk, Host, homed, unlocked

from drivers.errors import ConfigError

DIALECTS = ["gnea", "grblhal"]
UNLOCK = "[MSG:'$H'|'$X' to unlock]"


@pytest.mark.parametrize("dialect", DIALECTS)
def test_with_homing_enabled_the_board_is_locked_at_power_up_and_only_then(dialect):
    host = Host(dialect, FAST)
    host.run(0.1)
    assert [line for _, line in host.lines if line][-1] == UNLOCK
    assert host.state() == "Alarm"
    assert host.ask(b"G1X1F10\n") == ["error:9"]
    assert host.ask(b"$X\n") == ["[MSG:Caution: Unlocked]", "ok"]
    lines = host.ask(b"\x18", 0.1)
    assert len(lines) == 1
    assert "help" in lines[0]
    assert host.state() == "Idle"


@pytest.mark.parametrize("dialect", DIALECTS)
def test_homing_finds_the_switches_and_needs_a_board_at_rest(dialect):
    host = homed(dialect)
    assert host.position_mm() == (-1.0, -1.0, -1.0)
    assert host.desk.axes_mm == pytest.approx((11.0, 9.0, 9.0), abs=0.002)
    host.ask(b"G91G1X-5F600\n", 0.2)
    assert host.ask(b"$H\n") == ["error:8"]
    assert host.ask(b"$$\n") == ["error:8"]
    assert host.ask(b"$10=2\n") == ["error:8"]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_homing_towards_a_missing_switch_fails(dialect):
    host = Host(dialect, FAST, Desk(switches_mm=(12.0, 10.0, 1000.0)))
    host.run(0.1)
    assert host.ask(b"$H\n", 10.0)[:1] != ["ok"]
    assert "ALARM:9" in [line for _, line in host.lines]
    host.ask(b"\x18", 1.0)
    assert host.state() == "Alarm"


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_reset_while_homing(dialect):
    host = Host(dialect, FAST)
    host.run(0.1)
    host.ask(b"$H\n", 0.3)
    lines = host.ask(b"\x18", 1.0)
    assert "ALARM:6" in lines
    assert lines[-1] == UNLOCK
    assert not host.board._program.stepper.running


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_move_beyond_a_soft_limit_stops_softly_and_waits_for_a_reset(dialect):
    host = homed(dialect)
    assert host.ask(b"$20=1\n") == ["ok"]
    host.ask(b"G90G53G1X-10F600\n", 0.3)
    lines = host.ask(b"G53G1X1F600\n", 0.5)
    assert lines[0] == "ALARM:2"
    host.run(1.0)
    assert "[MSG:Reset to continue]" in [line for _, line in host.lines]
    at = host.desk.axes_mm
    assert -9.9 < at[0] - 12.0 < -3.0
    lines = host.ask(b"\x18", 0.2)
    assert lines[0] == "ok"
    assert lines[-1] == UNLOCK
    host.ask(b"$X\n")
    assert host.position_mm()[0] == pytest.approx(at[0] - 12.0, abs=0.001), "the position is kept"


def test_a_reset_in_the_first_half_second_of_a_soft_limit_alarm_is_lost_on_1_1h():
    host = homed("gnea")
    host.ask(b"$20=1\n")
    assert host.ask(b"G53G1X1F600\n", 0.1) == ["ALARM:2"]
    assert host.ask(b"\x18", 1.5) == ["[MSG:Reset to continue]"]
    assert host.ask(b"?", 0.5) == []
    assert host.ask(b"\x18", 0.2)[-1] == UNLOCK


def test_jogs_beyond_a_soft_limit_are_refused_by_1_1h_and_shortened_by_grblhal():
    host = homed("gnea")
    host.ask(b"$20=1\n")
    assert host.ask(b"$J=G91X5F600\n") == ["error:15"]
    assert host.state() == "Idle"
    host = homed("grblhal")
    host.ask(b"$20=1\n")
    assert host.ask(b"$J=G91X5F600\n") == ["ok"]
    host.wait_for_state("Idle")
    assert host.position_mm() == (0.0, -1.0, -1.0)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_hard_limit_kills_motion_and_waits_for_a_reset(dialect):
    host = homed(dialect)
    host.ask(b"$21=1\n")
    lines = host.ask(b"G91G1X5F600\n", 2.0)
    assert lines == ["ok", "ALARM:1", "[MSG:Reset to continue]"]
    assert host.desk.axes_mm[0] == pytest.approx(12.0, abs=0.03)
    assert host.ask(b"\x18", 0.3)[-1] == UNLOCK
    report = host.report()
    assert (report["state"], report["Pn"]) == ("Alarm", "X")


@pytest.mark.parametrize("dialect", DIALECTS)
def test_probing(dialect):
    host = homed(dialect)
    lines = host.ask(b"G91G38.2Z-35F300\n", 7.0)
    assert lines == ["[PRB:-1.000,-1.000,-30.000:1]", "ok"]
    host.wait_for_state("Idle")
    assert host.position_mm()[2] == pytest.approx(-30.15, abs=0.15)
    assert host.report()["Pn"] == "P"
    assert host.ask(b"G38.2Z-1F300\n", 0.8)[0] == "ALARM:4"
    host.ask(b"\x18", 0.7)
    host.ask(b"$X\n")
    host.ask(b"G91G0Z5\n")
    host.wait_for_state("Idle")
    assert host.ask(b"G38.3Z-1F300\n", 1.0)[-1] == "ok", "a probe that may miss"
    lines = host.ask(b"G38.2Z-1F300\n", 1.5)
    assert lines[0] == "ALARM:5"
    assert lines[-1] == "ok"
    assert lines[1].endswith(":0]")


def test_grblhal_repeats_an_error_until_an_empty_line_or_a_dollar_line():
    host = unlocked("grblhal")
    assert host.ask(b"G1X1\n") == ["error:22"]
    assert host.ask(b"G21\n") == ["error:22"]
    assert host.ask(b"\n") == ["ok"]
    assert host.ask(b"G21\n") == ["ok"]
    assert host.ask(b"G1X1\nG21\n$X\nG21\n", 0.1) == ["error:22", "error:22", "ok", "ok"]
    assert unlocked("gnea").ask(b"G1X1\nG21\n", 0.1) == ["error:22", "ok"]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_spindle_waits_for_motion_and_stops_at_once_only_in_a_hold(dialect):
    host = homed(dialect)
    host.ask(b"M3S800\n")
    assert host.board.spindle_rpm == 800.0
    host.ask(b"G91G1X-3F600\nM5\n", 0.15)
    assert host.board.spindle_rpm == 800.0
    host.ask(b"!")
    host.wait_for_state("Hold:0", 1.0)
    host.ask(b"\x9e")
    assert host.board.spindle_rpm == 0.0
    host.ask(b"~")
    assert host.board.spindle_rpm == 800.0
    host.wait_for_state("Idle")
    host.run(0.05)
    assert host.board.spindle_rpm == 0.0
    host.ask(b"M4S5000\n")
    assert host.board.spindle_rpm == -1000.0, "$30 is the most"
    host.ask(b"\x18", 0.1)
    assert host.board.spindle_rpm == 0.0


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_door_stops_motion_and_a_cycle_start_goes_on(dialect):
    host = homed(dialect)
    host.ask(b"G91G1X-3F600\n", 0.15)
    assert host.ask(b"\x84") == ["[MSG:Check Door]"]
    host.run(0.3)
    assert host.state() == "Door:0"
    host.ask(b"~")
    host.wait_for_state("Idle")
    assert host.position_mm()[0] == -4.0


@pytest.mark.parametrize("dialect", DIALECTS)
def test_work_offsets_survive_a_reset_but_g92_does_not(dialect):
    host = homed(dialect)
    host.ask(b"G10L20P1X0Y0Z0\nG92X5\n", 0.1)
    assert "[G54:-1.000,-1.000,-1.000]" in host.ask(b"$#\n", 0.2)
    assert "[G92:-5.000,0.000,0.000]" in host.ask(b"$#\n", 0.2)
    host.ask(b"\x18", 0.1)
    lines = host.ask(b"$#\n", 0.2)
    assert "[G54:-1.000,-1.000,-1.000]" in lines
    assert "[G92:0.000,0.000,0.000]" in lines
    host.ask(b"G90G0X-1Y-1Z-1\n")
    host.wait_for_state("Idle")
    assert host.position_mm() == (-2.0, -2.0, -2.0)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_settings_survive_a_reset_and_are_read_back(dialect):
    host = unlocked(dialect)
    host.ask(b"$132=12.5\n$120=333\n", 0.1)
    host.ask(b"\x18", 0.1)
    lines = host.ask(b"$$\n", 0.5)
    assert "$132=12.500" in lines
    assert "$120=333.000" in lines
    assert lines[-1] == "ok"


def test_masks_of_the_status_report():
    host = unlocked("grblhal", {"$10": 3})
    assert set(host.report()) == {"state", "MPos", "Bf", "TLR"}
    host = unlocked("gnea", {"$10": 0})
    assert set(host.report()) == {"state", "WPos", "FS"}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_check_mode_reads_lines_and_moves_nothing(dialect):
    host = unlocked(dialect)
    assert host.ask(b"$C\n") == ["[MSG:Enabled]", "ok"]
    assert host.ask(b"G1X5F100\n") == ["ok"]
    assert host.state() == "Check"
    lines = host.ask(b"$C\n", 0.2)
    assert lines[:2] == ["[MSG:Disabled]", "ok"]
    assert host.desk.axes_mm == (0.0, 0.0, 0.0)


def test_startup_lines_run_after_a_reset():
    host = unlocked("gnea")
    assert host.ask(b"$N0=G91\n") == ["ok"]
    assert host.ask(b"$N\n") == ["$N0=G91", "$N1=", "ok"]
    assert host.ask(b"\x18", 0.1)[-1] == ">G91:ok"


def test_an_unknown_setting_is_refused_when_the_board_is_built():
    with pytest.raises(ConfigError, match=r"\$77"):
        Host("gnea", {"$77": 1.0})
