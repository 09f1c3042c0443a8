"""Runs into planted faults: whatever fails, the membrane stays whole, and the run ends with the reason.

The eyes are told the truth (``true_eyes``): what is tested is the loop's answer to the fault and not a network's
to the picture.
"""

import contextlib
import re
from pathlib import Path

import pytest
from true_eyes import virtual_rig

from drivers.errors import ConfigError, DeviceError
from milling.job import Job
from milling.record import read_run

JOB = Job(n_points=16, thickness_low_mm=0.1, thickness_high_mm=0.3)
ENDED_BADLY = {"held", "aborted"}


def long(*values: str) -> object:
    """One of each device is in the tests of every change, all of them in the long ones."""
    return pytest.param(*values, marks=pytest.mark.long)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        long("camera.stuck@20s", "same bytes twice"),
        ("camera.off@20s", "no fresh frame"),
        long("camera.slow=400ms@20s", "no fresh frame"),
        ("camera.skew=60ms@20s", "no fresh frame"),
        long("camera.black@20s", "same bytes twice"),
        ("serial.stall@20s", "^in-process:motion: "),
        long("serial.unplug@20s", "plug"),
        long("serial.drop=0.02@20s", "in-process:motion"),
        long("serial.flip=0.02@20s", "in-process:motion"),
        long("motion.alarm=1@20s", "[Aa]larm|ALARM"),
        ("motion.reset@20s", "reset|restart|banner"),
        long("can.bus_off@20s", "spindle"),
        long("can.silent@20s", "spindle"),
        ("spindle.stall@20s", "spindle"),
        long("spindle.slow=30%@20s", "spindle"),
        long("spindle.overspeed@20s", "spindle"),
        long("spindle.emcy@20s", "spindle"),
        ("vision.nan@4s", "no sense"),
        long("vision.slow=400ms@4s", "heartbeat"),
        ("host.stop=400ms@4s", "heartbeat"),
        ("disk.full@20s", "No space left"),
        long("disk.slow=400ms@20s", "heartbeat"),
    ],
)
def test_a_fault_ends_the_run_with_its_reason_and_a_whole_membrane(tmp_path: Path, fault: str, reason: str) -> None:
    rig = virtual_rig(faults=[fault])
    try:
        result = rig.run(tmp_path / "run", JOB)
    finally:
        # What is broken may not be closed in peace; the run has ended before.
        with contextlib.suppress(DeviceError):
            rig.close()
    truth = rig.bench.machine.truth()
    assert result.outcome in ENDED_BADLY
    assert re.search(reason, result.reason)
    assert not truth.membrane_touched
    record = read_run(tmp_path / "run")
    assert record.damage is None
    assert fault.startswith("disk.full") or record.events[-1]["kind"] in {"outcome", "stage"}


@pytest.mark.parametrize(("fault", "says"), [("motion.no_soft_limits", r"\$20"), ("can.silent", "spindle")])
def test_a_fault_that_is_there_from_the_beginning_is_found_before_anything_moves(fault: str, says: str) -> None:
    with pytest.raises((ConfigError, DeviceError), match=says):
        virtual_rig(faults=[fault])
