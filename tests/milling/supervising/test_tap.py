"""A device's wire that the supervisor reads along: every byte is handed on, an alarm holds first."""

import contextlib
import os
import select
import sys

import pytest
from watched import CRY, SCRIPT, Device, arm_first, says_when_handed_on, stopped, watched_with, written

from milling import supervisor


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


def test_who_disarms_while_an_alarm_comes_is_heard_before_it(
    wire, said, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = wire
    choose, looks = select.select, 0

    def both_at_once(reads: list[int], *rest: object) -> tuple[list[int], list[int], list[int]]:
        nonlocal looks
        looks += 1
        if looks == 2:
            os.write(said, b"D\n")
            os.write(device.far, b"t0811023\r")
        return choose(reads, *rest)  # type: ignore[call-overload, no-any-return]

    monkeypatch.setattr(supervisor.select, "select", both_at_once)
    says_when_handed_on(monkeypatch, device, said, [b"Q\n"])
    assert watched_with(device, near, said, "A") == ""
    assert device.heard() == b"t0811023\r"
    assert written(far) == b""


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


def test_the_wire_of_a_device_is_an_argument(
    wire: tuple[int, int], said: int, told: list[str], device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, tells = os.pipe()
    monkeypatch.setattr(supervisor, "STDOUT", tells)
    monkeypatch.setattr(supervisor.os, "sched_setscheduler", lambda *_: None)
    monkeypatch.setattr(supervisor.os, "setpriority", lambda *_: None)
    words = [
        "supervisor.py",
        str(wire[0]),
        "5.0",
        '[["21", 0.0]]',
        str(device.tap.wire),
        str(device.tap._onward),
        CRY.hex(),
    ]
    monkeypatch.setattr(sys, "argv", words)
    arm_first(monkeypatch)
    os.write(said, b"A\n")
    os.write(device.far, b"t0811\r")
    supervisor.main()
    assert os.read(reads, 64) == b"watching\n"
    assert told == [f"alarm {b't0811'.hex()}0d"]
    assert device.heard() == b"t0811\r"
    for end in (reads, tells):
        os.close(end)
