import can
import numpy as np
import pytest
from fake_load import FakeLoad

from drivers.errors import ConnectionLostError, DeviceTimeoutError
from firmware_sim.cia402_drive import Cia402Drive
from firmware_sim.clock import SimClock
from firmware_sim.lines import InProcessBus, InProcessLine, in_process_sources
from firmware_sim.microscope import Shot


class SlowEcho:
    """Sends back what it hears, 10 ms later."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.waiting: list[tuple[float, bytes]] = []

    def receive(self, data: bytes) -> None:
        self.waiting.append((self.now_s + 0.010, data))

    def transmit(self) -> bytes:
        ready = b"".join(data for due_s, data in self.waiting if due_s <= self.now_s)
        self.waiting = [entry for entry in self.waiting if entry[0] > self.now_s]
        return ready

    def advance_to(self, time_s: float) -> None:
        self.now_s = time_s


def echo_line() -> tuple[SimClock, InProcessLine]:
    clock, board = SimClock(), SlowEcho()
    clock.attach(board.advance_to)
    return clock, InProcessLine(board, clock)


def test_reading_lets_time_pass_until_the_first_byte():
    clock, line = echo_line()
    line.write(b"hello")
    assert line.read(1.0) == b"hello"
    assert clock.now_s() == pytest.approx(0.010, abs=0.0011)


def test_reading_in_vain_takes_exactly_its_timeout():
    clock, line = echo_line()
    assert line.read(0.0305) == b""
    assert clock.now_s() == pytest.approx(0.0305)


def test_reading_without_a_timeout_takes_no_time():
    clock, line = echo_line()
    line.write(b"x")
    assert line.read(0.0) == b""
    assert clock.now_s() == 0.0


def test_a_closed_line_says_so():
    _, line = echo_line()
    line.close()
    line.close()
    for use in (lambda: line.read(0.0), lambda: line.write(b"x")):
        with pytest.raises(ConnectionLostError, match="in-process:motion"):
            use()


@pytest.fixture
def clock_and_bus():
    clock = SimClock()
    with InProcessBus(Cia402Drive(FakeLoad()), clock) as bus:
        yield clock, bus


def request(index: int) -> can.Message:
    data = b"\x40" + index.to_bytes(2, "little") + bytes(5)
    return can.Message(arbitration_id=0x601, data=data, is_extended_id=False)


def test_the_bus_waits_in_virtual_time_and_stamps_arrivals(clock_and_bus):
    clock, bus = clock_and_bus
    boot = bus.recv(timeout=1.0)
    assert (boot.arbitration_id, bytes(boot.data)) == (0x701, b"\x00")
    assert 0.05 < clock.now_s() < 0.1
    assert boot.timestamp <= clock.now_s()
    sent_at_s = clock.now_s()
    bus.send(request(0x1000))
    assert bus.recv(timeout=0) is None
    assert clock.now_s() == sent_at_s
    reply = bus.recv(timeout=0.1)
    assert reply.arbitration_id == 0x581
    # Two frames of eight bytes at 1 Mbit/s.
    assert 0.0002 < reply.timestamp - sent_at_s < 0.0004


def test_the_bus_filters_and_times_out(clock_and_bus):
    clock, bus = clock_and_bus
    clock.sleep_s(0.2)
    bus.set_filters([{"can_id": 0x581, "can_mask": 0x7FF}])
    assert bus.recv(timeout=0.5) is None
    assert clock.now_s() == pytest.approx(0.7)
    bus.send(request(0x1000))
    assert bus.recv(timeout=0.5).arbitration_id == 0x581


def test_the_bus_refuses_frames_that_nobody_carries(clock_and_bus):
    _, bus = clock_and_bus
    with pytest.raises(can.CanOperationError):
        bus.send(can.Message(arbitration_id=0x601, is_extended_id=True))
    with pytest.raises(can.CanOperationError):
        bus.send(can.Message(arbitration_id=0x601, is_remote_frame=True, is_extended_id=False))


class TinyRenderer:
    """Pictures whose pixels tell the frame's time in ms, and how often it was asked."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def shoot(self, time_s: float):
        self.times.append(time_s)
        picture = np.full((4, 6, 3), round(time_s * 1000) % 256, np.uint8)
        return Shot(picture, picture + 1)


def test_both_eyes_share_one_rendering_of_an_instant():
    clock, renderer = SimClock(), TinyRenderer()
    left, right = in_process_sources(renderer.shoot, clock, fps=50.0, latency_s=0.01)
    left_image, left_at_s = left.newest()
    right_image, right_at_s = right.newest()
    assert left_at_s == right_at_s == 0.0
    assert (right_image == left_image + 1).all()
    assert renderer.times == [0.0]
    assert clock.now_s() == pytest.approx(0.01)


def test_a_newer_picture_costs_the_wait_for_the_shutter_and_the_latency():
    clock, renderer = SimClock(start_s=0.105), TinyRenderer()
    left, right = in_process_sources(renderer.shoot, clock, fps=50.0, latency_s=0.01)
    _, exposed_at_s = left.wait_newer(clock.now_s(), 1.0)
    assert exposed_at_s == pytest.approx(0.12)
    assert clock.now_s() == pytest.approx(0.13)
    assert right.wait_newer(0.105, 1.0)[1] == exposed_at_s
    assert len(renderer.times) == 1


def test_the_newest_picture_is_never_older_than_a_period_and_the_latency():
    clock, renderer = SimClock(), TinyRenderer()
    left, _ = in_process_sources(renderer.shoot, clock, fps=50.0, latency_s=0.01)
    for _ in range(50):
        _, exposed_at_s = left.newest()
        assert clock.now_s() - exposed_at_s <= 0.03 + 1e-9
        clock.sleep_s(0.007)


def test_a_picture_that_comes_too_late_is_a_timeout():
    clock, renderer = SimClock(), TinyRenderer()
    left, _ = in_process_sources(renderer.shoot, clock, fps=10.0, latency_s=0.01)
    with pytest.raises(DeviceTimeoutError, match="in-process-left"):
        left.wait_newer(0.0, 0.05)
    assert clock.now_s() == pytest.approx(0.05)
    left.close()
    with pytest.raises(ConnectionLostError):
        left.newest()
