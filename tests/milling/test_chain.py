"""The chain of a record: whatever is changed in it is told, by its line; what was written before it opens."""

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pytest_mock import MockerFixture

from drivers.checked_lines import LineWriter, checked, link, read_lines
from drivers.errors import ConfigError
from firmware_sim.clock import SimClock
from milling.record import RunRecorder, beginning, read_run

N = 7
REAL_WRITE = os.write


def write(folder: Path, *, result: bool = True) -> Path:
    with RunRecorder(folder, {"study": {"specimen_id": "M12"}}, SimClock()) as recorder:
        for number in range(N):
            recorder.event("lap", lap=number, depth_mm=[0.1 * number] * 3)
        recorder.close({"outcome": "complete"} if result else None)
    return folder


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("chain") / "run")


def lines_of(folder: Path) -> list[bytes]:
    return (folder / "events.jsonl").read_bytes().split(b"\n")[:-1]


def reads(folder: Path, lines: list[bytes]) -> Any:
    (folder / "events.jsonl").write_bytes(b"".join(line + b"\n" for line in lines))
    return read_run(folder)


def test_the_links_are_what_the_documentation_says(written: Path) -> None:
    before = hashlib.sha256(b" " + (written / "header.json").read_bytes()).hexdigest()[:32]
    for line in lines_of(written):
        check, _, body = line.partition(b" ")
        before = hashlib.sha256(before.encode() + b" " + body).hexdigest()[:32]
        assert check.decode() == before
    assert json.loads((written / "result.json").read_text())["chain"] == {"lines": N, "head": before}


@settings(deadline=None)
@given(data=st.data())
def test_any_change_of_the_bytes_is_told(written: Path, data: st.DataObject) -> None:
    """Bytes changed, put in, taken out, doubled, moved or cut off: refused, naming a line not after the change."""
    file = written / "events.jsonl"
    text = file.read_bytes()
    at = data.draw(st.integers(0, len(text) - 1))
    end = data.draw(st.integers(at, len(text)))
    put = data.draw(st.one_of(st.binary(max_size=3), st.just(text[at:end] * 2), st.just(text[:at][-40:])))
    changed = text[:at] + put + text[end:]
    try:
        file.write_bytes(changed)
        if changed in (text, text[:-1]):
            assert len(read_run(written).events) == N
            return
        with pytest.raises(ConfigError, match=r"events\.jsonl line \d+: ") as told:
            read_run(written)
        number = int(str(told.value).partition(" line ")[2].partition(":")[0])
        # The line of the first byte that differs; the one after it, where a whole line was taken out before that.
        first = next((k for k, (a, b) in enumerate(zip(text, changed, strict=False)) if a != b), len(changed))
        assert number <= text[:first].count(b"\n") + 1
    finally:
        file.write_bytes(text)


@settings(deadline=None)
@given(order=st.lists(st.integers(0, N - 1), max_size=N + 2))
def test_any_other_choice_or_order_of_its_lines_is_told(written: Path, order: list[int]) -> None:
    lines = lines_of(written)
    try:
        if order == list(range(N)):
            assert reads(written, lines).damage is None
            return
        with pytest.raises(ConfigError, match=r"events\.jsonl line"):
            reads(written, [lines[index] for index in order])
    finally:
        reads(written, lines)


@settings(deadline=None)
@given(index=st.integers(0, N - 1), depth=st.floats(0.0, 1.0))
def test_a_line_with_a_link_of_its_own_is_told_by_the_next_or_by_the_end(
    written: Path, index: int, depth: float
) -> None:
    """Somebody who knows how links are made, and changes one line."""
    lines = lines_of(written)
    body = json.dumps({"t": 0.0, "kind": "lap", "depth_mm": [depth]}).encode()
    before = beginning((written / "header.json").read_bytes()) if index == 0 else lines[index - 1][:32].decode()
    forged = link(before, body).encode() + b" " + body
    try:
        with pytest.raises(ConfigError, match=rf"events\.jsonl line {min(index + 2, N)}: "):
            reads(written, [*lines[:index], forged, *lines[index + 1 :]])
    finally:
        reads(written, lines)


def test_who_makes_all_that_follows_anew_is_not_told_and_has_another_head(tmp_path: Path) -> None:
    """What a chain cannot do: only a head that was noted elsewhere tells this."""
    folder = write(tmp_path / "run")
    head = read_run(folder).chain
    (folder / "events.jsonl").unlink()
    (folder / "result.json").unlink()
    lines = LineWriter(folder / "events.jsonl", follows=beginning((folder / "header.json").read_bytes()))
    lines.append({"t": 0.0, "kind": "lap", "lap": 99})
    lines.close()
    forged = read_run(folder)
    assert forged.events[0]["lap"] == 99
    assert forged.chain != head


def test_a_changed_header_is_told(tmp_path: Path) -> None:
    folder = write(tmp_path / "run")
    header = folder / "header.json"
    header.write_text(header.read_text().replace("M12", "M13"))
    with pytest.raises(ConfigError, match=r"events\.jsonl line 1: does not follow from the header"):
        read_run(folder)


def test_lines_without_their_chain_do_not_agree_with_the_result(tmp_path: Path) -> None:
    folder = write(tmp_path / "run")
    with pytest.raises(ConfigError, match="not the end that result"):
        reads(folder, [checked(line.partition(b" ")[2])[:-1] for line in lines_of(folder)])


@pytest.mark.parametrize("spoil", [lambda lines: [lines[0], lines[2]], lambda lines: [*lines[:2], b"", *lines[2:]]])
def test_a_chain_without_result_still_tells_its_middle(
    tmp_path: Path, spoil: Callable[[list[bytes]], list[bytes]]
) -> None:
    folder = write(tmp_path / "run", result=False)
    with pytest.raises(ConfigError, match=r"line (2|3): does not follow from line"):
        reads(folder, spoil(lines_of(folder)))


def test_records_written_before_still_open(tmp_path: Path) -> None:
    folder = write(tmp_path / "run", result=False)
    run = reads(folder, [checked(line.partition(b" ")[2])[:-1] for line in lines_of(folder)])
    assert (len(run.events), run.damage, run.chain) == (N, None, None)


@pytest.mark.parametrize("written_first", [True, False])
def test_ctrl_c_between_a_line_and_its_note_breaks_no_chain(
    tmp_path: Path, mocker: MockerFixture, written_first: bool
) -> None:
    """A second Ctrl-C interrupts anywhere; what makes the machine safe goes on telling events."""

    def interrupted(file: int, line: bytes) -> int:
        if written_first:
            REAL_WRITE(file, line)
        raise KeyboardInterrupt

    with RunRecorder(tmp_path / "run", {}, SimClock()) as recorder:
        recorder.event("lap", lap=1)
        mocker.patch("drivers.checked_lines.os.write", side_effect=interrupted)
        with pytest.raises(KeyboardInterrupt):
            recorder.event("lap", lap=2)
        mocker.stopall()
        recorder.event("lap", lap=3)
        recorder.close({"outcome": "aborted"})
    laps = [event["lap"] for event in read_run(tmp_path / "run").events]
    assert laps == ([1, 2, 3] if written_first else [1, 3])


def test_an_interrupted_last_line_is_the_end_that_the_result_tells(tmp_path: Path, mocker: MockerFixture) -> None:
    def interrupted(file: int, line: bytes) -> int:
        REAL_WRITE(file, line)
        raise KeyboardInterrupt

    recorder = RunRecorder(tmp_path / "run", {}, SimClock())
    mocker.patch("drivers.checked_lines.os.write", side_effect=interrupted)
    with pytest.raises(KeyboardInterrupt):
        recorder.event("lap", lap=1)
    mocker.stopall()
    recorder.close({"outcome": "aborted"})
    assert len(read_run(tmp_path / "run").events) == 1


def test_a_disk_that_takes_half_a_line_leaves_a_record_that_agrees_with_its_result(
    tmp_path: Path, mocker: MockerFixture
) -> None:
    with RunRecorder(tmp_path / "run", {}, SimClock()) as recorder:
        recorder.event("lap", lap=1)
        mocker.patch("drivers.checked_lines.os.write", side_effect=lambda file, line: REAL_WRITE(file, line[:40]))
        with pytest.raises(OSError, match="No space left") as full:
            recorder.event("lap", lap=2)
        mocker.stopall()
        recorder.close({"outcome": "aborted"})
    assert full.value.errno == errno.ENOSPC
    run = read_run(tmp_path / "run")
    assert ([event["lap"] for event in run.events], "line 2: torn" in (run.damage or "")) == ([1], True)


def test_sigkill_costs_one_event_at_most(tmp_path: Path) -> None:
    """A process that writes as fast as it can, and says after each event that it is written."""
    program = (
        "import os, sys; from pathlib import Path; from drivers.clock import SystemClock\n"
        "from milling.record import RunRecorder\n"
        "recorder = RunRecorder(Path(sys.argv[1]), {}, SystemClock())\n"
        "number = 0\n"
        "while True:\n"
        "    number += 1; recorder.event('lap', lap=number); os.write(1, b'%d\\n' % number)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path / "run")], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        for _ in range(500):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        said = [line for line in process.stdout.read().split(b"\n") if line]
    run = read_run(tmp_path / "run")
    told = int(said[-1]) if said else 500
    assert told <= len(run.events) <= told + 1
    assert run.chain is not None


def test_a_branch_goes_on_with_the_chain_in_its_copy(tmp_path: Path) -> None:
    lines = LineWriter(tmp_path / "trunk", follows="")
    lines.append({"n": 1})
    shutil.copy(tmp_path / "trunk", tmp_path / "branch")
    lines.go_on_in(tmp_path / "branch")
    lines.append({"n": 2})
    lines.close()
    assert read_lines(tmp_path / "branch").records == [{"n": 1}, {"n": 2}]
    assert read_lines(tmp_path / "branch").chain == lines.chain


def test_pictures_and_other_files_are_bound_to_the_record(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with RunRecorder(folder, {}, SimClock()) as recorder:
        recorder.frame("left", np.zeros((8, 8, 3), np.uint8))
        (folder / "calibration.toml").write_text("x = 1")
        recorder.vouch("calibration.toml")
    for event in read_run(folder).events:
        assert event["sha256"] == hashlib.sha256((folder / event["file"]).read_bytes()).hexdigest()
