"""The record: what a kill, a torn line or a full disk leave is readable and named."""

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from pytest_mock import MockerFixture

from drivers.errors import ConfigError
from firmware_sim.clock import SimClock
from milling.record import RunRecorder, read_run

BLACK = np.zeros((8, 8, 3), np.uint8)


def record(folder: Path, clock: SimClock | None = None) -> RunRecorder:
    return RunRecorder(folder, {"seed": 7}, clock or SimClock())


def test_what_is_written_is_read(tmp_path: Path) -> None:
    clock = SimClock(100.0)
    with record(tmp_path / "run", clock) as recorder:
        recorder.event("state", state="start")
        clock.sleep_s(1.5)
        recorder.event(
            "lap", depth_mm=np.array([0.1, 0.2]), upper=None, done=np.bool_(True), n=np.int64(3), bad=float("nan")
        )
        recorder.close({"outcome": "complete"})
    run = read_run(tmp_path / "run")
    assert run.header == {"schema": 1, "seed": 7}
    assert run.events[0] == {"t": 0.0, "kind": "state", "state": "start"}
    assert run.events[1] == {
        "t": 1.5,
        "kind": "lap",
        "depth_mm": [0.1, 0.2],
        "upper": None,
        "done": True,
        "n": 3,
        "bad": None,
    }
    assert run.chain is not None
    assert run.result == {"outcome": "complete", "chain": {"lines": 2, "head": run.chain.head}}
    assert run.damage is None


def test_every_event_is_one_write_and_state_changes_are_synced(tmp_path: Path, mocker: MockerFixture) -> None:
    recorder = record(tmp_path / "run")
    write = mocker.spy(os, "write")
    sync = mocker.spy(os, "fdatasync")
    recorder.event("lap", lap=1)
    assert (write.call_count, sync.call_count) == (1, 0)
    recorder.event("stopped", point=1)
    assert (write.call_count, sync.call_count) == (2, 1)
    recorder.close()


@pytest.mark.parametrize("cut", [1, 5, 12, 30])
def test_a_torn_last_line_is_dropped_and_named(tmp_path: Path, cut: int) -> None:
    with record(tmp_path / "run") as recorder:
        for number in range(5):
            recorder.event("lap", lap=number, text="something long enough to tear")
    path = tmp_path / "run" / "events.jsonl"
    path.write_bytes(path.read_bytes()[:-cut])
    run = read_run(tmp_path / "run")
    whole = 5 if cut == 1 else 4
    assert len(run.events) == whole
    assert (run.damage is None) == (cut == 1)


def test_damage_in_the_middle_is_refused_with_its_line(tmp_path: Path) -> None:
    with record(tmp_path / "run") as recorder:
        for number in range(3):
            recorder.event("lap", lap=number)
    path = tmp_path / "run" / "events.jsonl"
    path.write_bytes(path.read_bytes().replace(b'"lap":1', b'"lap":7'))
    with pytest.raises(ConfigError, match=r"events\.jsonl line 2: does not follow from line 1"):
        read_run(tmp_path / "run")


def test_a_folder_is_used_once_and_no_run_is_no_run(tmp_path: Path) -> None:
    record(tmp_path / "run").close()
    with pytest.raises(ConfigError, match="holds a run already"):
        record(tmp_path / "run")
    with pytest.raises(ConfigError, match="no run here"):
        read_run(tmp_path)


def test_pictures_are_rate_limited_by_name(tmp_path: Path) -> None:
    clock = SimClock()
    with record(tmp_path / "run", clock) as recorder:
        for _ in range(10):
            recorder.frame("left", BLACK)
            recorder.frame("look", BLACK)
            clock.sleep_s(0.5)
    names = [event["name"] for event in read_run(tmp_path / "run").of_kind("frame")]
    assert names.count("left") == names.count("look") == 3


def test_a_full_disk_costs_pictures_first_and_says_so(tmp_path: Path, mocker: MockerFixture) -> None:
    lost: list[str] = []
    recorder = RunRecorder(tmp_path / "run", {}, SimClock(), frame_period_s=0.0, on_loss=lost.append)
    mocker.patch.object(Path, "write_bytes", side_effect=OSError(errno.ENOSPC, "No space left on device"))
    recorder.frame("left", BLACK)
    recorder.frame("left", BLACK)
    recorder.event("lap", lap=1)
    recorder.close()
    assert len(lost) == 1
    assert "No space left" in lost[0]
    assert [event["kind"] for event in read_run(tmp_path / "run").events] == ["lap"]


def test_a_full_disk_is_an_error_once_and_the_record_stays_readable(tmp_path: Path, mocker: MockerFixture) -> None:
    """Once: what makes the machine safe afterwards tells of it as well, and must not be held up."""
    recorder = record(tmp_path / "run")
    recorder.event("lap", lap=1)
    write = mocker.patch("milling.record.os.write", side_effect=OSError(errno.ENOSPC, "No space left on device"))
    with pytest.raises(OSError, match=r"events\.jsonl"):
        recorder.event("lap", lap=2)
    recorder.event("lap", lap=3)
    assert write.call_count == 1
    recorder.close()
    assert [event["lap"] for event in read_run(tmp_path / "run").events] == [1]


@pytest.mark.parametrize("name", ["header.json", "result.json"])
def test_a_damaged_file_of_the_record_is_named(name: str, tmp_path: Path) -> None:
    with record(tmp_path / "run") as recorder:
        recorder.close({"outcome": "held"})
    (tmp_path / "run" / name).write_text("{")
    with pytest.raises(ConfigError, match=name):
        read_run(tmp_path / "run")


def test_after_close_nothing_is_written_and_closing_twice_is_fine(tmp_path: Path) -> None:
    recorder = record(tmp_path / "run")
    recorder.close()
    recorder.close()
    recorder.event("lap", lap=1)
    recorder.frame("left", BLACK)
    assert read_run(tmp_path / "run").events == []


def test_files_are_replaced_whole(tmp_path: Path) -> None:
    with record(tmp_path / "run") as recorder:
        recorder.close({"outcome": "held"})
    assert json.loads((tmp_path / "run" / "result.json").read_text())["outcome"] == "held"
    assert not list((tmp_path / "run").glob("*.tmp"))
