"""The supervisor: it stops the motion on silence, on request and on the death of who mills, and at no other time."""

import ast
import contextlib
import os
import sys
import threading
from pathlib import Path

import pytest
from watched import (
    SCRIPT,
    lines,
    stopped,
    watched,
    written,
)

from milling import supervisor


def test_silence_of_one_who_mills_stops_the_motion(wire, said) -> None:
    near, far = wire
    assert watched(near, said, "A").startswith("no sign of life for ")
    assert stopped(far)


def test_an_armed_supervisor_waits_as_long_as_it_was_told_and_one_at_ease_for_ever(
    wire, said, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = wire
    waits: list[float | None] = []

    def hears(files: list[int], *_: object) -> tuple[list[int], list[int], list[int]]:
        waits.append(_[-1])  # type: ignore[arg-type]
        return (files if len(waits) < 3 else [], [], [])

    monkeypatch.setattr(supervisor.select, "select", hears)
    os.write(said, b"D\n")
    read, words = os.read, [b"A\n", b"D\n"]
    monkeypatch.setattr(supervisor.os, "read", lambda file, n: words.pop() if words else read(file, n))
    assert supervisor.watch(near, 5.0, SCRIPT).startswith("no sign of life")
    assert waits[0] is None
    assert waits[1] is None
    assert waits[2] == pytest.approx(5.0, abs=0.5)
    monkeypatch.undo()
    assert stopped(far)
    os.close(said)


def test_a_silence_that_is_over_is_not_waited_for_and_told_as_long_as_it_was(
    wire, said, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = wire
    # Heard at 100 s; asked at 107 s what is left of 5 s.
    times: list[float] = [107.0, 107.0, 100.0, 100.0, 100.0]
    waits: list[float | None] = []
    monkeypatch.setattr(supervisor, "now_s", times.pop)

    def hears(files: list[int], _w: object, _x: object, wait_s: float | None) -> tuple[list[int], list[int], list[int]]:
        waits.append(wait_s)
        return (files if len(waits) == 1 else [], [], [])

    monkeypatch.setattr(supervisor.select, "select", hears)
    os.write(said, b"A\n")
    assert supervisor.watch(near, 5.0, SCRIPT) == "no sign of life for 7.000 s"
    assert waits == [None, 0.0]
    monkeypatch.undo()
    assert stopped(far)
    os.close(said)


def test_the_end_of_the_pipe_stops_the_motion_while_armed(wire, said) -> None:
    near, far = wire
    assert watched(near, said, "A.", ends=True, silence_s=5.0) == "the process that mills is gone"
    assert stopped(far)


@pytest.mark.parametrize("words", ["", "A.D", "AD.", "DAD"])
def test_the_end_of_the_pipe_is_nothing_while_the_drill_is_out_of_the_bone(wire, said, words: str) -> None:
    near, far = wire
    os.write(said, lines(words))
    os.close(said)
    assert supervisor.watch(near, 5.0, SCRIPT) == ""
    assert written(far) == b""


@pytest.mark.parametrize("words", ["!", "A!", "AD!", "A.!Q"])
def test_it_stops_when_told_whatever_else_was_said(wire, said, words: str) -> None:
    near, far = wire
    assert watched(near, said, words, silence_s=5.0) == "told to stop"
    assert stopped(far)


def test_it_leaves_when_told(wire, said) -> None:
    near, far = wire
    assert watched(near, said, "A.DQ", silence_s=5.0) == ""
    assert written(far) == b""


def test_signs_of_life_that_were_given_too_far_apart_are_none(wire, said) -> None:
    """A computer that slept wakes up with a pipe full of beats, which tell that it slept."""
    near, far = wire
    start_s = supervisor.now_s()
    os.write(said, b"A\n" + b"".join(b".%.6f\n" % (start_s + s) for s in (0.1, 0.2, 7.7, 7.8)))
    assert supervisor.watch(near, 5.0, SCRIPT) == "no sign of life for 7.500 s"
    assert stopped(far)
    os.close(said)


def test_out_of_the_bone_signs_of_life_may_be_as_far_apart_as_they_like(wire, said) -> None:
    near, far = wire
    start_s = supervisor.now_s()
    os.write(said, b"A\nD\n" + b"".join(b".%.6f\n" % (start_s + s) for s in (0.1, 7.7)) + b"Q\n")
    assert supervisor.watch(near, 5.0, SCRIPT) == ""
    assert written(far) == b""
    os.close(said)


def test_a_supervisor_that_was_kept_waiting_itself_does_not_stop_one_who_lives(wire, said) -> None:
    near, far = wire
    start_s = supervisor.now_s()
    # Half a minute of beats, all read at once.
    os.write(said, b"A\n" + b"".join(b".%.6f\n" % (start_s + 0.05 * k) for k in range(200)) + b"D\nQ\n")
    assert supervisor.watch(near, 0.1, SCRIPT) == ""
    assert written(far) == b""
    os.close(said)


def test_a_line_may_come_in_pieces(wire, said) -> None:
    near, far = wire
    os.write(said, b"A\n.")
    thread = threading.Thread(target=lambda: os.write(said, b"%.6f\nD\nQ\n" % supervisor.now_s()))
    thread.start()
    assert supervisor.watch(near, 5.0, SCRIPT) == ""
    thread.join()
    assert written(far) == b""
    os.close(said)


def test_why_is_told_when_the_first_bytes_are_on_the_wire(wire, said, told, monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = wire
    on_the_wire = []
    monkeypatch.setattr(supervisor, "_tell", lambda why: on_the_wire.append((why, written(far))))
    os.write(said, lines("!"))
    supervisor.watch(near, 5.0, SCRIPT)
    assert on_the_wire == [("told to stop", b"!")]
    os.close(said)


def test_waits_of_the_script_are_kept(wire, said, monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = wire
    order: list[object] = []
    monkeypatch.setattr(supervisor.time, "sleep", lambda wait_s: order.append((wait_s, written(far))))
    os.write(said, lines("!"))
    supervisor.watch(near, 5.0, ((b"!", 0.2), (b"\x18", 0.5)))
    assert order == [(0.2, b"!"), (0.5, b"\x18")]
    os.close(said)


def test_a_port_that_is_gone_is_said(said) -> None:
    hears, speaks = os.pipe()
    os.close(hears)
    assert watched(speaks, said, "!") == "told to stop; the port took no bytes"
    os.close(speaks)


def test_a_port_that_takes_nothing_is_given_up(said, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "TAKES_NOTHING_S", 0.0)
    hears, port = os.pipe()
    os.set_blocking(port, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(port, bytes(4096))
    assert watched(port, said, "!") == "told to stop; the port took no bytes"
    os.close(hears)
    os.close(port)


def test_it_needs_nothing_but_the_standard_library() -> None:
    tree = ast.parse(Path(supervisor.__file__).read_text())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name.partition(".")[0] for name in names} <= sys.stdlib_module_names


def test_words_it_does_not_know_change_nothing(wire: tuple[int, int], said: int) -> None:
    assert watched(wire[0], said, "A?!") == "told to stop"


def test_a_port_that_is_gone_is_told(told: list[str], said: int) -> None:
    ends = os.pipe()
    for end in ends:
        os.close(end)
    assert watched(ends[1], said, "!") == "told to stop; the port took no bytes"
    assert told == ["told to stop; the port took no bytes"]


def test_a_port_that_is_full_for_a_moment_is_waited_for(
    wire: tuple[int, int], said: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, refusals = os.write, [BlockingIOError(), BlockingIOError()]

    def busy(file: int, data: bytes) -> int:
        if file == wire[0] and refusals:
            raise refusals.pop()
        return write(file, data)

    monkeypatch.setattr(supervisor.os, "write", busy)
    assert watched(wire[0], said, "!") == "told to stop"
    assert refusals == []
    assert stopped(wire[1])


@pytest.mark.parametrize("permitted", [True, False])
def test_it_asks_for_a_good_place_and_watches_without_one(
    wire: tuple[int, int], said: int, permitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[object, ...]] = []
    reads, tells = os.pipe()

    def ask(*words: object) -> None:
        asked.append(words)
        if not permitted:
            raise PermissionError

    monkeypatch.setattr(supervisor, "STDOUT", tells)
    monkeypatch.setattr(supervisor.os, "sched_setscheduler", lambda pid, policy, _: ask(pid, policy))
    monkeypatch.setattr(supervisor.os, "setpriority", lambda which, pid, _: ask(which, pid))
    monkeypatch.setattr(sys, "argv", ["supervisor.py", str(wire[0]), "0.5", '[["21", 0.0], ["18", 0.0]]'])
    os.write(said, b"!\n")
    supervisor.main()
    itself = 0
    assert asked == [(itself, os.SCHED_FIFO), (os.PRIO_PROCESS, itself)]
    assert stopped(wire[1])
    assert os.read(reads, 64) == b"watching\n"
    for end in (reads, tells):
        os.close(end)


def test_why_goes_to_whoever_reads_and_nobody_need_read(monkeypatch: pytest.MonkeyPatch) -> None:
    reads, tells = os.pipe()
    monkeypatch.setattr(supervisor, "STDOUT", tells)
    supervisor._tell("told to stop")
    assert os.read(reads, 64) == b"told to stop\n"
    for end in (reads, tells):
        os.close(end)
    supervisor._tell("into nothing")
