"""`mill trace`: what is shown, cut and exported of a trace."""

import json
import struct
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mill_command import mill

from drivers.trace_file import frame_of, read_trace

TRACES = Path(__file__).parent.parent / "traces"
MOTION, SPINDLE = str(TRACES / "motion-session.jsonl"), str(TRACES / "spindle-session.jsonl")


def test_bytes_are_shown_as_lines_of_text_with_what_was_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("trace", "show", MOTION) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.endswith(r"-> $H\n") for line in lines)
    assert any(line.endswith(r"<- ok\r\n") for line in lines)
    assert any(line.endswith(r"-> \x18") for line in lines)
    assert any("start_move(target_mm=[6.0, -4.0, 5.0], feed_mm_per_s=15.0)" in line for line in lines)
    reports = [line for line in lines if "<- <" in line]
    assert reports
    assert all(line.endswith(r">\r\n") for line in reports)


@pytest.mark.parametrize(
    "expected",
    [
        "-> 000#0101              NMT start node 1",
        "-> 080#                  SYNC",
        "TPDO1 node 1: operation enabled, ",
        "RPDO1 node 1: controlword 000Fh, target 45000 rpm",
        "heartbeat node 127: operational",
        "write 1016h:01h (consumer heartbeat time) = 0x7f00fa",
        "refuses",
        "segment b'",
    ],
)
def test_frames_are_shown_with_what_they_mean(expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("trace", "show", SPINDLE) == 0
    assert expected in capsys.readouterr().out


def test_a_part_is_shown_by_wire_time_and_pattern(capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("trace", "show", SPINDLE, "--wire", "spindle", "--from", "0.3", "--to", "0.6", "--grep", "SYNC$") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines
    assert all(line.endswith("SYNC") and 0.3 <= float(line.split()[0]) <= 0.6 for line in lines)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["show", "none.jsonl"], "none.jsonl: cannot be read"),
        (["show", __file__], "line 1: the checksum does not match"),
        (["show", MOTION, "--wire", "spindle"], "there are motion"),
        (["show", MOTION, "--grep", "("], "--grep"),
        (["cut", MOTION, "--from", "1e6", "--out", "x.jsonl"], "nothing between"),
        (["export", MOTION], "give --mcap OUT, --pcap OUT"),
        (["export", MOTION, "--pcap", "x.pcap"], "holds no CAN frame"),
        (["export", SPINDLE, "--pcap", "no/such/x.pcap"], "cannot be written"),
        (["export", SPINDLE, "--mcap", "no/such/x.mcap"], "cannot be written"),
    ],
)
def test_wrong_input_is_one_line(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert mill("trace", *words) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1


def test_a_cut_trace_is_a_trace(tmp_path: Path) -> None:
    out = tmp_path / "cut.jsonl"
    assert mill("trace", "cut", SPINDLE, "--to", "0.5", "--out", str(out)) == 0
    log, part = read_trace(Path(SPINDLE)), read_trace(out)
    assert part.header == log.header
    assert part.entries == [entry for entry in log.entries if entry.t_s <= 0.5]
    assert mill("trace", "cut", SPINDLE, "--out", str(out)) == 2


def test_an_mcap_file_holds_every_line_at_its_time(tmp_path: Path) -> None:
    out = tmp_path / "t.mcap"
    assert mill("trace", "export", SPINDLE, "--mcap", str(out)) == 0
    log = read_trace(Path(SPINDLE))
    with out.open("rb") as file:
        messages = list(make_reader(file).iter_messages())
    assert len(messages) == len(log.entries)
    for (schema, channel, message), entry in zip(messages, log.entries, strict=True):
        assert schema is not None
        assert (schema.encoding, channel.topic, channel.message_encoding) == ("jsonschema", f"/{entry.wire}", "json")
        told = json.loads(message.data)
        assert (told["t"], told["kind"], told["data"]) == (entry.t_s, entry.kind, entry.data)
        assert message.log_time == pytest.approx(1e9 * (log.began.timestamp() + entry.t_s), abs=1e3)


def test_a_pcap_file_holds_every_frame_as_the_format_says(tmp_path: Path) -> None:
    """Read by the words of the pcap draft and of LINKTYPE_CAN_SOCKETCAN, byte by byte."""
    out = tmp_path / "t.pcap"
    assert mill("trace", "export", SPINDLE, "--pcap", str(out)) == 0
    log = read_trace(Path(SPINDLE))
    frames = [entry for entry in log.entries if entry.kind in ("in", "out")]
    content = out.read_bytes()
    assert content[:4] == bytes.fromhex("d4c3b2a1")  # little-endian, microseconds
    assert struct.unpack_from("<HH", content, 4) == (2, 4)
    assert struct.unpack_from("<II", content, 16) == (65_535, 227)
    offset = 24
    for entry in frames:
        seconds, us, kept, original = struct.unpack_from("<IIII", content, offset)
        packet = content[offset + 16 : offset + 16 + kept]
        assert kept == original == 16
        assert seconds + us / 1e6 == pytest.approx(log.began.timestamp() + entry.t_s, abs=2e-6)
        can_id, _, data = frame_of(entry.data)
        assert int.from_bytes(packet[:4], "big") == can_id
        assert (packet[4], packet[5]) == (len(data), 0)
        assert packet[8 : 8 + packet[4]] == data
        offset += 16 + kept
    assert offset == len(content)
