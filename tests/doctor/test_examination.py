"""The doctor on benches that are well, and on benches with planted faults; on the virtual clock."""

import re

import pytest

from doctor.certificate import Certificate
from doctor.check import Check
from studies.doctor_trials import BUSY, NAMED, examined, named, summary


@pytest.fixture(scope="module")
def well() -> tuple[list[Check], Certificate]:
    return examined(11, (), None)


def failed(checks: list[Check]) -> list[str]:
    """But for how busy the computer is on which the test runs."""
    return [named(check) for check in checks if not check.passed and not check.name.startswith(BUSY)]


def findings(faults: tuple[str, ...], earlier: Certificate) -> list[str]:
    return failed(examined(11, faults, earlier)[0])


def test_a_bench_that_is_well_passes_with_and_without_a_certificate(well: tuple[list[Check], Certificate]) -> None:
    checks, certificate = well
    assert failed(checks) == []
    assert certificate.settings["$100"] == 1000
    assert certificate.calibration is not None
    assert findings((), certificate) == []


@pytest.mark.parametrize(
    "faults",
    [
        ("serial.latency=16ms", "camera.skew=40ms", "can.drop=0.02", "disk.full"),
        ("motion.firmware=1.1f", "spindle.no_consumer", "camera.exposure=2x"),
        ("motion.backlash=0.05mm", "motion.scale_x=1.01"),
    ],
    ids=lambda faults: "+".join(fault.partition("=")[0] for fault in faults),
)
def test_faults_at_once_are_each_found_by_name(well: tuple[list[Check], Certificate], faults: tuple[str, ...]) -> None:
    told = findings(faults, well[1])
    for fault in faults:
        assert any(re.search(NAMED[fault], finding) for finding in told), (fault, told)


@pytest.mark.long
@pytest.mark.parametrize("fault", NAMED)
def test_each_fault_is_found_by_name(well: tuple[list[Check], Certificate], fault: str) -> None:
    told = findings((fault,), well[1])
    assert any(re.search(NAMED[fault], finding) for finding in told), told


def test_the_summary_counts_what_was_found_and_what_was_not() -> None:
    rows = [
        {"seed": 0, "fault": "", "failed": ["computer: wakes up late, p99: 60 ms"]},
        {"seed": 0, "fault": "again", "failed": ["motion: x"]},
        {"seed": 0, "fault": "disk.full", "failed": ["computer: free disk: 12 MB"]},
        {"seed": 1, "fault": "disk.full", "failed": []},
    ]
    figures = summary(rows)
    assert figures["well"] == {"examinations": 2, "false_alarms": 1, "computer_busy": 1}
    assert figures["false_alarms_told"] == ["motion: x"]
    assert figures["faults"] == {"disk.full": {"examinations": 2, "found": 1}}
