"""How a fault is written, and what is refused."""

from pathlib import Path

import pytest

from drivers.errors import ConfigError
from firmware_sim.faults import CATALOGUE, Fault, markdown, parse_fault, parse_faults


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("camera.stuck@30s", Fault("camera.stuck", 0.0, "", 30.0)),
        ("camera.stuck", Fault("camera.stuck", 0.0, "", None)),
        ("camera.slow=200ms", Fault("camera.slow", 0.2, "", None)),
        ("camera.exposure=2x", Fault("camera.exposure", 2.0, "", None)),
        ("camera.moved=200um", Fault("camera.moved", 0.2, "", None)),
        ("serial.drop=1e-3@500ms", Fault("serial.drop", 1e-3, "", 0.5)),
        ("motion.alarm", Fault("motion.alarm", 1.0, "", None)),
        ("spindle.slow=10%", Fault("spindle.slow", 0.1, "", None)),
        ("spindle.emcy=0x2310", Fault("spindle.emcy", 8976.0, "", None)),
        ("vision.low=0.7:arc", Fault("vision.low", 0.7, "arc", None)),
        ("vision.low=one@4s", Fault("vision.low", 0.7, "one", 4.0)),
        ("vision.low=0.5..0.9:arc", Fault("vision.low", 0.5, "arc", None, highest=0.9)),
        ("vision.high", Fault("vision.high", 0.0, "all", None)),
    ],
)
def test_what_is_written_is_what_is_planted(text: str, fault: Fault) -> None:
    assert parse_fault(text) == fault
    assert parse_fault(str(fault)) == fault


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_fault_has_a_value_within_its_own_limits(name: str) -> None:
    fault, kind = parse_fault(name), CATALOGUE[name]
    assert kind.does
    if kind.unit is not None:
        assert kind.low <= fault.value <= kind.high
        assert parse_fault(str(fault)) == fault


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("camera.gone", "there are camera.stuck, camera.off"),
        ("", "no fault ''"),
        ("weather.rain", "there are camera.stuck"),
        ("camera.stuck=3", "takes no value"),
        ("camera.slow=200", "needs a number from 0.01 to 5, in s"),
        ("camera.slow=20mm", "needs a number"),
        ("camera.slow=fast", "found 'fast'"),
        ("camera.stuck@soon", "found 'soon'"),
        ("camera.stuck@-3s", "needs a number from 0 to 86400, in s"),
        ("serial.drop=2", "from 1e-06 to 1"),
        ("vision.low=0.7:half", "allowed after the colon: one, arc, all"),
        ("can.drop=0.1:one", "without a colon"),
        ("vision.low=0.9..0.5", "needs a number from 0.9 to 0.99"),
        ("vision.low=0.5..", "found ''"),
        ("can.drop=0.1..0.2", "needs a number"),
        ("serial.drop=nan", "found 'nan'"),
    ],
)
def test_anything_else_is_refused_with_what_is_allowed(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match="fault") as refused:
        parse_fault(text)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


def test_of_a_range_each_seed_draws_its_own_value_and_always_the_same() -> None:
    fault = parse_fault("vision.low=0.5..0.9:one")
    values = [fault.drawn(seed).value for seed in range(50)]
    assert 0.5 <= min(values) < 0.55
    assert 0.85 < max(values) <= 0.9
    assert fault.drawn(7) == fault.drawn(7)
    assert fault.drawn(7).highest is None
    single = parse_fault("vision.low=0.7")
    assert single.drawn(7) is single


def test_faults_are_told_apart_by_where_they_are_planted() -> None:
    texts = ["vision.nan", "camera.off"]
    assert [fault.name for fault in parse_faults(texts)] == texts
    assert [fault.name for fault in parse_faults(texts, place="host")] == ["vision.nan"]
    assert [fault.name for fault in parse_faults(texts, place="bench")] == ["camera.off"]


def test_the_page_of_faults_is_that_of_the_catalogue() -> None:
    page = Path(__file__).parents[2] / "docs/faults.md"
    assert page.read_text() == markdown(), "make it anew: python -m firmware_sim.faults > docs/faults.md"
