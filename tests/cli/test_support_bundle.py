"""`mill support-bundle`: everything that helps is in it, and nothing of who packs it."""

import getpass
import json
import os
import pwd
import shutil
import socket
import zipfile
from pathlib import Path

import pytest
from mill_command import mill
from pytest_mock import MockerFixture
from rig_file import GOOD
from serial.tools.list_ports_common import ListPortInfo

from drivers.errors import ConfigError
from drivers.trace_file import Trace, read_trace
from firmware_sim.clock import SimClock
from milling.record import RunRecorder, read_run

USER, FULL_NAME, HOST = "jörgensen", "Anna Jörgensen", "annas-laptop"
HOME = f"/home/{USER}"
OPERATOR = 'Dr. Q: "the" second'
PERSONAL = (USER, "J\\u00f6rgensen", "j\\u00f6rgensen", FULL_NAME, HOST, "/home/other", "s3cret", "Dr. Q")


@pytest.fixture
def place(tmp_path: Path, mocker: MockerFixture, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of somebody's, with personal data in every file of it."""
    entry = pwd.struct_passwd((USER, "x", os.getuid(), 0, f"{FULL_NAME},,,", HOME, "/bin/sh"))
    mocker.patch.object(pwd, "getpwuid", return_value=entry)
    mocker.patch.object(getpass, "getuser", return_value=USER)
    mocker.patch.object(socket, "gethostname", return_value=f"{HOST}.example.org")
    monkeypatch.setenv("HOME", HOME)
    monkeypatch.chdir(tmp_path)
    traits = f"{HOME}/work, {FULL_NAME} on {HOST.upper()}, /home/other/work, {USER}@example.org"
    named, foreign = ListPortInfo("/dev/mill-motion"), ListPortInfo("/dev/ttyUSB9")
    named.serial_number, foreign.serial_number = "A50285BI", "PHONE1234"
    mocker.patch("serial.tools.list_ports.comports", return_value=[named, foreign])
    rig = GOOD.replace('"/dev/mill-left"', f'"http://{USER}:s3cret@10.0.0.2/left"').replace("bench", f"rig of {USER}")
    Path("rig.toml").write_text(f"{rig}\n[study]\noperator = '{OPERATOR}'\n# {traits}\n")
    Path("certificates").mkdir()
    inner = json.dumps({"rig": traits})
    Path("certificates/rig.json").write_text(json.dumps({"certificate": inner}))
    Path("certificates/rig.html").write_text(f"<p>{traits}</p>")
    header = {"specimen": traits, "study": {"protocol": "P-7", "operator": OPERATOR}}
    with RunRecorder(Path("runs/one"), header, SimClock()) as recorder:
        recorder.event("state", state="start")
        recorder.event("error", words=traits)
        recorder.close({"outcome": "held", "reason": traits})
    Path("runs/one/frames/00001-left.jpg").write_bytes(b"picture")
    Path("runs/one/report.html").write_text("picture")
    about = {"rig": traits, "study": {"operator": OPERATOR}}
    with Trace(Path("one.jsonl"), SimClock(), about) as trace:
        trace.note(trace.mark(), "motion", "in", traits)
        trace.event("lap", lap=1)
    Path("traces").mkdir()
    # Torn, as a kill leaves it.
    Path("traces/torn.jsonl").write_bytes(Path("one.jsonl").read_bytes()[:-4])
    Path("other.jsonl").write_text(traits)
    return tmp_path


def contents(file: Path) -> dict[str, str]:
    with zipfile.ZipFile(file) as bundle:
        return {name: bundle.read(name).decode() for name in bundle.namelist()}


def test_what_helps_is_in_it(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("support-bundle", "--rig", "rig.toml", "--out", "b.zip") == 0
    found = contents(place / "b.zip")
    assert set(found) == {
        "versions.json",
        "rig.toml",
        "devices.json",
        "certificate/rig.json",
        "certificate/rig.html",
        "run/header.json",
        "run/events.jsonl",
        "run/result.json",
        "traces/one.jsonl",
        "traces/torn.jsonl",
    }
    said = capsys.readouterr().out
    assert all(name in said for name in found)
    assert "out  pictures" in said
    assert "kernel" in json.loads(found["versions.json"])["system"]
    assert 'port = "/dev/mill-motion"' in found["rig.toml"]


def test_nothing_tells_who_packs_it(place: Path) -> None:
    assert mill("support-bundle", "--rig", "rig.toml", "--out", "b.zip") == 0
    for name, text in contents(place / "b.zip").items():
        for word in PERSONAL:
            assert word.lower() not in text.lower(), (name, word)
    devices = {row["path"]: row["serial_number"] for row in json.loads(contents(place / "b.zip")["devices.json"])}
    assert devices == {"/dev/mill-motion": "A50285BI", "/dev/ttyUSB9": None, "http://10.0.0.2/left": None}


def test_records_and_traces_can_still_be_read(place: Path) -> None:
    assert mill("support-bundle", "--rig", "rig.toml", "--out", "b.zip") == 0
    shutil.unpack_archive(place / "b.zip", place / "unpacked")
    run = read_run(place / "unpacked" / "run")
    assert [event["kind"] for event in run.events] == ["state", "error"]
    assert run.events[1]["words"].startswith("~/work, USER on HOST, ~/work")
    assert run.header["study"] == {"protocol": "P-7", "operator": "OPERATOR"}
    assert run.result is not None
    assert run.damage is None
    assert read_trace(place / "unpacked" / "traces" / "one.jsonl").damage is None
    assert read_trace(place / "unpacked" / "traces" / "torn.jsonl").damage is not None


@pytest.mark.parametrize(("end", "kinds"), [(-9, ["state"]), (9, None)])
def test_a_torn_record_stays_torn_and_a_changed_one_damaged(place: Path, end: int, kinds: list[str] | None) -> None:
    events = place / "runs/one/events.jsonl"
    text = events.read_bytes()
    events.write_bytes(text[:end] if end < 0 else text[:end] + b"?" + text[end + 1 :])
    (place / "runs/one/result.json").unlink()
    assert mill("support-bundle", "--out", "b.zip") == 0
    shutil.unpack_archive(place / "b.zip", place / "unpacked")
    if kinds is None:
        with pytest.raises(ConfigError, match=r"events\.jsonl line 1"):
            read_run(place / "unpacked" / "run")
    else:
        run = read_run(place / "unpacked" / "run")
        assert ([event["kind"] for event in run.events], "torn" in (run.damage or "")) == (kinds, True)


def test_an_empty_folder_gives_a_bundle_that_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert mill("support-bundle") == 0
    said = capsys.readouterr().out
    for word in ("rig file: none named", "certificates/", "runs/", "traces/"):
        assert word in said
    assert len(list(tmp_path.glob("support-*.zip"))) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "taken.zip"], "exists already"),
        (["--out", "no/such/b.zip"], "cannot be written"),
        (["--rig", "none.toml"], "cannot be read"),
    ],
)
def test_wrong_input_is_one_line(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken.zip").touch()
    assert mill("support-bundle", *words) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
