"""g2core's JSON by hand, from the wiki's pages on JSON, status reports, status codes and exception reports."""

import pytest

from drivers.errors import ProtocolError
from drivers.motion.tinyg import codes, protocol
from drivers.motion.tinyg.protocol import Broken, Notice, Parser, Reply, Report, Trouble, Welcome, parse_line

REPORT = '{"stat":5,"qr":46,"vel":599.98,"mpox":-1.5,"mpoy":0,"mpoz":-2.125}'


def test_a_reply_has_body_and_status() -> None:
    assert parse_line('{"r":{"xvm":1200},"f":[1,0,10]}') == [Reply({"xvm": 1200}, 0)]
    assert parse_line('{"r":{"xyz":null},"f":[1,100,11]}') == [Reply({"xyz": None}, 100)]
    assert parse_line('{"r":{"gc":"G1X1","f":[1,0,255,1234]}}')[0].status == 0, "TinyG's footer is inside"


def test_a_status_report_is_told_with_and_without_a_question() -> None:
    report = Report(5, (-1.5, 0.0, -2.125), 599.98, 46)
    assert parse_line(f'{{"sr":{REPORT}}}') == [report]
    asked = parse_line(f'{{"r":{{"sr":{REPORT}}},"f":[1,0,12]}}')
    assert asked[0] == report
    assert isinstance(asked[1], Reply)


def test_what_is_not_known_inside_a_report_is_ignored() -> None:
    assert parse_line('{"sr":' + REPORT[:-1] + ',"new":"field"}}') == [Report(5, (-1.5, 0.0, -2.125), 599.98, 46)]
    assert parse_line('{"sr":{"posx":1.0,"stat":3}}') == [Notice()], "a filtered one is not whole"
    assert parse_line('{"qr":48}') == [Notice()]
    assert parse_line('{"ack":true}') == [Notice()]


def test_what_the_board_finds_by_itself() -> None:
    assert parse_line('{"er":{"fb":101.03,"st":225,"msg":"Soft limit - Z min - soft_limits"}}') == [
        Trouble(225, "Soft limit - Z min - soft_limits")
    ]
    assert parse_line('{"r":{"msg":"Homing error"},"f":[1,240,0]}') == [Trouble(240, "Homing error")]
    ready = '{"r":{"fv":0.99,"fb":101.03,"hp":3,"hv":0,"id":"0213-2335-6343","msg":"SYSTEM READY"},"f":[1,%d,0]}'
    assert parse_line(ready % 0) == [Welcome()]
    assert parse_line(ready % 15) == [Notice()], "initializing, not yet ready"


@pytest.mark.parametrize(
    "line",
    [
        "", "ok", "[]", "7", "{}", '{"x":1}', '{"r":{}}', '{"r":{},"f":[1,0]}', '{"r":{},"f":[1,256,0]}',
        '{"r":{},"f":[1,-1,0]}', '{"r":{},"f":[1,0.0,0]}', '{"r":[],"f":[1,0,0]}', '{"r":{},"f":[1,true,0]}',
        '{"er":{"fb":101.03}}', '{"er":7}', '{"sr":7}', '{"r":{"sr":7},"f":[1,0,9]}',
        '{"r":{"sr":{"stat":3}},"f":[1,0,10]', '{"r":{"a":1,"a":2},"f":[1,0,9]}', "tinyg [mm] ok>",
        '{"sr":' + REPORT.replace("5,", "14,", 1) + "}", '{"sr":' + REPORT.replace("-1.5", "NaN") + "}",
        '{"sr":' + REPORT.replace("-1.5", '"-1.5"') + "}", '{"sr":' + REPORT.replace("-1.5", "1e9") + "}",
        '{"sr":' + REPORT.replace("46", "46.0") + "}", "[" * 100_000,
    ],
)  # fmt: skip
def test_a_line_that_no_manual_has_is_refused(line: str) -> None:
    with pytest.raises(ProtocolError):
        parse_line(line)


def test_bytes_come_in_pieces_of_any_size() -> None:
    stream = b'{"qr":48}\r\n\n{"er":{"fb":101.03,"st":207,"msg":"Kill job"}}\nrubbish\n'
    whole = Parser().feed(stream)
    assert [type(message) for message in whole] == [Notice, Trouble, Broken]
    parser = Parser()
    assert [message for byte in stream for message in parser.feed(bytes([byte]))] == whole
    assert isinstance(Parser().feed(b"x" * 3000)[0], Broken), "a line without an end"


def test_a_numbered_line_carries_the_exclusive_or_of_its_characters() -> None:
    # By hand: N ^ 1 ^ G ^ 2 ^ 1 = 0x4E ^ 0x31 ^ 0x47 ^ 0x32 ^ 0x31 = 59.
    assert protocol.numbered(1, "G21") == "N1G21*59"
    assert protocol.move_block((-1.5, 0.0, -2.125), 600.0) == "G21G90G94G53G1X-1.500Y0.000Z-2.125F600.00"
    assert protocol.query("sr") == '{"sr":null}'
    assert protocol.assignment("ztn", -5.001) == '{"ztn":-5.001}'


def test_codes_are_told_in_words() -> None:
    assert codes.status_words(118) == "status 118 (checksum does not match)"
    assert codes.alarm_words(225) == "ALARM 225 (target beyond the soft limits, Z low; position kept)"
    assert "limit switch" in codes.alarm_words(203)
    assert not codes.keeps_position(203)
    assert not codes.keeps_position(255), "what no manual names"
