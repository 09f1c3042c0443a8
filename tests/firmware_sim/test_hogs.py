"""Programs that want every core come and go with the command."""

import threading

from firmware_sim.faults import parse_faults
from firmware_sim.hogs import hogs


def test_they_run_until_the_command_ends() -> None:
    with hogs(parse_faults(["host.hog=2"])) as busy:
        for thread in threading.enumerate():
            if isinstance(thread, threading.Timer):
                thread.join(10.0)
        assert [process.poll() for process in busy] == [None, None]
    assert all(process.poll() is not None for process in busy)


def test_those_that_are_not_due_never_start() -> None:
    with hogs(parse_faults(["host.hog=2@3600s", "disk.full"])) as busy:
        pass
    assert busy == []
