"""The supervisor: it stops the motion on silence, on request and on the death of who mills, and at no other time."""

import ast
import contextlib
import os
import pty
import select
import sys
import threading
import tty
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from drivers.clock import SystemClock
from drivers.errors import DeviceError
from drivers.motion.interface import StopPath
from drivers.spindle.interface import AlarmPath
from milling import supervisor
from milling.guard import Guard

SCRIPT = ((b"!", 0.0), (b"\x18", 0.0))
WORDS = b"!\x18"


@pytest.fixture
def wire() -> Iterator[tuple[int, int]]:
    """A port and its far end."""
    far, near = pty.openpty()
    tty.setraw(near)
    yield near, far
    os.close(near)
    os.close(far)


@pytest.fixture
def told() -> list[str]:
    """What the supervisor says."""
    return []


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, told: list[str]) -> Iterator[int]:
    """Where the one who mills speaks; `supervisor.watch` hears it."""
    hears, speaks = os.pipe()
    monkeypatch.setattr(supervisor, "STDIN", hears)
    monkeypatch.setattr(supervisor, "_tell", told.append)
    yield speaks
    os.close(hears)


def written(far: int, wait_s: float = 0.0) -> bytes:
    return os.read(far, 64) if select.select([far], [], [], wait_s)[0] else b""


def stopped(far: int) -> bool:
    """Whether the whole script comes out of the far end, and nothing else."""
    said = b""
    while len(said) < len(WORDS) and (more := written(far, 5.0)):
        said += more
    return said == WORDS


def lines(words: str) -> bytes:
    """Each letter a line; a beat is given now."""
    return b"".join(b".%.6f\n" % supervisor.now_s() if word == "." else word.encode() + b"\n" for word in words)


def watched(port: int, speaks: int, words: str, *, silence_s: float = 0.02, ends: bool = False) -> str:
    os.write(speaks, lines(words))
    if ends:
        os.close(speaks)
    try:
        return supervisor.watch(port, silence_s, SCRIPT)
    finally:
        if not ends:
            os.close(speaks)


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


# A device's wire, read along.

CRY = rb"(?:^|[\r])t081[0-9A-F]+\r"


@dataclass
class Device:
    """A device's wire, read along by the supervisor, and what it hands on."""

    tap: supervisor.Tap
    far: int
    handed: int

    def heard(self) -> bytes:
        """What was handed on so far."""
        return os.read(self.handed, 1 << 20) if select.select([self.handed], [], [], 0.0)[0] else b""


@pytest.fixture
def device() -> Iterator[Device]:
    wire, far = os.pipe()
    handed, onward = os.pipe()
    os.set_blocking(onward, False)
    yield Device(supervisor.Tap(wire, onward, CRY), far, handed)
    for end in (wire, far, handed, onward):
        with contextlib.suppress(OSError):
            os.close(end)


def watched_with(device: Device, port: int, speaks: int, words: str, *, silence_s: float = 5.0) -> str:
    os.write(speaks, lines(words))
    return supervisor.watch(port, silence_s, SCRIPT, device.tap)


def says_when_handed_on(monkeypatch: pytest.MonkeyPatch, device: Device, speaks: int, then: list[bytes]) -> None:
    """Each time bytes are handed on, the next of ``then`` is said to the supervisor."""
    hand_on = supervisor.Tap.hand_on

    def told(tap: supervisor.Tap, data: bytes) -> None:
        hand_on(tap, data)
        if then:
            os.write(speaks, then.pop(0))

    monkeypatch.setattr(supervisor.Tap, "hand_on", told)


def test_every_byte_is_handed_on_and_what_is_no_alarm_stops_nothing(
    wire, said, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = wire
    says_when_handed_on(monkeypatch, device, said, [b"D\nQ\n"])
    os.write(device.far, b"t701105\rt1816")
    assert watched_with(device, near, said, "A") == ""
    assert device.heard() == b"t701105\rt1816"
    assert written(far) == b""


def test_an_alarm_holds_first_then_says_so_then_is_handed_on(
    wire, said, told, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, _ = wire
    order: list[object] = []
    monkeypatch.setattr(supervisor, "_tell", lambda why: order.append((why, written(wire[1]), device.heard())))
    monkeypatch.setattr(supervisor.time, "sleep", lambda _: order.append(device.heard()))
    says_when_handed_on(monkeypatch, device, said, [])
    os.write(said, b"A\n")
    arm_first(monkeypatch)
    os.write(device.far, b"t701105\rt0811023\r")
    why = f"alarm {bytes([13]).hex()}{b't0811023'.hex()}{bytes([13]).hex()}"
    assert supervisor.watch(near, 5.0, SCRIPT, device.tap) == why
    assert order[0] == (why, b"!", b"")
    assert order[1] == b"t701105\rt0811023\r"


def arm_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The supervisor sees its pipe before it sees the wire, as where the alarm comes later."""
    choose, looks = select.select, []

    def pipe_first(reads: list[int], *rest: object) -> tuple[list[int], list[int], list[int]]:
        looks.append(reads)
        return choose(reads[:1] if len(looks) == 1 else reads, *rest)  # type: ignore[arg-type, call-overload]

    monkeypatch.setattr(supervisor.select, "select", pipe_first)


def test_an_alarm_in_pieces_is_one(wire, said, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = wire
    arm_first(monkeypatch)
    hand_on = supervisor.Tap.hand_on

    def the_rest(tap: supervisor.Tap, data: bytes) -> None:
        hand_on(tap, data)
        if data == b"t0811":
            os.write(device.far, b"023\r")

    monkeypatch.setattr(supervisor.Tap, "hand_on", the_rest)
    os.write(device.far, b"t0811")
    assert watched_with(device, near, said, "A") == f"alarm {b't0811023'.hex()}0d"
    monkeypatch.undo()
    assert stopped(far)
    assert device.heard() == b"t0811023\r"


def test_an_alarm_while_the_drill_is_out_of_the_bone_is_handed_on_and_never_counts_later(
    wire, said, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = wire
    says_when_handed_on(monkeypatch, device, said, [b"A\n", b"D\nQ\n"])
    hand_on = supervisor.Tap.hand_on

    def another(tap: supervisor.Tap, data: bytes) -> None:
        hand_on(tap, data)
        if data.startswith(b"t081"):
            os.write(device.far, b"t701105\r")

    monkeypatch.setattr(supervisor.Tap, "hand_on", another)
    os.write(device.far, b"t0811023\r")
    assert supervisor.watch(near, 5.0, SCRIPT, device.tap) == ""
    assert device.heard() == b"t0811023\rt701105\r"
    assert written(far) == b""


def test_a_wire_that_is_gone_is_given_back_and_the_watch_goes_on(wire, said, device: Device) -> None:
    near, far = wire
    os.close(device.far)
    assert watched_with(device, near, said, "A", silence_s=0.02).startswith("no sign of life")
    # The end of what is handed on, and not merely nothing.
    assert select.select([device.handed], [], [], 0.0)[0]
    assert device.heard() == b""
    assert stopped(far)


def test_a_wire_that_fails_is_gone(device: Device) -> None:
    os.close(device.tap.wire)
    assert device.tap.read() == b""


def test_a_wire_that_is_never_silent_does_not_hide_that_the_process_that_mills_is(
    wire, said, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = wire
    hand_on = supervisor.Tap.hand_on

    def ever_more(tap: supervisor.Tap, data: bytes) -> None:
        hand_on(tap, data)
        os.write(device.far, b"t701105\r")

    monkeypatch.setattr(supervisor.Tap, "hand_on", ever_more)
    os.write(device.far, b"t701105\r")
    assert watched_with(device, near, said, "A", silence_s=0.02).startswith("no sign of life")
    assert stopped(far)


def test_out_of_the_bone_a_wire_may_speak_while_nobody_else_does(
    wire, said, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    says_when_handed_on(monkeypatch, device, said, [b"Q\n"])
    os.write(device.far, b"t701105\r")
    assert supervisor.watch(wire[0], 0.0, SCRIPT, device.tap) == ""
    assert written(wire[1]) == b""


def test_words_that_lie_in_the_pipe_are_read_before_a_silence_is_believed(
    wire, said, monkeypatch: pytest.MonkeyPatch
) -> None:
    choose, looks = select.select, []

    def kept_waiting(files: list[int], *rest: object) -> tuple[list[int], list[int], list[int]]:
        looks.append(files)
        if len(looks) == 2:
            later_s = supervisor.now_s() + 1000.0
            monkeypatch.setattr(supervisor, "now_s", lambda: later_s)
            os.write(said, b"D\nQ\n")
        return choose(files, *rest)  # type: ignore[call-overload]

    monkeypatch.setattr(supervisor.select, "select", kept_waiting)
    os.write(said, b"A\n")
    assert supervisor.watch(wire[0], 5.0, SCRIPT) == ""
    assert written(wire[1]) == b""


def test_who_does_not_read_what_is_handed_on_holds_nothing_up(wire, said, device: Device) -> None:
    with contextlib.suppress(BlockingIOError):
        while True:
            device.tap.hand_on(bytes(4096))
            os.write(device.tap._onward, bytes(4096))
    device.tap.hand_on(b"t701105\r")
    assert watched_with(device, wire[0], said, "AQ") == ""


# As a process of its own.


@pytest.fixture
def guard(wire) -> Iterator[Guard]:
    with Guard(StopPath(wire[0], SCRIPT), SystemClock(), silence_s=30.0) as started:
        yield started


def test_a_guard_that_is_closed_leaves_the_machine_alone(wire) -> None:
    near, far = wire
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=30.0) as started:
        started.arm()
        started.beat()
    started.close()
    assert written(far) == b""


def test_a_guard_stops_when_asked_from_another_thread_and_says_so(wire, guard: Guard) -> None:
    _, far = wire
    guard.arm()
    thread = threading.Thread(target=guard.stop)
    thread.start()
    thread.join()
    assert stopped(far)
    guard._process.wait(5.0)
    with pytest.raises(DeviceError, match="it has stopped the motion: told to stop"):
        guard.disarm()


def test_a_supervisor_that_was_killed_is_missed_at_the_next_beat(wire, guard: Guard) -> None:
    _, far = wire
    guard.arm()
    guard._process.kill()
    guard._process.wait(5.0)
    with pytest.raises(DeviceError, match="its process has ended"):
        guard.beat()
    assert written(far) == b""


def test_the_death_of_who_mills_stops_the_motion(wire, guard: Guard) -> None:
    _, far = wire
    guard.arm()
    nothing, _ = ends = os.pipe()
    os.dup2(nothing, guard._to)
    assert stopped(far)
    for end in ends:
        os.close(end)


def test_a_frozen_process_is_stopped_within_its_silence(wire) -> None:
    near, far = wire
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=0.05) as started:
        started.arm()
        assert stopped(far)
        started._process.wait(5.0)
        with pytest.raises(DeviceError, match="no sign of life"):
            started.beat()


@dataclass
class Drive:
    """What a spindle driver gives a supervisor, on a wire of its own."""

    path: AlarmPath
    far: int
    through: list[int]


@pytest.fixture
def drive() -> Iterator[Drive]:
    far, near = pty.openpty()
    tty.setraw(near)
    through: list[int] = []
    yield Drive(AlarmPath(near, CRY, lambda found: f"the drive says {found!r}", through.append), far, through)
    for end in (far, near, *through):
        os.close(end)


def test_an_alarm_of_a_drive_stops_the_motion_in_words(wire, drive: Drive) -> None:
    near, far = wire
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=30.0, alarm=drive.path) as started:
        started.arm()
        os.write(drive.far, b"t701105\r")
        assert os.read(drive.through[0], 64) == b"t701105\r"
        os.write(drive.far, b"t0811023\r")
        assert stopped(far)
        with pytest.raises(DeviceError, match=r"it has stopped the motion: the drive says b'.rt0811023"):
            started.beat()
        assert os.read(drive.through[0], 64) == b"t0811023\r"
    assert os.read(drive.through[0], 64) == b""


def test_other_reasons_are_told_as_they_are_where_a_drive_may_cry_out(wire, drive: Drive) -> None:
    near, far = wire
    with Guard(StopPath(near, SCRIPT), SystemClock(), silence_s=30.0, alarm=drive.path) as started:
        started.stop()
        assert stopped(far)
        with pytest.raises(DeviceError, match="it has stopped the motion: told to stop"):
            started.disarm()


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


def test_the_wire_of_a_device_is_an_argument(
    wire: tuple[int, int], said: int, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, tells = os.pipe()
    monkeypatch.setattr(supervisor, "STDOUT", tells)
    monkeypatch.setattr(supervisor.os, "sched_setscheduler", lambda *_: None)
    monkeypatch.setattr(supervisor.os, "setpriority", lambda *_: None)
    words = ["supervisor.py", str(wire[0]), "5.0", "[]", str(device.tap.wire), str(device.tap._onward), CRY.hex()]
    monkeypatch.setattr(sys, "argv", words)
    arm_first(monkeypatch)
    os.write(said, b"A\n")
    os.write(device.far, b"t0811\r")
    supervisor.main()
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
