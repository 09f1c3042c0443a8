"""A certificate is bound to devices, settings and time, and tells what has changed."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from doctor.certificate import Certificate, certificates_in, certify, require
from doctor.check import Check, at_least, at_most, within
from drivers.errors import ConfigError

DEVICES = ("Grbl 1.1h stage 7", "drive 3", "left L1; right R2")
SETTINGS = {"$100": 1000.0, "$20": 1.0}
NOW = datetime(2026, 5, 1, 12, 0, tzinfo=UTC)


def certificate() -> Certificate:
    checks = [at_most("motion: hold to standstill", 70.0, 250.0, "ms"), Check("motion: identity", "x", "", "", True)]
    return certify("bench 2", DEVICES, SETTINGS, checks, None, now=NOW, software="micromill 1")


def test_it_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "certificates" / "bench-2.json"
    certificate().save(path)
    again = Certificate.load(path)
    assert again.figures == {"motion: hold to standstill": 70.0}
    assert (again.motion, again.spindle, again.camera) == DEVICES
    assert again.settings == SETTINGS
    assert [found for found, _ in certificates_in(path.parent)] == [path]


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"sha256": "0", "certificate": "{}"}'])
def test_a_damaged_one_is_refused_and_not_counted(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "bench-2.json"
    path.write_text(damage)
    with pytest.raises(ConfigError, match=r"remove it, and run `mill doctor"):
        Certificate.load(path)
    assert certificates_in(tmp_path) == []


def test_an_edited_one_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bench-2.json"
    certificate().save(path)
    path.write_text(path.read_text().replace("70.0", "60.0"))
    with pytest.raises(ConfigError, match="was changed"):
        Certificate.load(path)


def required(folder: Path, devices=DEVICES, settings=SETTINGS, age_h=1.0, software="micromill 1") -> Certificate:  # type: ignore[no-untyped-def]
    return require(folder, devices, settings, software=software, max_age_h=24.0, now=NOW + timedelta(hours=age_h))


def test_the_newest_of_these_devices_counts(tmp_path: Path) -> None:
    certificate().save(tmp_path / "old.json")
    replace(certificate(), date=(NOW + timedelta(minutes=1)).isoformat(), rig="again").save(tmp_path / "new.json")
    replace(certificate(), motion="a", spindle="b", camera="c").save(tmp_path / "other.json")
    assert required(tmp_path).rig == "again"


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"devices": ("Grbl 1.1f stage 7", *DEVICES[1:])}, r"of motion 'Grbl 1\.1h stage 7', found 'Grbl 1\.1f stage"),
        ({"devices": (*DEVICES[:2], "left L9; right R2")}, "of camera"),
        ({"devices": ("x", "y", DEVICES[2])}, "no certificate of these devices"),
        ({"settings": {**SETTINGS, "$100": 1010.0}}, r"\$100 1000\.0 -> 1010\.0"),
        ({"settings": {"$20": 1.0}}, r"\$100 1000\.0 -> None"),
        ({"software": "micromill 2"}, r"by micromill 1, this is micromill 2"),
        ({"age_h": 25.0}, r"25 h old, allowed 24 h \(\[certificate\] max_age_h\)"),
    ],
)
def test_what_has_changed_is_named(tmp_path: Path, changed: dict[str, object], says: str) -> None:
    certificate().save(tmp_path / "bench-2.json")
    with pytest.raises(ConfigError, match=says):
        required(tmp_path, **changed)


def test_without_any_the_next_step_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"run `mill doctor --rig FILE` first"):
        required(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("check", "passed"),
    [
        (at_most("a", 1.0, 1.0, ""), True), (at_most("a", 1.1, 1.0, ""), False), (at_least("a", 1.0, 1.0, ""), True),
        (at_least("a", 0.9, 1.0, ""), False), (within("a", 2.0, 1.0, 2.0, ""), True),
        (within("a", float("nan"), 1.0, 2.0, ""), False),
    ],
)  # fmt: skip
def test_a_figure_at_its_limit_passes_and_none_is_no_figure(check: Check, passed: bool) -> None:
    assert check.passed is passed
    assert check.to_json()["verdict"] == ("pass" if passed else "fail")
