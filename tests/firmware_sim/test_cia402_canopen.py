"""CiA 301 as bytes: what the manual says a node answers, typed from the manual."""

import pytest
from fake_load import FakeLoad

from firmware_sim.cia402_drive import Cia402Drive


def booted(**options) -> Cia402Drive:
    drive = Cia402Drive(FakeLoad(), **options)
    drive.advance_to(0.2)
    drive.transmit()
    return drive


def sdo(drive: Cia402Drive, request: str) -> str:
    drive.receive(0x601, bytes.fromhex(request))
    frames = drive.transmit()
    assert [can_id for can_id, _ in frames] == [0x581]
    return frames[0][1].hex(" ")


def nmt(drive: Cia402Drive, command: int, node: int = 1) -> None:
    drive.receive(0x000, bytes((command, node)))


def run(drive: Cia402Drive, duration_s: float) -> list[tuple[int, bytes]]:
    drive.advance_to(drive.time_s + duration_s)
    return drive.transmit()


SDO_TABLE = [
    # expedited upload: 43 = 4 bytes, 4B = 2, 4F = 1
    ("40 00 10 00 00 00 00 00", "43 00 10 00 92 01 02 00"),
    ("40 17 10 00 00 00 00 00", "4b 17 10 00 00 00 00 00"),
    ("40 01 10 00 00 00 00 00", "4f 01 10 00 00 00 00 00"),
    ("40 14 10 00 00 00 00 00", "43 14 10 00 81 00 00 00"),
    ("40 18 10 00 00 00 00 00", "4f 18 10 00 04 00 00 00"),
    ("40 02 65 00 00 00 00 00", "43 02 65 00 04 00 00 00"),
    ("40 41 60 00 00 00 00 00", "4b 41 60 00 50 12 00 00"),  # switch on disabled, voltage, remote, speed zero
    ("40 5a 60 00 00 00 00 00", "4b 5a 60 00 02 00 00 00"),
    ("40 07 60 00 00 00 00 00", "4b 07 60 00 01 00 00 00"),
    ("40 00 14 01 00 00 00 00", "43 00 14 01 01 02 00 00"),
    ("40 00 18 01 00 00 00 00", "43 00 18 01 81 01 00 40"),
    ("40 00 1a 01 00 00 00 00", "43 00 1a 01 10 00 41 60"),
    # expedited download
    ("2b 17 10 00 f4 01 00 00", "60 17 10 00 00 00 00 00"),
    ("23 16 10 01 fa 00 7f 00", "60 16 10 01 00 00 00 00"),
    ("2f 60 60 00 03 00 00 00", "60 60 60 00 00 00 00 00"),
    ("22 ff 60 00 40 9c 00 00", "60 ff 60 00 00 00 00 00"),  # without a size
    # aborts
    ("40 34 12 00 00 00 00 00", "80 34 12 00 00 00 02 06"),  # no such object
    ("40 18 10 05 00 00 00 00", "80 18 10 05 11 00 09 06"),  # no such sub-index
    ("2b 41 60 00 00 00 00 00", "80 41 60 00 02 00 01 06"),  # read only
    ("2f 17 10 00 01 00 00 00", "80 17 10 00 13 00 07 06"),  # too short
    ("23 17 10 00 01 00 00 00", "80 17 10 00 12 00 07 06"),  # too long
    ("2f 60 60 00 01 00 00 00", "80 60 60 00 30 00 09 06"),  # profile position: not supported
    ("2b 5a 60 00 03 00 00 00", "80 5a 60 00 30 00 09 06"),
    ("2b 72 60 00 d1 07 00 00", "80 72 60 00 31 00 09 06"),  # 2001 per mille: too high
    ("23 83 60 00 00 00 00 00", "80 83 60 00 32 00 09 06"),  # no ramp: too low
    ("23 16 10 01 fa 00 01 00", "80 16 10 01 43 00 04 06"),  # consumer of its own heartbeat
    ("2f 29 10 01 03 00 00 00", "80 29 10 01 30 00 09 06"),
    ("2f 03 10 00 01 00 00 00", "80 03 10 00 30 00 09 06"),  # only zero clears the history
    ("40 03 10 01 00 00 00 00", "80 03 10 01 24 00 00 08"),  # nothing there yet
    ("a0 08 10 00 00 00 00 00", "80 08 10 00 01 00 04 05"),  # block upload: unknown here
    ("60 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),  # a segment without a transfer
    ("2f 00 1a 00 02 00 00 00", "80 00 1a 00 00 00 01 06"),  # mapping of a valid PDO
]


@pytest.mark.parametrize(("request_bytes", "reply"), SDO_TABLE)
def test_sdo(request_bytes, reply):
    assert sdo(booted(), request_bytes) == reply


def test_segmented_upload_of_the_device_name():
    drive = booted()
    assert sdo(drive, "40 08 10 00 00 00 00 00") == "41 08 10 00 16 00 00 00"
    text, toggle = b"", 0
    while True:
        reply = bytes.fromhex(sdo(drive, f"{0x60 | toggle:02x} 00 00 00 00 00 00 00"))
        assert reply[0] & 0x10 == toggle
        text += reply[1 : 8 - (reply[0] >> 1 & 7)]
        toggle ^= 0x10
        if reply[0] & 1:
            break
    assert text == b"Emulated spindle drive" == text[:0x16]


def test_segments_must_alternate_the_toggle_bit():
    drive = booted()
    sdo(drive, "40 08 10 00 00 00 00 00")
    assert sdo(drive, "70 00 00 00 00 00 00 00") == "80 08 10 00 00 00 03 05"
    assert sdo(drive, "60 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"


def test_segmented_download():
    drive = booted()
    assert sdo(drive, "21 ff 60 00 04 00 00 00") == "60 ff 60 00 00 00 00 00"
    assert sdo(drive, "00 01 02 03 00 00 00 00") == "20 00 00 00 00 00 00 00"
    assert sdo(drive, "40 ff 60 00 00 00 00 00") == "43 ff 60 00 00 00 00 00"


def test_segmented_download_in_one_segment():
    drive = booted()
    sdo(drive, "21 ff 60 00 04 00 00 00")
    assert sdo(drive, "07 10 27 00 00 00 00 00") == "20 00 00 00 00 00 00 00"
    assert sdo(drive, "40 ff 60 00 00 00 00 00") == "43 ff 60 00 10 27 00 00"


def test_segmented_download_of_the_wrong_length_writes_nothing():
    drive = booted()
    sdo(drive, "21 ff 60 00 04 00 00 00")
    assert sdo(drive, "09 10 27 00 00 00 00 00") == "80 ff 60 00 10 00 07 06"
    assert sdo(drive, "40 ff 60 00 00 00 00 00") == "43 ff 60 00 00 00 00 00"


def test_an_abort_of_the_client_gets_no_answer():
    drive = booted()
    drive.receive(0x601, bytes.fromhex("80 08 10 00 00 00 00 05"))
    assert drive.transmit() == []


def test_requests_of_another_length_are_ignored():
    drive = booted()
    drive.receive(0x601, bytes.fromhex("40 00 10 00"))
    assert drive.transmit() == []


def test_boot_up_then_silence_without_a_producer_time():
    drive = Cia402Drive(FakeLoad(), node_id=5)
    assert run(drive, 0.04) == []
    drive.receive(0x605, bytes.fromhex("40 00 10 00 00 00 00 00"))
    assert drive.transmit() == []
    assert run(drive, 0.1) == [(0x705, b"\x00")]
    assert run(drive, 1.0) == []


@pytest.mark.parametrize(("command", "state"), [(1, 0x05), (2, 0x04), (128, 0x7F)])
def test_nmt_states_as_the_heartbeat_tells_them(command, state):
    drive = booted()
    sdo(drive, "2b 17 10 00 64 00 00 00")
    nmt(drive, command)
    beats = [data for can_id, data in run(drive, 1.01) if can_id == 0x701]
    assert beats == [bytes((state,))] * 11


@pytest.mark.parametrize("node", [0, 1])
def test_nmt_reset_boots_again_with_defaults(node):
    drive = booted()
    sdo(drive, "2b 17 10 00 64 00 00 00")
    nmt(drive, 129, node)
    frames = run(drive, 0.5)
    assert frames == [(0x701, b"\x00")]
    assert sdo(drive, "40 17 10 00 00 00 00 00") == "4b 17 10 00 00 00 00 00"


def test_nmt_reset_communication_keeps_the_profile_objects():
    drive = booted()
    sdo(drive, "23 ff 60 00 10 27 00 00")
    nmt(drive, 130)
    run(drive, 0.2)
    assert sdo(drive, "40 ff 60 00 00 00 00 00") == "43 ff 60 00 10 27 00 00"


def test_nmt_for_another_node_is_not_ours():
    drive = booted()
    nmt(drive, 129, node=2)
    assert run(drive, 0.5) == []


def test_a_stopped_node_answers_no_sdo():
    drive = booted()
    nmt(drive, 2)
    drive.receive(0x601, bytes.fromhex("40 00 10 00 00 00 00 00"))
    assert drive.transmit() == []


def test_pdos_only_when_operational():
    drive = booted()
    drive.receive(0x201, bytes.fromhex("06 00"))
    drive.receive(0x080, b"")
    assert run(drive, 0.1) == []
    nmt(drive, 1)
    assert run(drive, 0.1) == [(0x181, bytes.fromhex("50 12"))]
    drive.receive(0x201, bytes.fromhex("06 00"))
    assert run(drive, 0.1) == [(0x181, bytes.fromhex("31 12"))]


MAP_SPEED_AND_TORQUE = [
    "23 01 18 01 81 02 00 c0",
    "2f 01 1a 00 00 00 00 00",
    "23 01 1a 01 10 00 41 60",
    "23 01 1a 02 20 00 6c 60",
    "23 01 1a 03 10 00 77 60",
    "2f 01 1a 00 03 00 00 00",
]


def map_second_pdo(drive, kind: int, timer_ms: int = 0, inhibit_100us: int = 0):
    for request in [
        *MAP_SPEED_AND_TORQUE,
        f"2f 01 18 02 {kind:02x} 00 00 00",
        f"2b 01 18 03 {inhibit_100us.to_bytes(2, 'little').hex(' ')} 00 00",
        f"2b 01 18 05 {timer_ms.to_bytes(2, 'little').hex(' ')} 00 00",
        "23 01 18 01 81 02 00 40",
    ]:
        assert sdo(drive, request).startswith("60"), request


def sent(frames, can_id=0x281):
    return [data for found, data in frames if found == can_id]


def test_mapped_pdo_on_every_third_sync():
    drive = booted()
    map_second_pdo(drive, kind=3)
    nmt(drive, 1)
    counts = []
    for _ in range(6):
        drive.receive(0x080, b"")
        counts.append(len(sent(run(drive, 0.01))))
    assert counts == [0, 0, 1, 0, 0, 1]


def test_type_zero_sends_on_sync_after_a_change_only():
    drive = booted()
    map_second_pdo(drive, kind=0)
    nmt(drive, 1)
    counts = []
    for step in range(4):
        if step == 2:
            drive.receive(0x201, bytes.fromhex("06 00"))
        drive.receive(0x080, b"")
        counts.append(len(sent(run(drive, 0.01))))
    assert counts == [1, 0, 1, 0]


def test_event_timer():
    drive = booted()
    map_second_pdo(drive, kind=255, timer_ms=20)
    nmt(drive, 1)
    frames = sent(run(drive, 1.0))
    assert 49 <= len(frames) <= 51
    assert frames[0] == bytes.fromhex("50 12 00 00 00 00 00 00")


def test_inhibit_time_bounds_the_rate_of_changes():
    drive = booted()
    map_second_pdo(drive, kind=255, inhibit_100us=100)
    nmt(drive, 1)
    for word in ("06", "07", "0f"):
        drive.receive(0x201, bytes.fromhex(f"{word} 00"))
    drive.receive(0x601, bytes.fromhex("2f 60 60 00 03 00 00 00"))
    drive.receive(0x601, bytes.fromhex("23 ff 60 00 40 9c 00 00"))
    assert 40 <= len(sent(run(drive, 0.5))) <= 51


def test_synchronous_receive_pdo_waits_for_the_sync():
    drive = booted()
    sdo(drive, "23 00 14 01 01 02 00 80")
    sdo(drive, "2f 00 14 02 01 00 00 00")
    sdo(drive, "23 00 14 01 01 02 00 00")
    nmt(drive, 1)
    run(drive, 0.01)
    drive.receive(0x201, bytes.fromhex("06 00"))
    assert run(drive, 0.01) == []
    drive.receive(0x080, b"")
    assert run(drive, 0.01) == [(0x181, bytes.fromhex("31 12"))]


def test_a_pdo_that_is_too_short_is_an_emergency_and_counts_for_nothing():
    drive = booted()
    nmt(drive, 1)
    run(drive, 0.01)
    drive.receive(0x201, b"\x06")
    assert run(drive, 0.01) == [
        (0x081, bytes.fromhex("10 82 11 00 00 00 00 00")),
        (0x081, bytes.fromhex("00 00 00 00 00 00 00 00")),
    ]


MAPPING_REFUSALS = [
    ("23 01 1a 01 20 00 41 60", "80 01 1a 01 41 00 04 06"),  # wrong length of the object
    ("23 01 1a 01 10 00 34 12", "80 01 1a 01 00 00 02 06"),  # no such object
    ("23 01 1a 01 20 00 83 60", "60 01 1a 01 00 00 00 00"),
    ("23 01 1a 01 10 00 17 10", "80 01 1a 01 41 00 04 06"),  # heartbeat time cannot be mapped
    ("23 01 16 01 10 00 41 60", "80 01 16 01 00 00 01 06"),  # that PDO's mapping is still on
    ("2f 01 1a 00 01 00 00 00", "60 01 1a 00 00 00 00 00"),
    ("2f 01 1a 00 03 00 00 00", "80 01 1a 00 00 00 02 06"),  # the third place is empty
]


@pytest.mark.parametrize(("request_bytes", "reply"), MAPPING_REFUSALS)
def test_mapping_rules(request_bytes, reply):
    drive = booted()
    for request in MAP_SPEED_AND_TORQUE[:2]:
        sdo(drive, request)
    assert sdo(drive, request_bytes) == reply


def test_a_mapping_longer_than_a_frame_is_refused():
    drive = booted()
    for request in MAP_SPEED_AND_TORQUE[:2]:
        sdo(drive, request)
    for subindex in (1, 2, 3):
        sdo(drive, f"23 01 1a {subindex:02x} 20 00 6c 60")
    assert sdo(drive, "2f 01 1a 00 03 00 00 00") == "80 01 1a 00 42 00 04 06"


def test_consumer_heartbeat_watches_from_the_first_beat_on():
    drive = booted()
    sdo(drive, "23 16 10 01 fa 00 7f 00")
    assert run(drive, 2.0) == []
    drive.receive(0x77F, b"\x05")
    assert run(drive, 0.24) == []
    drive.receive(0x77F, b"\x05")
    assert run(drive, 0.24) == []
    assert run(drive, 0.02) == [(0x081, bytes.fromhex("30 81 11 00 00 00 00 00"))]
    assert sdo(drive, "40 01 10 00 00 00 00 00") == "4f 01 10 00 11 00 00 00"
    assert sdo(drive, "40 03 10 00 00 00 00 00") == "4f 03 10 00 01 00 00 00"
    assert sdo(drive, "40 03 10 01 00 00 00 00") == "43 03 10 01 30 81 00 00"
    drive.receive(0x77F, b"\x05")
    assert drive.transmit() == [(0x081, bytes(8))]


@pytest.mark.parametrize(("behaviour", "state"), [(0, 0x7F), (1, 0x05), (2, 0x04)])
def test_error_behaviour_after_a_lost_heartbeat(behaviour, state):
    drive = booted()
    sdo(drive, "23 16 10 01 fa 00 7f 00")
    sdo(drive, f"2f 29 10 01 {behaviour:02x} 00 00 00")
    sdo(drive, "2b 17 10 00 64 00 00 00")
    nmt(drive, 1)
    drive.receive(0x77F, b"\x05")
    beats = [data for can_id, data in run(drive, 1.0) if can_id == 0x701]
    assert beats[0] == b"\x05"
    assert beats[-1] == bytes((state,))
