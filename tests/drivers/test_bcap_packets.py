"""b-CAP packets, byte by byte as the specification lays them out; none of them was made by an encoder."""

import pytest

from drivers.errors import ProtocolError
from drivers.motion.bcap.packet import MAX_BYTES, Packet, decode, encode
from drivers.motion.bcap.words import meaning


def packet(text: str) -> bytes:
    return bytes.fromhex(text)


CUR_POS = packet(
    "01 42000000 0500 0000 40000000 0300"
    "0a000000 0300 01000000 01020000"
    "16000000 0800 01000000 0c000000 430075007200 50006f007300"
    "06000000 0000 01000000"
    "04"
)
START = packet("01 1e000000 0100 0000 01000000 0100  0a000000 0800 01000000 00000000  04")
TWO_NUMBERS = packet(
    "01 2a000000 0500 0000 00000000 0100  16000000 0520 02000000 000000000000f83f 00000000000000c0  04"
)
NOTHING = packet("01 10000000 ffff 0700 00000000 0000 04")
REFUSED = packet("01 10000000 0900 0000 06000780 0000 04")
MOTOR = packet(
    "01 48000000 0800 0500 40000000 0300"
    "0a000000 0300 01000000 01020000"
    "14000000 0800 01000000 0a000000 4d006f0074006f007200"
    "0e000000 0320 02000000 01000000 00000000"
    "04"
)
MIXED = packet(
    "01 3b000000 0200 0000 00000000 0100"
    "27000000 0c20 04000000"
    "0200 01000000 feff"
    "0b00 01000000 ffff"
    "1100 01000000 07"
    "0400 01000000 0000c03f"
    "04"
)

WRITTEN = {
    "no argument": (NOTHING, Packet(0xFFFF, 7, 0)),
    "an empty text": (START, Packet(1, 0, 1, ("",))),
    "handle, text, nothing": (CUR_POS, Packet(5, 0, 64, (0x201, "CurPos", None))),
    "whole numbers": (MOTOR, Packet(8, 5, 64, (0x201, "Motor", (1, 0)))),
    "numbers": (TWO_NUMBERS, Packet(5, 0, 0, ((1.5, -2.0),))),
}
READ = WRITTEN | {
    "a refusal": (REFUSED, Packet(9, 0, 0x80070006)),
    "an array of everything": (MIXED, Packet(2, 0, 0, ((-2, True, 7, 1.5),))),
}


@pytest.mark.parametrize(("data", "meant"), READ.values(), ids=READ.keys())
def test_a_packet_is_read(data: bytes, meant: Packet) -> None:
    assert decode(data) == meant


@pytest.mark.parametrize(("data", "meant"), WRITTEN.values(), ids=WRITTEN.keys())
def test_a_packet_is_written(data: bytes, meant: Packet) -> None:
    assert encode(meant) == data


@pytest.mark.parametrize(("data", "_"), READ.values(), ids=READ.keys())
def test_a_torn_packet_is_refused(data: bytes, _: Packet) -> None:
    for length in range(len(data)):
        with pytest.raises(ProtocolError, match="b-CAP"):
            decode(data[:length])
    with pytest.raises(ProtocolError, match="b-CAP"):
        decode(data + b"\x04")
    with pytest.raises(ProtocolError, match="b-CAP"):
        decode(data + data)


@pytest.mark.parametrize(("data", "_"), READ.values(), ids=READ.keys())
def test_a_packet_without_one_of_its_bytes_is_refused(data: bytes, _: Packet) -> None:
    for index in range(len(data)):
        with pytest.raises(ProtocolError, match="b-CAP"):
            decode(data[:index] + data[index + 1 :])


@pytest.mark.parametrize(("data", "meant"), READ.values(), ids=READ.keys())
def test_a_flipped_bit_is_refused_or_changes_that_very_field(data: bytes, meant: Packet) -> None:
    """b-CAP has no checksum of its own, UDP has one: what is left is that no length, type or frame is believed."""
    for index in range(len(data)):
        for bit in range(8):
            flipped = bytearray(data)
            flipped[index] ^= 1 << bit
            try:
                found = decode(bytes(flipped))
            except ProtocolError:
                continue
            assert index not in range(5), "frame and length"
            assert index not in (13, 14, len(data) - 1), "number of arguments, end"
            assert (found.serial != meant.serial) == (index in (5, 6))
            assert (found.reserve != meant.reserve) == (index in (7, 8))
            assert (found.code != meant.code) == (index in range(9, 13))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("02 10000000 0100 0000 00000000 0000 04", "begins with"),
        ("01 10000000 0100 0000 00000000 0000 03", "ends with"),
        ("01 11000000 0100 0000 00000000 0000 04", "says 17 bytes"),
        ("01 10000000 0100 0000 00000000 ffff 04", "count 65535"),
        ("01 11000000 0100 0000 00000000 0000 00 04", "more than its arguments"),
        ("01 1e000000 0100 0000 00000000 0100 0a000000 0600 01000000 00000000 04", "type 0x0006"),
        ("01 1e000000 0100 0000 00000000 0100 0a000000 0300 02000000 00000000 04", "count 2 of a single value"),
        ("01 1e000000 0100 0000 00000000 0100 0a000000 0320 ffffffff 00000000 04", "count 4294967295"),
        ("01 1e000000 0100 0000 00000000 0100 ffffffff 0300 01000000 00000000 04", "wants 4294967295 bytes"),
        ("01 1e000000 0100 0000 00000000 0100 0a000000 0800 01000000 01000000 04", "wants 1 bytes"),
        ("01 20000000 0100 0000 00000000 0100 0c000000 0800 01000000 02000000 00d8 04", "not UTF-16"),
        ("01 1c000000 0100 0000 00000000 0100 08000000 0b00 01000000 0100 04", "truth value 1"),
        ("01 1a000000 0100 0000 00000000 0100 06000000 0000 02000000 04", "count 2 of nothing"),
        ("01 38000000 0100 0000 00000000 0100 24000000" + "0c20 01000000" * 6 + "04", "deeper than"),
    ],
)
def test_what_is_wrong_is_named(text: str, why: str) -> None:
    with pytest.raises(ProtocolError, match=why):
        decode(packet(text))


def test_what_no_datagram_may_hold_is_refused() -> None:
    with pytest.raises(ProtocolError, match="at most 503"):
        encode(Packet(1, 0, 64, ("x" * 250,)))
    with pytest.raises(ProtocolError, match="allowed 16 to 503"):
        decode(bytes(MAX_BYTES + 1))
    with pytest.raises(ProtocolError, match="cannot be written"):
        encode(Packet(1, 0, 64, (2**31,)))


def test_a_trace_tells_datagrams_in_words() -> None:
    asked = encode(Packet(7, 5, 64, (513, "slvMove", (1.0, 2.0))))
    assert meaning(asked, asked=True) == "7 again, first 5: ROBOT_EXECUTE 513, 'slvMove', (1.0000, 2.0000)"
    assert meaning(encode(Packet(7, 0, 0, (True,))), asked=False) == "7: ok True"
    assert meaning(encode(Packet(8, 0, 0x0F200501)), asked=False) == "8: set-point taken, buffer full"
    refused = meaning(encode(Packet(9, 0, 0x83500121)), asked=False)
    assert refused == "9: error 0x83500121 (not in slave mode)"
    assert meaning(b"ok", asked=False) is None
