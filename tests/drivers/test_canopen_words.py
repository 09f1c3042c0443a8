"""Frames in words, typed from CiA 301 and CiA 402."""

import pytest

from drivers.spindle.canopen_words import meaning


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        ("000#8000", "NMT enter pre-operational node all"),
        ("000#05", "too short for CANopen"),
        ("080#", "SYNC"),
        ("081#1023010000000000", "EMCY node 1: 0x2310 continuous over-current at the output"),
        ("081#0000000000000000", "EMCY node 1: errors are gone"),
        ("701#00", "heartbeat node 1: boot-up"),
        ("77F#05", "heartbeat node 127: operational"),
        ("181#3706307500006400", "TPDO1 node 1: operation enabled, 30000 rpm, torque 10 %"),
        ("181#00", "TPDO1 node 1"),
        ("281#00", "TPDO2 node 1"),
        ("501#00", "RPDO4 node 1"),
        ("201#0F0030750000", "RPDO1 node 1: controlword 000Fh, target 30000 rpm"),
        ("601#4000100000000000", "SDO host -> node 1: read 1000h:00h (device type)"),
        ("581#4300100092010200", "SDO node 1 -> host: 1000h:00h (device type) = 0x20192"),
        ("601#2F60600003000000", "SDO host -> node 1: write 6060h:00h (mode of operation) = 0x3"),
        ("581#6060600000000000", "SDO node 1 -> host: 6060h:00h (mode of operation) written"),
        ("581#4108100009000000", "SDO node 1 -> host: 1008h:00h, 9 bytes in segments"),
        ("601#6000000000000000", "SDO host -> node 1: asks for the next segment"),
        ("601#80AA0A0100000000", "SDO host -> node 1: abort 0AAAh:01h"),
        ("581#807F600000000206", "SDO node 1 -> host: refuses 607Fh:00h (max profile velocity)"),
        ("7E4#00", ""),
    ],
)
def test_a_frame_says_what_it_means(frame: str, words: str) -> None:
    can_id, _, data = frame.partition("#")
    found = meaning(int(can_id, 16), bytes.fromhex(data))
    assert found == words or (words and found.startswith(f"{words}, "))
