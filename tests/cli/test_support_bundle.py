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

from drivers.trace_file import Trace, read_trace
from firmware_sim.clock import SimClock
from milling.record import RunRecorder, read_run

USER, FULL_NAME, HOST = "jörgensen", "Anna Jörgensen", "annas-laptop"
HOME = f"/home/{USER}"
PERSONAL = (USER, "J\\u00f6rgensen", "j\\u00f6rgensen", FULL_NAME, HOST, "/home/other", "s3cret")


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
    Path("rig.toml").write_text(f"{rig}\n# {traits}\n")
    Path("certificates").mkdir()
    inner = json.dumps({"rig": traits})
    Path("certificates/rig.json").write_text(json.dumps({"certificate": inner}))
    Path("certificates/rig.html").write_text(f"<p>{traits}</p>")
    with RunRecorder(Path("runs/one"), {"specimen": traits}, SimClock()) as recorder:
        recorder.event("state", state="start")
        recorder.event("error", words=traits)
        recorder.close({"outcome": "held", "reason": traits})
    Path("runs/one/frames/00001-left.jpg").write_bytes(b"picture")
    Path("runs/one/report.html").write_text("picture")
    with Trace(Path("one.jsonl"), SimClock(), {"rig": traits}) as trace:
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
    assert read_trace(place / "unpacked" / "traces" / "one.jsonl").damage is None
    assert read_trace(place / "unpacked" / "traces" / "torn.jsonl").damage is not None


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
