"""The inverter's side of the wire: frames typed from the manuals, silence between them, and what it does alone."""

import pytest
from fake_load import FakeLoad

from firmware_sim.modbus_drive import ModbusDrive

READ_STATUS = bytes.fromhex("01 03 21 01 00 01 df f6")
FREQUENCY_1000 = bytes.fromhex("01 06 20 01 03 e8 d3 74")  # 100.0 Hz
RUN = bytes.fromhex("01 06 20 00 00 12 02 07")
STOP = bytes.fromhex("01 06 20 00 00 01 43 ca")


class Host:
    """Writes frames and lets time pass."""

    def __init__(self) -> None:
        self.load = FakeLoad()
        self.drive = ModbusDrive(self.load)
        self.time_s = 0.0

    def run(self, duration_s: float) -> bytes:
        until_s, heard = self.time_s + duration_s, b""
        while self.time_s < until_s:
            self.time_s += 0.0005
            self.drive.advance_to(self.time_s)
            heard += self.drive.transmit()
        return heard

    def ask(self, frame: bytes) -> bytes:
        self.drive.receive(frame)
        return self.run(0.02)


@pytest.mark.parametrize(
    ("frame", "answer"),
    [
        ("01 03 21 01 00 01 df f6", "01 03 02 05 00 bb 14"),  # stands; frequency and commands by wire
        ("01 06 20 01 03 e8 d3 74", "01 06 20 01 03 e8 d3 74"),
        ("01 10 20 00 00 02 04 00 12 03 e8 ca d5", "01 10 20 00 00 02 4a 08"),
        ("01 03 30 00 00 01 8b 0a", "01 83 02 c0 f1"),
        ("01 06 20 01 27 11 08 36", "01 86 03 02 61"),  # above 1000.0 Hz
        ("01 04 21 01 00 01 6a 36", "01 84 01 82 c0"),
        ("01 03 21 01 00 01 de 37", ""),
        ("02 03 21 01 00 01 df c5", ""),
    ],
)
def test_frames_of_the_manual(frame: str, answer: str) -> None:
    assert Host().ask(bytes.fromhex(frame)) == bytes.fromhex(answer)


def test_two_frames_without_silence_between_them_are_one_broken_frame() -> None:
    assert Host().ask(READ_STATUS + STOP) == b""


def test_who_talks_while_it_answers_spoils_the_answer_and_is_not_heard() -> None:
    host = Host()
    host.ask(FREQUENCY_1000)
    host.ask(RUN)
    host.drive.receive(READ_STATUS)
    host.run(0.0045)
    host.drive.receive(STOP)
    answer = host.run(0.05)
    assert len(answer) == 7
    assert answer != bytes.fromhex("01 03 02 05 03 fb 15"), "spoiled"
    assert host.drive.drives


def test_it_runs_up_and_stops_by_its_ramps() -> None:
    host = Host()
    host.ask(FREQUENCY_1000)
    host.ask(RUN)
    host.run(0.3)
    assert host.drive.speed_rpm == pytest.approx(6000.0, rel=0.02)
    assert host.ask(READ_STATUS)[3:5] == bytes.fromhex("05 03")
    host.ask(STOP)
    host.run(0.3)
    assert host.drive.speed_rpm == pytest.approx(0.0, abs=60.0)


@pytest.mark.parametrize(("treatment", "fault"), [(1, 58), (2, 58), (3, 0)])
def test_it_minds_a_silent_host_as_its_parameters_say(treatment: int, fault: int) -> None:
    host = Host()
    host.drive.write_register(0x0902, treatment)
    host.drive.write_register(0x0903, 3)
    host.ask(FREQUENCY_1000)
    host.ask(RUN)
    for _ in range(20):
        host.ask(READ_STATUS)
    assert host.drive.drives
    host.run(0.5)
    assert host.drive.read_register(0x2100) == fault
    assert host.drive.drives == (fault == 0)
    if fault:
        assert host.ask(RUN) == bytes.fromhex("01 86 04 43 a3"), "a drive in fault does not run"
