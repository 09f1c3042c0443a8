"""That a rig was found well: bound to its devices, their firmware and settings, with what was measured and when."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from pathlib import Path

from calib.calibration_file import Calibration
from doctor.check import Check
from drivers.errors import ConfigError

SCHEMA = 1
_NEXT = "run `mill doctor --rig FILE`"


@dataclass(frozen=True, eq=False)
class Certificate:
    """What ``mill doctor`` found, when every check passed."""

    rig: str
    motion: str
    spindle: str
    camera: str
    """Who the devices said they were."""
    settings: Mapping[str, float]
    """Of the motion controller."""
    figures: Mapping[str, float]
    """By the check's name."""
    date: str
    """ISO 8601 with time zone."""
    software: str
    calibration: Calibration | None = field(default=None, compare=False)
    """Where the eyes saw the drill then."""

    def save(self, path: Path) -> None:
        """Write it, and what the eyes saw beside it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.calibration is not None:
            self.calibration.save(path.with_suffix(".toml"))
        body = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "calibration"}
        text = json.dumps({"schema": SCHEMA, **body}, indent=1, sort_keys=True)
        path.write_text(json.dumps({"sha256": _seal(text), "certificate": text}, indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> "Certificate":
        """Read one.

        Raises:
            ConfigError: it is damaged, was edited, or is of another version.
        """
        try:
            held = json.loads(path.read_text(encoding="utf-8"))
            text = held["certificate"]
            whole = held["sha256"] == _seal(text)
            body = json.loads(text)
        except (OSError, ValueError, KeyError, TypeError):
            raise ConfigError(f"{path}: is no certificate, or a damaged one; remove it, and {_NEXT}") from None
        if not whole or body.pop("schema", None) != SCHEMA:
            raise ConfigError(f"{path}: was changed, or is of another version; remove it, and {_NEXT}")
        seen = path.with_suffix(".toml")
        return cls(**body, calibration=Calibration.load(seen, None) if seen.is_file() else None)

    def age_h(self, now: datetime) -> float:
        """Hours since it was written."""
        return (now - datetime.fromisoformat(self.date)).total_seconds() / 3600.0

    def is_of(self, motion: str, spindle: str, camera: str) -> bool:
        """Whether it is of these devices, of which one may have changed."""
        return sum((self.motion == motion, self.spindle == spindle, self.camera == camera)) >= 2


def certificates_in(folder: Path) -> list[tuple[Path, Certificate]]:
    """All that can be read, newest first."""
    found = []
    for path in folder.glob("*.json"):
        try:
            found.append((path, Certificate.load(path)))
        except ConfigError:
            continue
    return sorted(found, key=lambda each: each[1].date, reverse=True)


def certify(
    rig: str,
    devices: tuple[str, str, str],
    settings: Mapping[str, float],
    checks: Sequence[Check],
    calibration: Calibration | None,
    *,
    now: datetime,
    software: str,
) -> Certificate:
    """The certificate of a rig all of whose checks passed; ``devices`` are motion, spindle and camera."""
    figures = {check.name: float(check.value) for check in checks if isinstance(check.value, float)}
    date = now.isoformat(timespec="seconds")
    return Certificate(rig, *devices, dict(settings), figures, date, software, calibration)


def require(
    folder: Path,
    devices: tuple[str, str, str],
    settings: Mapping[str, float],
    *,
    software: str,
    max_age_h: float,
    now: datetime,
) -> Certificate:
    """The newest certificate of exactly these devices, set as they were, by this version.

    Raises:
        ConfigError: there is none, it is too old, or what has changed since.
    """
    related = [each for _, each in certificates_in(folder) if each.is_of(*devices)]
    if not related:
        raise ConfigError(f"{folder}: holds no certificate of these devices; {_NEXT} first")
    newest = related[0]
    for what, was, found in zip(
        ("motion", "spindle", "camera"), (newest.motion, newest.spindle, newest.camera), devices, strict=True
    ):
        if was != found:
            raise ConfigError(f"{folder}: the certificate is of {what} {was!r}, found {found!r}; {_NEXT} again")
    names = sorted(name for name in {*settings, *newest.settings} if settings.get(name) != newest.settings.get(name))
    if names:
        changes = ", ".join(f"{name} {newest.settings.get(name)} -> {settings.get(name)}" for name in names)
        raise ConfigError(f"{folder}: settings have changed since the certificate ({changes}); {_NEXT} again")
    if newest.software != software:
        raise ConfigError(f"{folder}: the certificate is by {newest.software}, this is {software}; {_NEXT} again")
    if newest.age_h(now) > max_age_h:
        raise ConfigError(
            f"{folder}: the certificate is {newest.age_h(now):.0f} h old, allowed {max_age_h:g} h "
            f"([certificate] max_age_h); {_NEXT} again"
        )
    return newest


def _seal(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
