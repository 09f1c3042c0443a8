"""The driver's frames against tables typed from CiA 301 and CiA 402."""

import itertools
import threading

import can
import pytest
from cia402_script import BEAT, OPENING, STANDING, STARTING, WATCH, HandClock, ScriptedBus, opened, started

from drivers.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.spindle import emergency
from drivers.spindle.cia402 import Cia402Spindle

UNWATCH = """
601 23 16 10 01 00 00 00 00 > 581 60 16 10 01 00 00 00 00
601 40 16 10 01 00 00 00 00 > 581 43 16 10 01 00 00 00 00
"""


def changed(row: str, by: str) -> str:
    assert row in OPENING
    return OPENING.replace(row, by)


def test_opening_and_what_it_learns() -> None:
    spindle, _, _ = opened()
    assert spindle.identity == "Generic 1, vendor id 0xfb, product code 0x60510000, serial number 0x3039"
    assert spindle.heartbeat_s == 0.25


REFUSALS: list[tuple[str, str, type[Exception], str]] = [
    ("43 00 10 00 92 01 02 00          # dev", "43 00 10 00 91 01 02 00 #", DeviceFaultError, "no CiA 402 drive"),
    ("43 02 65 00 04 00 00 00", "43 02 65 00 FB 00 00 00", DeviceFaultError, "no profile velocity mode"),
    ("43 02 65 00 04 00 00 00", "80 02 65 00 00 00 02 06", DeviceFaultError, r"has no supported drive modes \(6502h"),
    ("43 A9 60 00 00 47 B4 00", "43 A9 60 00 00 03 B4 00", DeviceFaultError, "0x00b40300, allowed 0x00b44700"),
    ("43 83 60 00 A0 86 01 00", "43 83 60 00 9F 86 01 00", DeviceFaultError, "0x186a0 but reads back 0x1869f"),
    ("60 07 60 00 00 00 00 00", "80 07 60 00 30 00 09 06", DeviceFaultError, "refuses abort connection option"),
    ("43 16 10 01 FA 00 7F 00", "43 16 10 01 00 00 7F 00", DeviceFaultError, "consumer heartbeat time .* reads back"),
    ("4B 17 10 00 7D 00 00 00", "43 17 10 00 7D", DeviceTimeoutError, "no SDO answer for producer heartbeat"),
    ("4B 17 10 00 7D 00 00 00", "60 17 10 00 00 00 00 00", ProtocolError, "wrong SDO answer"),
    ("4B 17 10 00 7D 00 00 00", "4F 17 10 00 7D 00 00 00", ProtocolError, "came as 1 bytes"),
]


@pytest.mark.parametrize(("row", "by", "error", "words"), REFUSALS)
def test_a_drive_that_is_not_right_is_refused_by_object(row: str, by: str, error: type[Exception], words: str) -> None:
    rows = OPENING[: OPENING.index(row)] + by
    # What is not answered is asked again, with the same answer.
    always = "601 80 00 00 00 00 00 04 05\n601 40 17 10 00 00 00 00 00 > 581 43 17 10 00 7D"
    bus = ScriptedBus(HandClock(), rows, always=always)
    with pytest.raises(error, match=words):
        Cia402Spindle(bus, bus.clock, node_id=1, max_speed_rpm=60_000)
    assert not bus.rows
    assert bus._is_shutdown


def test_a_late_answer_to_another_request_is_not_taken() -> None:
    clock = HandClock()
    late = "581 43 00 10 00 92 01 02 00 | "
    bus = ScriptedBus(clock, changed("581 41 08 10 00 09", late + "581 41 08 10 00 09"))
    assert Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=60_000).identity.startswith("Generic 1,")


def test_the_second_answer_to_a_write_that_was_asked_twice_is_none_to_the_reading_back() -> None:
    clock = HandClock()
    bus = ScriptedBus(
        clock, changed("43 83 60 00 A0 86 01 00", "60 83 60 00 00 00 00 00 | 581 43 83 60 00 A0 86 01 00")
    )
    assert Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=60_000).identity.startswith("Generic 1,")


def test_a_silent_drive_at_start_up() -> None:
    clock = HandClock()
    bus = ScriptedBus(clock, "000 80 01", always="601 40 00 10 00 00 00 00 00")
    with pytest.raises(
        DeviceTimeoutError, match=r"node 1 on script: no frame at all within 3 s; check that the drive has"
    ):
        Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=60_000)
    assert clock.time_s < 53.5


def test_a_drive_that_beats_but_answers_nothing() -> None:
    clock = HandClock()
    bus = ScriptedBus(clock, "000 80 01", always="601 40 00 10 00 00 00 00 00 > 701 7F")
    with pytest.raises(DeviceTimeoutError, match=r"frames \(NMT state 127\) but no SDO answer"):
        Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=60_000)


def test_a_drive_that_is_still_booting_is_waited_for() -> None:
    clock = HandClock()
    poke = "601 40 00 10 00 00 00 00 00"
    first, _, rest = OPENING.partition(poke)
    bus = ScriptedBus(clock, f"{first}{poke}\n{poke} > 701 00\n{poke}{rest}")
    Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=60_000)
    assert clock.time_s >= 50.2


def test_a_drill_found_turning_is_brought_to_standstill() -> None:
    clock = HandClock()
    turning = "080 > 181 07 02 10 27 00 00 00 00\n" * 2  # quick stop active, 10000 rpm
    bus = ScriptedBus(clock, changed("080 > 181", turning + "080 > 181"))
    Cia402Spindle(bus, clock, node_id=1, max_speed_rpm=60_000)


def test_starting() -> None:
    spindle, _, _ = started()
    status = spindle.wait_until_at_speed(1.0)
    assert (status.speed_rpm, status.torque_fraction, status.fault) == (30_000.0, 0.1, None)


def test_changing_the_speed_of_a_turning_drill() -> None:
    spindle, bus, _ = started()
    turning = "080 > 181 27 02 30 75 00 00 00 00\n"
    bus.play("000 01 01\n" + turning + WATCH + turning + "201 0F 00 20 4E 00 00", always=BEAT)
    spindle.start(20_000)
    assert not bus.rows


@pytest.mark.parametrize("speed_rpm", [0.0, 0.5, -1000.0, 50_001.0, float("nan"), float("inf")])
def test_a_speed_outside_the_limits_sends_nothing(speed_rpm: float) -> None:
    spindle, bus, _ = opened()
    before = len(bus.sent)
    with pytest.raises(ValueError, match="allowed 1 to 50000 rpm"):
        spindle.start(speed_rpm)
    assert len(bus.sent) == before


def test_the_greatest_speed_is_allowed() -> None:
    spindle, bus, _ = opened()
    bus.play(STARTING.replace("30 75 00 00", "50 C3 00 00"), always=BEAT)
    spindle.start(50_000)


def test_stopping_is_one_frame_in_any_state() -> None:
    spindle, bus, _ = started()
    for _ in range(3):
        before = len(bus.sent)
        spindle.stop()
        assert bus.sent[before:] == ["201 02 00 00 00 00 00"]


def test_standstill_ends_the_watch() -> None:
    spindle, bus, clock = started()
    spindle.stop()
    bus.play("080 > 181 07 02 10 27 00 00 00 00\n" + STANDING + UNWATCH, always=BEAT)
    assert spindle.wait_until_at_speed(1.0).speed_rpm == 0.0
    clock.sleep_s(10.0)
    bus.play(STANDING)  # and no beat
    assert spindle.status().fault is None


def test_a_lost_stop_frame_is_sent_again() -> None:
    spindle, bus, _ = started()
    spindle.stop()
    before = len(bus.sent)
    spindle.status()
    assert bus.sent[before:].count("201 02 00 00 00 00 00") == 1


def test_a_drive_that_holds_after_its_quick_stop_is_switched_off() -> None:
    spindle, bus, _ = started()
    spindle.stop()
    bus.play("080 > 181 17 02 00 00 00 00 00 00\n201 00 00 00 00 00 00" + UNWATCH, always=BEAT)
    spindle.wait_until_at_speed(1.0)


def test_the_host_beats_in_time_and_only_when_the_loop_turns() -> None:
    spindle, bus, clock = started()
    beats_s: list[float] = []
    for _ in range(60):
        before = len(bus.sent)
        spindle.status()
        beats_s += [clock.time_s] * bus.sent[before:].count(BEAT)
        clock.sleep_s(0.01)
    gaps_s = [b - a for a, b in itertools.pairwise(beats_s)]
    assert max(gaps_s) < 0.055, "what does not beat for 0.195 s, a flush, must not end a beat too late"
    assert min(gaps_s) > 0.03
    before = len(bus.sent)
    clock.sleep_s(3.0)
    assert len(bus.sent) == before


def test_target_reached_alone_is_not_at_speed_nor_is_speed_alone() -> None:
    spindle, bus, _ = started()
    bus.play(
        "080 > 181 27 06 00 00 00 00 00 00\n"  # target reached of the standstill before
        "080 > 181 27 02 30 75 00 00 00 00\n"  # passing through, still accelerating
        "080 > 181 27 06 DC 73 00 00 00 00",  # 29660 rpm
        always=BEAT,
    )
    assert spindle.wait_until_at_speed(1.0).speed_rpm == 29_660.0
    bus.play("", always=f"080 > 181 27 06 88 72 00 00 00 00\n{BEAT}")  # 29320 rpm
    with pytest.raises(DeviceTimeoutError, match=r"29320 rpm after 0\.5 s, commanded 30000 rpm"):
        spindle.wait_until_at_speed(0.5)


def test_a_drive_that_never_switches_on() -> None:
    spindle, bus, _ = opened()
    always = f"{BEAT}\n201 06 00 00 00 00 00\n{STANDING}\n201 02 00 00 00 00 00"
    bus.play("000 01 01\n" + STANDING + WATCH, always=always)
    with pytest.raises(DeviceFaultError, match="stays in state switch on disabled for 1 s; check the supply"):
        spindle.start(30_000)
    assert bus.sent[-1] == "201 02 00 00 00 00 00"


@pytest.mark.parametrize("report", range(1, STARTING.count("\n080") + 1))
def test_stop_from_another_thread_wins_over_start(report: int) -> None:
    """Whenever it comes, no enabling frame follows it."""
    spindle, bus, _ = opened()
    bus.play(STARTING, always=f"{BEAT}\n201 02 00 00 00 00 00")
    reports, stopped_at = 0, 0
    recv = bus.recv

    def stopping(timeout: float | None = None) -> can.Message | None:
        nonlocal reports, stopped_at
        message = recv(timeout)
        if message is not None and message.arbitration_id == 0x181:
            reports += 1
            if reports == report:
                stopped_at = len(bus.sent)
                thread = threading.Thread(target=spindle.stop)
                thread.start()
                thread.join(5)
        return message

    bus.recv = stopping  # type: ignore[method-assign]
    with pytest.raises(DeviceFaultError, match=r"stop\(\) came"):
        spindle.start(30_000)
    assert {sent for sent in bus.sent[stopped_at:] if sent.startswith("201")} == {"201 02 00 00 00 00 00"}


def test_a_fault_is_told_in_words_and_start_does_not_clear_it() -> None:
    spindle, bus, _ = started()
    bus.play("080 > 181 08 02 00 00 00 00 00 00", always=BEAT)
    bus.arrive("081 21 71 20 00 00 00 00 00")
    assert spindle.status().fault == "drive fault 0x7121 motor blocked"
    bus.play("000 01 01\n080 > 181 08 02 00 00 00 00 00 00", always=BEAT)
    before = len(bus.sent)
    with pytest.raises(DeviceFaultError, match="0x7121 motor blocked; remove the cause, then reset the fault"):
        spindle.start(30_000)
    assert not [sent for sent in bus.sent[before:] if sent.startswith("201")]


def test_resetting_a_fault_is_an_edge_and_enables_nothing() -> None:
    spindle, bus, _ = started()
    bus.play("000 01 01\n201 00 00 00 00 00 00\n201 80 00 00 00 00 00\n201 00 00 00 00 00 00\n" + STANDING, always=BEAT)
    spindle.reset_fault()
    assert not bus.rows


def test_a_fault_whose_cause_stays() -> None:
    spindle, bus, _ = opened()
    bus.play(
        "000 01 01\n201 00 00 00 00 00 00\n201 80 00 00 00 00 00\n201 00 00 00 00 00 00\n"
        "080 > 181 08 02 00 00 00 00 00 00\n601 40 3F 60 00 00 00 00 00 > 581 4B 3F 60 00 10 42 00 00"
    )
    with pytest.raises(DeviceFaultError, match="drive fault 0x4210 device temperature too high; remove"):
        spindle.reset_fault()


def test_a_drive_that_switches_itself_off() -> None:
    spindle, bus, _ = started()
    bus.play("", always=f"{STANDING}\n{BEAT}")
    assert spindle.status().fault == "the drive went to state switch on disabled by itself"
    with pytest.raises(DeviceFaultError, match="by itself"):
        spindle.wait_until_at_speed(1.0)


def test_a_drive_that_restarted_needs_opening() -> None:
    spindle, bus, _ = started()
    bus.arrive("701 00")
    assert spindle.status().fault == "the drive restarted and lost its settings; open the drill again"
    with pytest.raises(DeviceFaultError, match="open the drill again"):
        spindle.start(30_000)


def test_closing_stops_confirms_and_gives_the_bus_back() -> None:
    spindle, bus, _ = started()
    bus.play("201 02 00 00 00 00 00\n" + STANDING + UNWATCH + "000 80 01", always=BEAT)
    spindle.close()
    assert not bus.rows
    assert bus._is_shutdown
    spindle.close()


def test_closing_says_when_standstill_is_not_confirmed() -> None:
    spindle, bus, _ = started()
    bus.play("", always=f"201 02 00 00 00 00 00\n080\n{BEAT}")
    with pytest.raises(DeviceTimeoutError, match="silent"):
        spindle.close()
    assert bus._is_shutdown


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x8130, "0x8130 the host's heartbeat stayed away"),
        (0x3210, "0x3210 over-voltage of the DC link"),
        (0x2399, "0x2399 current"),
        (0xFF01, "0xFF01 additional function or maker's own error"),
        (0xA123, "0xA123 unknown error"),
    ],
)
def test_error_codes_in_words(code: int, words: str) -> None:
    assert emergency.words(code) == words


def test_an_error_reset_is_no_fault() -> None:
    spindle, bus, _ = started()
    bus.arrive("081 00 00 00 00 00 00 00 00")
    assert spindle.status().fault is None


@pytest.mark.parametrize("keys", [{"node_id": 0}, {"node_id": 127}, {"max_speed_rpm": 0.0}, {"heartbeat_s": 0.0}])
def test_nonsense_is_refused_before_anything_is_sent(keys: dict[str, float]) -> None:
    clock = HandClock()
    bus = ScriptedBus(clock)
    with pytest.raises(ValueError, match="allowed"):
        Cia402Spindle(bus, clock, **{"node_id": 1, "max_speed_rpm": 1000.0, **keys})  # type: ignore[arg-type]
    assert not bus.sent
