"""A supervisor's wires."""

import contextlib
import os
import pty
import tty
from collections.abc import Iterator

import pytest
from watched import CRY, Device

from milling import supervisor


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


@pytest.fixture
def device() -> Iterator[Device]:
    wire, far = os.pipe()
    handed, onward = os.pipe()
    os.set_blocking(onward, False)
    yield Device(supervisor.Tap(wire, onward, CRY), far, handed)
    for end in (wire, far, handed, onward):
        with contextlib.suppress(OSError):
            os.close(end)
