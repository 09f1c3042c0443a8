"""Runs in viewers that people already have: read back with their own libraries, and held against the record."""

import json
import shutil
import struct
import subprocess
import sys
from collections import Counter
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from a_record import AXIS_MM, DATE, N, a_record, begin, go_on, ring
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mill_command import mill
from processes import started
from websockets.sync.client import ClientConnection, connect

from cli.viewers.telling import Telling, color_of
from cli.viewers.viewer import FIGURES, FRAME
from firmware_sim.clock import SimClock
from milling.record import Run, read_run
from milling.tail import Tail

BEGAN_NS = round(datetime.fromisoformat(DATE).timestamp()) * 1_000_000_000
STANDARD = {
    "/eyes/left": "foxglove.CompressedImage",
    "/eyes/right": "foxglove.CompressedImage",
    "/eyes/left/marks": "foxglove.ImageAnnotations",
    "/eyes/right/marks": "foxglove.ImageAnnotations",
    "/drill/tip": "foxglove.PoseInFrame",
    "/skull/surface": "foxglove.PointCloud",
    "/window": "foxglove.SceneUpdate",
    "/log": "foxglove.Log",
}


class Read:
    """What an MCAP file holds: per topic its schema's name, and messages with their times from the run's beginning."""

    def __init__(self, path: Path) -> None:
        self.schemas: dict[str, str] = {}
        self.definitions: dict[str, Any] = {}
        self.messages: dict[str, list[tuple[float, Any]]] = {}
        self.times: list[int] = []
        with path.open("rb") as file:
            decoders = DecoderFactory()
            reader = make_reader(file)
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                assert schema is not None
                decode = decoders.decoder_for(channel.message_encoding, schema) or json.loads
                told = decode(message.data)
                self.schemas[channel.topic] = schema.name
                if schema.encoding == "jsonschema":
                    self.definitions[channel.topic] = json.loads(schema.data)
                self.times.append(message.log_time)
                at_s = (message.log_time - BEGAN_NS) / 1e9
                self.messages.setdefault(channel.topic, []).append((at_s, told))
            self.metadata = {each.name: each.metadata for each in reader.iter_metadata()}

    def of(self, topic: str) -> list[Any]:
        return [told for _, told in self.messages[topic]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(a_record(tmp_path_factory.mktemp("runs") / "one"))


@pytest.fixture(scope="module")
def read(run: Run) -> Read:
    out = run.folder.parent / "one.mcap"
    assert mill("runs", "export", str(run.folder), "--mcap", str(out)) == 0
    return Read(out)


def test_an_mcap_file_has_foxgloves_own_schemas_and_json_for_figures(read: Read) -> None:
    assert {topic: name for topic, name in read.schemas.items() if topic in STANDARD} == STANDARD
    figures = {topic: name for topic, name in read.schemas.items() if topic not in STANDARD}
    assert figures == {f"/{topic}": f"mill.{topic}" for topic in FIGURES}
    for topic, definition in read.definitions.items():
        for told in read.of(topic):
            assert set(told) == set(definition["properties"]) == {"t_s", *FIGURES[topic[1:]]}


def test_it_holds_every_event_of_the_record_once_on_one_clock(run: Run, read: Read) -> None:
    kinds = Counter(event["kind"] for event in run.events)
    frames = Counter("right" if event["name"].endswith("right") else "left" for event in run.of_kind("frame"))
    assert len(read.of("/eyes/left")) == frames["left"] == 3
    assert len(read.of("/eyes/right")) == frames["right"] == 3
    assert len(read.of("/drill/tip")) == len(read.of("/spindle")) == kinds["load"]
    assert len(read.of("/contact")) == kinds["contact"]
    assert len(read.of("/completion")) == kinds["reading"]
    assert len(read.of("/permission")) == kinds["asked"]
    assert len(read.of("/depth")) == kinds["cut"] + kinds["lap"] + kinds["outcome"]
    assert read.times == sorted(read.times)
    for topic, kind in (("/spindle", "load"), ("/contact", "contact"), ("/permission", "asked")):
        at_s = [event["t"] for event in run.of_kind(kind)]
        assert [t for t, _ in read.messages[topic]] == pytest.approx(at_s, abs=1e-6)
        assert [told["t_s"] for told in read.of(topic)] == at_s
    assert json.loads(read.metadata["run"]["rig"]) == "bench"


def test_pictures_are_the_records_own_bytes_with_the_ring_drawn_in(run: Run, read: Read) -> None:
    files = [event["file"] for event in run.of_kind("frame") if event["name"].endswith("left")]
    for told, file in zip(read.of("/eyes/left"), files, strict=True):
        assert told.data == (run.folder / file).read_bytes()
        assert (told.format, told.frame_id) == ("jpeg", "eye_left")
    stamps = [told.timestamp.seconds * 10**9 + told.timestamp.nanos for told in read.of("/eyes/left")]
    assert all(after > before >= BEGAN_NS for before, after in pairwise(stamps))
    marks = read.of("/eyes/left/marks")[-1]
    drawn = next(run.of_kind("ring"))["ring_px"]
    assert [(point.x, point.y) for point in marks.points[0].points] == [tuple(place) for place in drawn]
    for eye, across_px in (("left", 400.0), ("right", 390.0)):
        texts = read.of(f"/eyes/{eye}/marks")[-1].texts
        assert [text.text for text in texts] == ["bregma", "lambda"]
        assert texts[0].position.x == across_px
    known, unknown = marks.points[0].outline_colors[0], marks.points[0].outline_colors[-1]
    assert [round(255 * value) for value in (known.r, known.g, known.b)] == list(color_of(0.2))
    assert [round(255 * value) for value in (unknown.r, unknown.g, unknown.b)] == list(color_of(None))


def test_places_are_in_millimetres_of_the_robot(run: Run, read: Read) -> None:
    cloud = read.of("/skull/surface")[0]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
    assert [(field.name, field.offset) for field in cloud.fields] == [("x", 0), ("y", 4), ("z", 8)]
    assert len(points) == 11, "where the surface is not known there is no point"
    assert points[0].tolist() == [3.0, -12.0, 2.5]
    tip = read.of("/drill/tip")[-1]
    assert tip.frame_id == cloud.frame_id == FRAME
    position, turn = tip.pose.position, tip.pose.orientation
    assert [position.x, position.y, position.z] == ring(2.4)[N - 1]
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    up_the_shank = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    assert up_the_shank == pytest.approx([value / 0.5 for value in AXIS_MM])
    cut = [entity for told in read.of("/window") for entity in told.entities if entity.id == "depth"][-1]
    assert [point.z for point in cut.lines[0].points] == pytest.approx([2.5 - 0.1] * N)
    assert {entity.id for told in read.of("/window") for entity in told.entities} == {"approach", "contact", "depth"}


def test_reasons_and_faults_are_lines_of_the_log(read: Read) -> None:
    lines = [(told.level, told.name, told.message) for told in read.of("/log")]
    info, warning, error = 2, 3, 4
    assert (info, f"point {N}", "no deeper: no fresh frame") in lines
    assert lines.count((info, f"point {N}", "no deeper: no fresh frame")) == 1, "told when it changes"
    assert (error, "HOLD", "a person said stop") in lines
    assert (warning, "held", "a person said stop") in lines
    assert (info, "verify", "one setpoint") in lines
    assert [told["deeper"] for told in read.of("/permission")][:N] == [True] * (N - 1) + [False]


@pytest.fixture
def copy(run: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run.folder, tmp_path / "copy"))


def test_a_missing_picture_is_told_and_the_rest_is_there(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    next((copy / "frames").glob("*reference_left.jpg")).unlink()
    assert mill("runs", "export", str(copy), "--mcap", str(copy / "x.mcap")) == 0
    assert "1 pictures of the record are missing" in capsys.readouterr().err
    assert len(Read(copy / "x.mcap").of("/eyes/left")) == 2


def test_a_record_names_no_file_outside_its_folder(copy: Path, tmp_path: Path) -> None:
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    seen: list[bytes] = []

    class Viewer:
        def picture(self, t_s: float, eye: str, jpeg: bytes) -> None:
            seen.append(jpeg)

    telling = Telling(copy, {}, Viewer())  # type: ignore[arg-type]
    for file in ("../secret.jpg", "frames/../../secret.jpg", str(tmp_path / "secret.jpg"), "header.json"):
        telling.take({"t": 0.0, "kind": "frame", "name": "left", "file": file})
    assert (seen, telling.missing) == ([], 4)


def test_a_torn_last_line_is_told_and_a_damaged_one_refused(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    events, out = copy / "events.jsonl", copy / "x.mcap"
    whole = events.read_bytes()
    events.write_bytes(whole[:-5])
    assert mill("runs", "export", str(copy), "--mcap", str(out)) == 0
    assert "torn" in capsys.readouterr().err
    before = out.read_bytes()
    events.write_bytes(whole.replace(b'"rpm":50000.0', b'"rpm":50001.0', 1))
    assert mill("runs", "export", str(copy), "--mcap", str(out)) == 2
    assert "does not follow from" in capsys.readouterr().err
    assert out.read_bytes() == before, "the file from before is kept"
    assert not list(copy.glob("*.part")) + list(copy.glob(".*.part"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["one"], "nothing to write: give --csv FILE"),
        (["one", "--mcap", "nowhere/x.mcap"], "nowhere is no folder"),
        (["none", "--mcap", "x.mcap"], "no such run"),
        (["--mcap", "x.mcap"], "0 runs for --mcap or --rerun, which take one"),
    ],
)
def test_wrong_words_write_nothing(
    run: Run,
    words: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert mill("runs", "export", *words, "--runs", str(run.folder.parent)) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named(
    run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert mill("runs", "export", str(run.folder), "--mcap", "x.mcap") == 2
    assert "pip install 'micromill[foxglove]'" in capsys.readouterr().err


LONG = """
import resource, sys
from pathlib import Path
from cli.main import mill
from firmware_sim.clock import SimClock
from milling.record import RunRecorder
where, flag = Path(sys.argv[1]), sys.argv[2]
picture = bytes(range(256)) * 4096
def export(name, pictures):
    clock = SimClock()
    with RunRecorder(where / name, {}, clock) as record:
        (where / name / "frames/00001-left.jpg").write_bytes(picture)
        for _ in range(pictures):
            clock.sleep_s(2.0)
            record.event("frame", name="left", file="frames/00001-left.jpg")
    mill.main(["runs", "export", str(where / name), flag, str(where / "out")], standalone_mode=False)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
few = export("few", 30)
print(export("many", 150) - few)
"""


@pytest.mark.parametrize("flag", ["--mcap", pytest.param("--rerun", marks=pytest.mark.long)])
def test_a_long_record_takes_no_more_memory(tmp_path: Path, flag: str) -> None:
    """Of 120 MiB of pictures more, less than a third is ever in memory at once."""
    if flag == "--rerun":
        pytest.importorskip("rerun", reason="micromill[rerun] is not installed")
    done = subprocess.run(
        [sys.executable, "-c", LONG, str(tmp_path), flag], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.splitlines()[-1]) < 40


# While a run goes on.


def test_a_growing_record_is_read_line_by_line(tmp_path: Path) -> None:
    clock = SimClock()
    recorder = begin(tmp_path / "run", clock)
    with Tail(tmp_path / "run") as tail:
        first = list(tail.news())
        assert [event["kind"] for event in first][:2] == ["state", "stage"]
        assert list(tail.news()) == []
        path = tmp_path / "run/events.jsonl"
        before = path.stat().st_size
        recorder.event("idle", torque=0.1, sigma=0.01)
        line = path.read_bytes()[before:]
        with path.open("r+b") as file:
            file.truncate(before + 7)
        assert list(tail.news()) == []
        assert tail.damage is not None
        with path.open("ab") as file:
            file.write(line[7:])
        assert [event["kind"] for event in tail.news()] == ["idle"]
        assert tail.damage is None
    recorder.close()


def test_a_run_that_goes_on_is_followed_in_foxglove(tmp_path: Path) -> None:
    clock, folder = SimClock(), tmp_path / "run"
    recorder = begin(folder, clock)
    with started("runs", "follow", str(folder), "--in", "foxglove") as command:
        assert command.comes_to("in Foxglove: ", 60.0)
        address = command.out.split()[-1]
        assert _listens_only_here(int(address.rpartition(":")[2]))
        with connect(address, subprotocols=["foxglove.sdk.v1"], proxy=None, max_size=None) as viewer:  # type: ignore[list-item]
            hello = _words(viewer, "serverInfo")
            assert hello["capabilities"] == [], "a viewer can tell the run nothing"
            topics = {each["topic"]: each for each in _words(viewer, "advertise")["channels"]}
            assert topics["/window"]["schemaName"] == "foxglove.SceneUpdate"
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": [
                {"id": 1, "channelId": topics["/eyes/left"]["id"]}, {"id": 2, "channelId": topics["/spindle"]["id"]},
            ]}))  # fmt: skip
            picture = next((folder / "frames").glob("*reference_left.jpg")).read_bytes()
            assert picture in _message(viewer, 1), "who comes late sees the newest picture"
            go_on(recorder, clock)
            assert json.loads(_message(viewer, 2))["torque_share"] == 0.2
        assert command.comes_to("the run is over: held", 60.0)
        command.process.send_signal(2)
        assert command.end(30.0) == 0, command.said


def test_a_run_that_is_over_is_exported_and_not_followed(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("runs", "follow", str(run.folder), "--in", "foxglove") == 2
    assert f"mill runs export {run.folder} --mcap FILE" in capsys.readouterr().err


def _words(viewer: ClientConnection, op: str) -> dict[str, Any]:
    while True:
        told = viewer.recv(30.0)
        if isinstance(told, str) and (words := json.loads(told))["op"] == op:
            return dict(words)


def _message(viewer: ClientConnection, subscription: int) -> bytes:
    """The next message of a subscription: opcode 1, its number, the time in ns, and what is told."""
    while True:
        told = viewer.recv(30.0)
        if isinstance(told, bytes) and told[0] == 1:
            number, _ = struct.unpack_from("<IQ", told, 1)
            if number == subscription:
                return told[13:]


def _listens_only_here(port: int) -> bool:
    """Whether the one socket that listens on this port does so on 127.0.0.1."""
    rows = [
        line.split() for file in ("/proc/net/tcp", "/proc/net/tcp6") for line in Path(file).read_text().splitlines()[1:]
    ]
    listening = [row[1].split(":")[0] for row in rows if row[3] == "0A" and int(row[1].split(":")[1], 16) == port]
    return listening == ["0100007F"]


# Rerun.


def test_a_rerun_recording_holds_the_same(run: Run) -> None:
    pytest.importorskip("rerun", reason="micromill[rerun] is not installed")
    from rerun.chunk import RrdReader

    out = run.folder.parent / "one.rrd"
    assert mill("runs", "export", str(run.folder), "--rerun", str(out)) == 0
    rows: Counter[str] = Counter()
    lines: set[str] = set()
    values: dict[str, list[tuple[float, Any]]] = {}
    for chunk in RrdReader(out).stream():
        rows[chunk.entity_path] += chunk.num_rows
        lines |= set(chunk.timeline_names)
        batch = chunk.to_record_batch()
        for name in ("Scalars:scalars", "TextLog:text", "EncodedImage:blob"):
            if name in batch.schema.names:
                at_s = [time.value / 1e9 for time in batch.column("run")]
                values.setdefault(chunk.entity_path, []).extend(zip(at_s, batch.column(name).to_pylist(), strict=True))
    assert lines == {"run"}, "one clock"
    kinds = Counter(event["kind"] for event in run.events)
    assert rows["/eyes/left"] == rows["/eyes/right"] == 3
    assert rows[f"/{FRAME}/drill/tip"] == rows["/figures/spindle/torque_share"] == kinds["load"]
    assert rows["/figures/contact/height_mm"] == kinds["contact"]
    torque = values["/figures/spindle/torque_share"]
    assert [t for t, _ in torque] == pytest.approx([event["t"] for event in run.of_kind("load")])
    assert {value for _, scalars in torque for value in scalars} == {0.2}
    last = values["/figures/completion/completion"][-1][1]
    assert last[:-1] == pytest.approx([0.2] * (N - 1))
    assert np.isnan(last[-1])
    first = next(run.of_kind("frame"))["file"]
    assert bytes(values["/eyes/left"][0][1][0]) == (run.folder / first).read_bytes()
    assert f"point {N}: no deeper: no fresh frame" in [text[0] for _, text in values["/log"]]


def test_a_run_is_served_to_rerun_on_this_computer_only(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="micromill[rerun] is not installed")
    begin(tmp_path / "run", SimClock()).close()
    with started("runs", "follow", str(tmp_path / "run"), "--in", "rerun") as command:
        assert command.comes_to("rerun --connect rerun+http://127.0.0.1:", 60.0)
        assert _listens_only_here(int(command.out.split("127.0.0.1:")[1].split("/")[0]))
        command.process.send_signal(2)
        assert command.end(30.0) == 0, command.said
