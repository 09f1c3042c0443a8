"""The CiA 402 driver on a wire that is silent, late, broken or gone."""

import can
import pytest
from cia402_script import BEAT, RUNNING, HandClock, ScriptedBus, started

from drivers.errors import ConnectionLostError, DeviceTimeoutError
from drivers.spindle.interface import SILENT_AFTER


def test_a_silent_drive_is_told_within_a_fifth_of_a_second_and_the_host_beats_meanwhile() -> None:
    spindle, bus, clock = started()
    bus.play("", always=f"080\n{BEAT}")
    before_s, before = clock.time_s, len(bus.sent)
    with pytest.raises(DeviceTimeoutError, match=r"silent, no answer to SYNC within 0\.2 s"):
        spindle.status()
    assert clock.time_s - before_s == pytest.approx(SILENT_AFTER * spindle.heartbeat_s)
    assert bus.sent[before:].count(BEAT) >= 2


def kept_from_running(bus: ScriptedBus, clock: HandClock, *arrivals: str) -> None:
    """In the middle of the next wait the host loses half a second, in which this arrives."""
    recv = bus.recv

    def late(timeout: float | None = None) -> can.Message | None:
        if timeout and not bus.arrived:
            bus.recv = recv  # type: ignore[method-assign]
            clock.sleep_s(0.5)
            for text in arrivals:
                bus.arrive(text)
        return recv(timeout)

    bus.recv = late  # type: ignore[method-assign]


def test_a_late_host_reads_what_has_arrived_before_it_calls_the_drive_silent() -> None:
    spindle, bus, clock = started()
    bus.play("080", always=BEAT)  # one SYNC, and no other
    kept_from_running(bus, clock, "701 05", "701 05", RUNNING.partition(" > ")[2])
    assert spindle.status().speed_rpm == 30_000.0


def test_a_late_host_asks_once_more_before_it_calls_the_drive_silent() -> None:
    spindle, bus, clock = started()
    bus.play(f"080\n{RUNNING}", always=BEAT)
    kept_from_running(bus, clock)
    assert spindle.status().speed_rpm == 30_000.0
    bus.play("080\n080", always=BEAT)  # once, and not for ever
    kept_from_running(bus, clock)
    before_s = clock.time_s
    with pytest.raises(DeviceTimeoutError, match="silent"):
        spindle.status()
    assert clock.time_s - before_s < 0.55


def test_one_lost_sync_is_forgiven() -> None:
    spindle, bus, _ = started()
    bus.play(f"080\n{RUNNING}", always=BEAT)
    assert spindle.status().speed_rpm == 30_000.0


def test_a_lone_bus_error_is_forgiven_and_a_run_of_them_is_a_lost_wire() -> None:
    spindle, bus, _ = started()
    for _ in range(20):
        bus.arrived.append(can.CanOperationError("the adapter refused a frame (BEL)"))
        for _ in range(2):
            bus.arrive("701 05")
        assert spindle.status().fault is None
    bus.arrived.extend(can.CanOperationError("the adapter refused a frame (BEL)") for _ in range(5))
    with pytest.raises(ConnectionLostError, match="too many bus errors, the last one: the adapter refused"):
        spindle.status()
    with pytest.raises(ConnectionLostError, match="too many bus errors"):  # and it stays lost
        spindle.status()
    before = len(bus.sent)
    spindle.stop()  # goes out all the same
    assert bus.sent[before:] == ["201 02 00 00 00 00 00"]
    spindle.close()


@pytest.mark.parametrize("text", ["181 27 06 30 75", "701 05 05", "081 21 71", "581 60"])
def test_frames_of_a_wrong_length_are_bus_errors(text: str) -> None:
    spindle, bus, _ = started()
    for _ in range(5):
        bus.arrive(text)
    with pytest.raises(ConnectionLostError, match=f"frame {text[:3]}h with . bytes"):
        spindle.status()


def test_bus_off() -> None:
    spindle, bus, _ = started()
    bus.arrived.append(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
    with pytest.raises(ConnectionLostError, match="bus-off"):
        spindle.status()


def test_a_frame_that_does_not_get_out() -> None:
    spindle, bus, _ = started()

    def refuse(msg: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("Network is down")

    bus.send = refuse  # type: ignore[method-assign]
    with pytest.raises(ConnectionLostError, match=r"cannot send \(Network is down\)"):
        spindle.stop()
