"""Conformance: one set of promises, every implementation.

A test asks for the fixture ``motion_bench`` (any controller, the rig's own with ``--rig FILE``) or
``motion_wire_bench`` (emulated ones, whose wire can be looked at and cut), or ``motion_soft_limit_bench`` (those whose
firmware itself keeps a floor). To add an implementation, put a context manager that yields a bench into the table of
its fixture; to add a kind of device, add a table.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from bcap_benches import fed_bcap_bench, in_process_bcap_bench, udp_bcap_bench
from motion_benches import in_process_bench, pty_bench, rig_file_bench

Implementation = Callable[[], AbstractContextManager[Any]]

GRBL: dict[str, Implementation] = {
    "in-process-gnea": partial(in_process_bench, "gnea"),
    "in-process-grblhal": partial(in_process_bench, "grblhal"),
    "in-process-tinyg": partial(in_process_bench, "tinyg"),
    "pty-gnea": partial(pty_bench, "gnea"),
    "pty-grblhal": partial(pty_bench, "grblhal"),
    "pty-tinyg": partial(pty_bench, "tinyg"),
}
BCAP: dict[str, Implementation] = {
    "in-process-bcap": in_process_bcap_bench,
    "udp-bcap": udp_bcap_bench,
    "fed-bcap": fed_bcap_bench,
}
LONG = {"fed-bcap"}
"""In real time, with a process started for each test; tests/drivers/test_bcap_fed.py has what is its own."""
EMULATED_MOTION = GRBL | BCAP

IMPLEMENTATIONS: dict[str, dict[str, Implementation]] = {
    "motion_bench": EMULATED_MOTION,
    "motion_wire_bench": EMULATED_MOTION,
    "motion_soft_limit_bench": GRBL,
}
"""By fixture."""

ON_HARDWARE: dict[str, Callable[[Path], AbstractContextManager[Any]]] = {"motion_bench": rig_file_bench}
"""By fixture: what ``--rig FILE`` adds."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    rig_file = metafunc.config.getoption("--rig")
    for fixture, implementations in IMPLEMENTATIONS.items():
        if fixture in metafunc.fixturenames:
            makers = dict(implementations)
            if rig_file is not None and fixture in ON_HARDWARE:
                makers["hardware"] = partial(ON_HARDWARE[fixture], rig_file)
            marked = [
                pytest.param(maker, id=name, marks=[pytest.mark.long] if name in LONG else [])
                for name, maker in makers.items()
            ]
            metafunc.parametrize(fixture, marked, indirect=True)


@pytest.fixture
def motion_bench(request: pytest.FixtureRequest) -> Iterator[Any]:
    with request.param() as bench:
        yield bench


@pytest.fixture
def motion_wire_bench(request: pytest.FixtureRequest) -> Iterator[Any]:
    with request.param() as bench:
        yield bench


@pytest.fixture
def motion_soft_limit_bench(request: pytest.FixtureRequest) -> Iterator[Any]:
    with request.param() as bench:
        yield bench
