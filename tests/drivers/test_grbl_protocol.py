"""GRBL 1.1 as a table of (bytes, value), typed from the manual, and real firmware's own words."""

import ast
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ProtocolError
from drivers.motion.grbl.codes import ALARMS, ERRORS, alarm_meaning, alarm_words, error_words
from drivers.motion.grbl.protocol import (
    LONGEST_LINE,
    Alarm,
    Broken,
    Feedback,
    Message,
    Ok,
    Parser,
    Refused,
    Report,
    Setting,
    Startup,
    Welcome,
    build_info,
    move_line,
    parse_line,
)

DIALOGUES = Path(__file__).parents[1] / "data" / "grbl_dialogues"

MANUAL: list[tuple[bytes, Message]] = [
    (b"ok\r\n", Ok()),
    (b"error:20\r\n", Refused(20)),
    (b"ALARM:1\r\n", Alarm(1)),
    (b"Grbl 1.1h ['$' for help]\r\n", Welcome("1.1h", is_hal=False)),
    (b"GrblHAL 1.1f ['$' or '$HELP' for help]\r\n", Welcome("1.1f", is_hal=True)),
    (b"$0=10\r\n", Setting(0, "10")),
    (b"$130=200.000\r\n", Setting(130, "200.000")),
    (b"$300=mill\r\n", Setting(300, "mill")),
    (b"$N0=G54\r\n", Startup("G54")),
    (b">G54:ok\r\n", Startup("G54")),
    (b">G54G20:error:7\r\n", Startup("G54G20")),
    (b"[MSG:'$H'|'$X' to unlock]\r\n", Feedback("MSG", "'$H'|'$X' to unlock")),
    (b"[MSG:]\r\n", Feedback("MSG", "")),
    (b"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0.0 S0]\r\n", Feedback("GC", "G0 G54 G17 G21 G90 G94 M5 M9 T0 F0.0 S0")),
    (b"[VER:1.1h.20190830:bench 7]\r\n", Feedback("VER", "1.1h.20190830:bench 7")),
    (b"[OPT:V,15,128]\r\n", Feedback("OPT", "V,15,128")),
    (b"[PRB:0.000,0.000,-1.000:1]\r\n", Feedback("PRB", "0.000,0.000,-1.000:1")),
    (b"<Idle|MPos:3.000,2.000,0.000|FS:0,0>\r\n", Report("Idle", None, (3.0, 2.0, 0.0), None, 0.0)),
    (b"<Hold:0|MPos:5.000,2.000,0.000|FS:0,0>\r\n", Report("Hold", 0, (5.0, 2.0, 0.0), None, 0.0)),
    (b"<Run|MPos:-15.168,-20.000,0.004|Bf:14,128|FS:500,0>\r\n", Report("Run", None, (-15.168, -20.0, 0.004), 14, 0.0)),
    (
        b"<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0|Ov:100,100,100|A:|TLR:0|Unheard:of>\r\n",
        Report("Idle", None, (0.0, 0.0, 0.0), 100, 0.0),
    ),
]

BROKEN = [
    b"o\r\n",
    b"okok\r\n",
    b" ok\r\n",
    b"error:\r\n",
    b"error:2o\r\n",
    b"ALARM:-1\r\n",
    b"$22\r\n",
    b"[MSG:cut\r\n",
    b"Grbl 1.1h\r\n",
    b"21270237 0.000000\r\n",
    b"<Idle|MPos:3.000,2.000,0.000|FS:0,0\r\n",
    b"<Idle|MPos:3.000,2.000|FS:0,0>\r\n",
    b"<Idle|MPos:3.000,2.0.0,0.000|FS:0,0>\r\n",
    b"<Idle|MPos:3,2,0>\r\n",
    b"<Idle|MPos:nan,inf,0.000>\r\n",
    b"<Idle|FS:0,0>\r\n",
    b"<Idle|WPos:0.000,0.000,0.000>\r\n",
    b"<Idel|MPos:3.000,2.000,0.000>\r\n",
    b"<Idle|MPos:3.000,2.000,0.000|Bf:15>\r\n",
    b"<Idle|MPos:3.000,2.000,0.000|Bf:-1,128>\r\n",
    b"o\xffk\r\n",
]


@pytest.mark.parametrize(("line", "message"), MANUAL)
def test_what_the_manual_says(line: bytes, message: Message) -> None:
    assert Parser().feed(line) == [message]


@pytest.mark.parametrize("line", BROKEN)
def test_what_no_manual_says_is_broken(line: bytes) -> None:
    (message,) = Parser().feed(line)
    assert isinstance(message, Broken)
    assert message.line


def test_a_broken_line_says_what_is_wrong() -> None:
    with pytest.raises(ProtocolError, match=r"Idel.*Idle"):
        parse_line("<Idel|MPos:3.000,2.000,0.000>")


def test_numeric_settings_have_a_value() -> None:
    assert Setting(130, "200.000").value == 200.0
    assert Setting(300, "mill").value is None


@given(st.lists(st.integers(1, 30)), st.data())
def test_pieces_of_any_size_give_the_same_messages(sizes: list[int], data: st.DataObject) -> None:
    stream = b"".join(line for line, _ in MANUAL)
    parser = Parser()
    messages = []
    rest = stream
    for size in sizes:
        messages += parser.feed(rest[:size])
        rest = rest[size:]
    assert messages + parser.feed(rest) == [message for _, message in MANUAL]


@given(st.binary(max_size=200))
def test_no_bytes_break_the_parser_or_what_comes_after_the_next_line_end(noise: bytes) -> None:
    parser = Parser()
    parser.feed(noise)
    assert parser.feed(b"\r\nok\r\n")[-1] == Ok()


def test_a_line_without_end_is_given_up() -> None:
    parser = Parser()
    assert isinstance(parser.feed(b"x" * (LONGEST_LINE + 1))[0], Broken)
    assert parser.feed(b"ok\r\n") == [Ok()]


@pytest.mark.parametrize("name", ["gnea-1.1h", "grblhal"])
def test_real_firmware_is_understood(name: str) -> None:
    """All that real firmware said, but for what a build for a PC prints by itself and reports without MPos ($10=2)."""
    said = [line for line in (DIALOGUES / f"{name}.txt").read_text().splitlines() if line[10] == "<"]
    texts = [ast.literal_eval(line[12:]) for line in said]
    broken = []
    for text in filter(None, texts):
        try:
            parse_line(text)
        except ProtocolError:
            broken.append(text)
    assert all("WPos" in text or text in {"$22", "21270237 0.000000"} for text in broken)
    assert len(broken) <= 3


def test_build_info_of_both_firmwares() -> None:
    gnea = build_info([Feedback("VER", "1.1h.20190830:"), Feedback("OPT", "V,15,128")])
    assert (gnea.identity, gnea.options, gnea.is_hal) == ("Grbl 1.1h.20190830", "V", False)
    hal = build_info(
        [
            Feedback("VER", "1.1f.20260817:bench 7"),
            Feedback("OPT", "VNML+,100,1024,3,0"),
            Feedback("FIRMWARE", "grblHAL"),
        ]
    )
    assert (hal.identity, hal.options, hal.is_hal) == ("grblHAL 1.1f.20260817 bench 7", "VNML+", True)


@pytest.mark.parametrize(
    ("texts", "complaint"),
    [({"VER": "0.9j.20150930:", "OPT": "V"}, "0.9j"), ({"OPT": "V"}, "''"), ({"VER": "1.1h:"}, "OPT")],
)
def test_other_firmware_is_refused(texts: dict[str, str], complaint: str) -> None:
    with pytest.raises(ProtocolError, match=complaint):
        build_info([Feedback(kind, text) for kind, text in texts.items()])


def test_a_move_is_in_machine_coordinates_and_fits_the_shortest_line_buffer() -> None:
    assert move_line((-1.0, -2.5, -27.9996), 600.0) == "G53G1X-1.000Y-2.500Z-28.000F600.00"
    assert len(move_line((-9999.999, -9999.999, -9999.999), 99999.99)) < 70


def test_codes_in_words() -> None:
    assert error_words(9) == "error:9 (G-code is locked out by an alarm or a jog)"
    assert "99" in error_words(99)
    assert alarm_words(2) == "ALARM:2 (target beyond the soft limits; position kept)"
    assert alarm_words(3) == "ALARM:3 (reset while in motion; position lost)"
    assert alarm_meaning(99).position_lost, "an alarm that nobody knows may have lost the position"
    assert [code for code, meaning in ALARMS.items() if not meaning.position_lost] == [2, 4, 5, 14]
    assert set(range(1, 18)) <= set(ERRORS)
    assert set(range(20, 39)) <= set(ERRORS)
