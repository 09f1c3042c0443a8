"""The emulated RC8 by itself, spoken to in bytes written by hand."""

import struct
from collections.abc import Iterator

import pytest

from firmware_sim.bcap_controller import POWER_UP_POSE, RcController
from firmware_sim.clock import SimClock

ROBOT, CONTROLLER = 0x0201, 0x0101


class Arm:
    def __init__(self) -> None:
        self.axes_mm = (0.0, 0.0, 0.0)
        self.pressed = False

    def move_to(self, time_s: float, axes_mm: tuple[float, float, float]) -> None:
        self.axes_mm = axes_mm

    def limit_switches(self) -> tuple[bool, bool, bool]:
        return (self.pressed, False, False)

    def probe_closed(self) -> bool:
        return False


def number(value: int) -> bytes:
    return struct.pack("<IHIi", 10, 3, 1, value)


def text(value: str) -> bytes:
    data = value.encode("utf-16-le")
    return struct.pack("<IHII", 10 + len(data), 8, 1, len(data)) + data


def numbers(*values: float) -> bytes:
    return struct.pack(f"<IHI{len(values)}d", 6 + 8 * len(values), 0x2005, len(values), *values)


def whole(*values: int) -> bytes:
    return struct.pack(f"<IHI{len(values)}i", 6 + 4 * len(values), 0x2003, len(values), *values)


NOTHING = struct.pack("<IHI", 6, 0, 1)


class Client:
    """Asks, and reads the replies by their bytes."""

    def __init__(self) -> None:
        self.clock, self.arm = SimClock(), Arm()
        self.board = RcController(self.arm)
        self.clock.attach(self.board.advance_to)
        self.serial = 0

    def send(self, function: int, *arguments: bytes, reserve: int = 0) -> int:
        self.serial += 1
        body = b"".join(arguments)
        header = struct.pack("<BIHHiH", 1, 16 + len(body), self.serial, reserve, function, len(arguments))
        self.board.receive(header + body + b"\x04")
        return self.serial

    def replies(self) -> Iterator[tuple[int, int, bytes]]:
        while data := self.board.transmit():
            assert (data[0], data[-1], struct.unpack_from("<I", data, 1)[0]) == (1, 4, len(data))
            serial, _, result, _ = struct.unpack_from("<HHIH", data, 5)
            yield serial, result, data[15:-1]

    def ask(self, function: int, *arguments: bytes, reserve: int = 0) -> tuple[int, bytes]:
        serial = self.send(function, *arguments, reserve=reserve)
        self.clock.sleep_s(0.001)
        ((answered, result, value),) = self.replies()
        assert answered == serial
        return result, value

    def arm_command(self, command: str, argument: bytes = NOTHING) -> int:
        return self.ask(64, number(ROBOT), text(command), argument)[0]

    def move(self, x: float, y: float = POWER_UP_POSE[1]) -> int:
        return self.arm_command("slvMove", numbers(x, y, *POWER_UP_POSE[2:], 0.0))


@pytest.fixture
def connected() -> Client:
    client = Client()
    assert client.ask(1, text(""))[0] == 0
    assert client.ask(3, text(""), text("caoProv.DENSO.VRC"), text("localhost"), text("")) == (0, number(CONTROLLER))
    assert client.ask(7, number(CONTROLLER), text("Arm"), text("")) == (0, number(ROBOT))
    return client


@pytest.fixture
def slave(connected: Client) -> Client:
    assert connected.arm_command("TakeArm", whole(0, 1)) == 0
    connected.send(64, number(ROBOT), text("Motor"), whole(1, 0))
    connected.clock.sleep_s(0.4)
    assert [result for _, result, _ in connected.replies()] == [0x900, 0x900, 0x900, 0]
    assert connected.arm_command("slvChangeMode", number(1)) == 0
    return connected


def test_without_a_service_there_are_no_handles() -> None:
    assert Client().ask(3, text(""), text("caoProv.DENSO.VRC"), text("localhost"), text(""))[0] == 0x80070006


def test_what_it_does_not_know_is_refused(connected: Client) -> None:
    assert connected.ask(5)[0] == 0x80004001
    assert connected.arm_command("Dance") == 0x80004001
    assert connected.ask(64, number(7), text("CurPos"), NOTHING)[0] == 0x80070006
    assert connected.ask(64, number(ROBOT))[0] == 0x80070057
    assert connected.ask(9, number(CONTROLLER), text("@NO_SUCH_THING"), text(""))[0] == 0x80070057


def test_the_pose_is_seven_numbers(connected: Client) -> None:
    assert connected.ask(64, number(ROBOT), text("CurPos"), NOTHING) == (0, numbers(*POWER_UP_POSE))


def test_slave_mode_wants_arm_and_motor(connected: Client) -> None:
    assert connected.move(350.0) == 0x83500121
    assert connected.arm_command("slvChangeMode", number(1)) == 0x80070005
    connected.arm_command("TakeArm", whole(0, 1))
    assert connected.arm_command("slvChangeMode", number(1)) == 0x81501003


def test_one_set_point_is_taken_every_8_ms_and_three_wait(slave: Client) -> None:
    x = POWER_UP_POSE[0]
    period_s = 0.008
    slave.clock.run_until((int(slave.clock.now_s() / period_s) + 1) * period_s + 0.0005)
    assert [slave.move(x + 0.1 * n) for n in (1, 2, 3, 4)] == [0, 0, 0x0F200501, 0x83201483]
    slave.clock.run_until(slave.clock.now_s() + 0.0045)
    assert slave.move(x + 0.4) == 0x0F200501
    slave.clock.sleep_s(0.004)
    assert 0.0 < slave.arm.axes_mm[0] < 0.1


def test_a_buffer_that_runs_empty_ends_slave_mode(slave: Client) -> None:
    assert slave.move(POWER_UP_POSE[0] + 0.1) == 0
    slave.clock.sleep_s(0.03)
    assert slave.board.state == "Alarm"
    assert slave.move(POWER_UP_POSE[0] + 0.2) == 0x83500121
    assert slave.ask(9, number(CONTROLLER), text("@ERROR_CODE"), text("")) == (0, number(0x0301))
    assert slave.ask(101, number(0x0301)) == (0, number(0x84201482 - 2**32))
    assert slave.arm_command("slvChangeMode", number(1)) == 0x84201482
    assert slave.ask(17, number(CONTROLLER), text("ClearError"), NOTHING)[0] == 0
    assert slave.arm_command("slvChangeMode", number(1)) == 0


@pytest.mark.parametrize("step_mm", [2.1, -50.0, float("nan"), float("inf")])
def test_a_step_that_is_too_fast_ends_slave_mode_before_it_is_made(slave: Client, step_mm: float) -> None:
    for _ in range(2):
        slave.move(POWER_UP_POSE[0] + step_mm)
    slave.clock.sleep_s(0.02)
    assert slave.board.error_code == 0x84201482
    assert slave.arm.axes_mm == (0.0, 0.0, 0.0)


def test_a_retry_is_answered_from_memory_and_not_executed_twice(slave: Client) -> None:
    serial = slave.send(64, number(ROBOT), text("slvMove"), numbers(*POWER_UP_POSE, 0.0))
    again = slave.send(64, number(ROBOT), text("slvMove"), numbers(*POWER_UP_POSE, 0.0), reserve=serial)
    slave.clock.sleep_s(0.001)
    assert [(each, result) for each, result, _ in slave.replies()] == [(serial, 0), (again, 0)]
    assert slave.move(POWER_UP_POSE[0]) == 0
    assert slave.move(POWER_UP_POSE[0]) in (0, 0x0F200501), "two were taken before, not three"


def test_a_retry_of_what_is_still_executed_is_told_so(connected: Client) -> None:
    connected.arm_command("TakeArm", whole(0, 1))
    serial = connected.send(64, number(ROBOT), text("Motor"), whole(1, 0))
    again = connected.send(64, number(ROBOT), text("Motor"), whole(1, 0), reserve=serial)
    connected.clock.sleep_s(0.01)
    assert [(each, result) for each, result, _ in connected.replies()] == [(again, 0x900)]
    connected.clock.sleep_s(0.5)
    assert list(connected.replies())[-1][:2] == (serial, 0)


def test_a_halt_stops_at_once(slave: Client) -> None:
    for n in (1, 2, 3):
        slave.move(POWER_UP_POSE[0] + n)
    slave.clock.sleep_s(0.004)
    assert slave.ask(70, number(ROBOT), text(""))[0] == 0
    stopped_mm = slave.arm.axes_mm
    slave.clock.sleep_s(0.1)
    assert slave.arm.axes_mm == stopped_mm
    assert slave.board.state == "Idle"


def test_its_emergency_stop_switches_the_motor_off(slave: Client) -> None:
    slave.arm.pressed = True
    slave.clock.sleep_s(0.004)
    assert not slave.board.motor_on
    assert slave.move(POWER_UP_POSE[0]) == 0x83500121


def test_what_is_no_request_is_not_answered(connected: Client) -> None:
    connected.send(1, text(""))
    connected.clock.sleep_s(0.01)
    list(connected.replies())
    whole_request = bytes.fromhex("01 1e000000 0900 0000 01000000 0100  0a000000 0800 01000000 00000000  04")
    for length in range(len(whole_request)):
        connected.board.receive(whole_request[:length])
        connected.board.receive(whole_request[:length] + whole_request[length + 1 :])
    connected.board.receive(b"\x01" * 600)
    connected.clock.sleep_s(0.01)
    assert not list(connected.replies())
    connected.board.receive(whole_request)
    connected.clock.sleep_s(0.01)
    assert len(list(connected.replies())) == 1
