"""What is said to a supervisor in the tests, and what it is heard to do."""

import os
import select
from dataclasses import dataclass

import pytest

from milling import supervisor

SCRIPT = ((b"!", 0.0), (b"\x18", 0.0))
WORDS = b"!\x18"
CRY = rb"(?:^|[\r])t081[0-9A-F]+\r"


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


@dataclass
class Device:
    """A device's wire, read along by the supervisor, and what it hands on."""

    tap: supervisor.Tap
    far: int
    handed: int

    def heard(self) -> bytes:
        """What was handed on so far."""
        return os.read(self.handed, 1 << 20) if select.select([self.handed], [], [], 0.0)[0] else b""


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


def arm_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The supervisor sees its pipe before it sees the wire, as where the alarm comes later."""
    choose, looks = select.select, []

    def pipe_first(reads: list[int], *rest: object) -> tuple[list[int], list[int], list[int]]:
        looks.append(reads)
        return choose(reads[:1] if len(looks) == 1 else reads, *rest)  # type: ignore[arg-type, call-overload]

    monkeypatch.setattr(supervisor.select, "select", pipe_first)
