"""A calibration and its file: human-readable TOML that says where it comes from and refuses to serve another rig.

The first line holds the SHA-256 of everything below it: a torn, edited or corrupt file is refused.
"""

import hashlib
import math
import os
import re
import tomllib
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import tomlkit
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, ValidationError

from calib.camera_pair import N_PARAMETERS, CameraPair, Optics
from calib.setpoints import box_points
from calib.transform import Array
from drivers.errors import ConfigError, WrongCalibrationError

SCHEMA = 2
_CLOCK_ERROR_H = 0.1
_SEAL = re.compile(r'sha256 = "([0-9a-f]{64})"\n')


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


_Vector = tuple[float, float, float]
_Row = Annotated[list[float], Field(min_length=2 * N_PARAMETERS, max_length=2 * N_PARAMETERS)]
_Eye = Annotated[list[float], Field(min_length=N_PARAMETERS, max_length=N_PARAMETERS)]


class RigIdentity(_Strict):
    """What must be the same for a calibration to hold."""

    motion: str
    """Firmware, version and serial number of the motion controller."""
    camera: str
    """Stable names and serial numbers of both cameras."""
    spindle: str = ""
    center_from_tip_mm: _Vector = (0.0, 0.0, 0.0)
    """From the drill's tip to the centre of its ball, which is what the eyes detect."""
    camera_settings: str = ""
    """Exposure and what else the cameras were set to: another light shifts what the eyes see."""


class Provenance(_Strict):
    """Where a calibration comes from, besides the rig."""

    date: str = ""
    """ISO 8601 with time zone."""
    software: str = ""
    """Version of mill."""
    weights: dict[str, str] = {}
    """SHA-256 of each network's weights, by the network's name."""


class Setpoint(_Strict):
    """One setpoint: where the ball's centre was in {R}, where the eyes saw it, and how well the fit agrees."""

    point_mm: _Vector
    left_px: tuple[float, float]
    right_px: tuple[float, float]
    residual_mm: _Vector
    """Triangulated minus commanded."""
    leave_one_out_mm: float
    """Error here of the fit to all other setpoints."""
    used: bool
    """False: an outlier that the fit ignores."""


class _Optics(_Strict):
    origin_mm: _Vector
    center_px: tuple[float, float]
    half_diagonal_px: float = Field(gt=0)


class _Eyes(_Strict):
    left: _Eye
    right: _Eye
    sigma_px: tuple[NonNegativeFloat, NonNegativeFloat]
    covariance: Annotated[list[_Row], Field(min_length=2 * N_PARAMETERS, max_length=2 * N_PARAMETERS)]


class _File(_Strict):
    schema_: Literal[2] = Field(alias="schema")
    recipe: str
    model: str
    handedness: Literal["right-handed", "untested"]
    not_for_milling: bool
    rmse_mm: float
    predicted_rmse_mm: float
    rig: RigIdentity
    provenance: Provenance
    candidates_mm: dict[str, float]
    optics: _Optics
    eyes: _Eyes
    setpoints: list[Setpoint]


@dataclass(frozen=True, eq=False)
class Calibration:
    """The camera pair of one rig and the record of how it was found. Points are true points of {R}, mm."""

    pair: CameraPair
    recipe: str
    model: str
    """``linear``, ``affine``, ``perspective`` or ``radial``."""
    candidates_mm: dict[str, float]
    """Held-out RMSE of every model that was weighed."""
    handedness: str
    """``right-handed``, or ``untested`` where all setpoints lay in one plane."""
    not_for_milling: bool
    rmse_mm: float
    """Held-out RMSE over the setpoints in use."""
    setpoints: tuple[Setpoint, ...]
    rig: RigIdentity
    provenance: Provenance = field(default_factory=Provenance)

    def project(self, points_mm: npt.ArrayLike) -> tuple[Array, Array]:
        """Pixels (n, 2) in the left and in the right picture of points (n, 3) in {R}."""
        return self.pair.project(points_mm)

    def points_from_pixels(
        self, left_px: npt.ArrayLike, right_px: npt.ArrayLike, sigma_px: npt.ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Points (n, 3) in {R} and covariances (n, 3, 3) of matched pixels (n, 2); see ``CameraPair``."""
        return self.pair.points_from_pixels(left_px, right_px, sigma_px)

    def right_from_left(self, z_mm: float) -> Array:
        """(2, 3) affine from left to right pixels for points at height ``z_mm``; see ``CameraPair``."""
        return self.pair.right_from_left(z_mm)

    def sigma_at(self, points_mm: npt.ArrayLike) -> Array:
        """(n, 3): predicted 1-sigma of one detection along x, y, z at points (n, 3), mm."""
        return self.pair.sigma_at(points_mm)

    @property
    def predicted_rmse_mm(self) -> float:
        """Predicted RMS distance error of one detection over the validation box."""
        return self.predicted_rmse_at(box_points())

    def predicted_rmse_at(self, points_mm: npt.ArrayLike) -> float:
        """Predicted RMS distance error of one detection over these points (n, 3), mm."""
        return float(np.sqrt((self.sigma_at(points_mm) ** 2).sum(axis=1).mean()))

    @property
    def outliers(self) -> tuple[Setpoint, ...]:
        """The setpoints that the fit ignores."""
        return tuple(setpoint for setpoint in self.setpoints if not setpoint.used)

    def save(self, path: Path, rig: RigIdentity | None = None) -> None:
        """Write the file so that it is whole or absent, also after a power cut.

        Raises:
            WrongCalibrationError: ``rig`` is given and is not the rig that was calibrated.
            ConfigError: the file cannot be written; what was there before is untouched.
        """
        if rig is not None:
            _require_same_rig(self.rig, rig, str(path))
        body = _body(self)
        seal = hashlib.sha256(body.encode()).hexdigest()
        try:
            _replace(path, f'sha256 = "{seal}"\n{body}')
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written ({error}); free space or choose another place") from error

    @classmethod
    def load(
        cls,
        path: Path,
        rig: RigIdentity | None,
        *,
        for_milling: bool = False,
        now: datetime | None = None,
        max_age_h: float = math.inf,
    ) -> "Calibration":
        """Read a file that was saved for this rig.

        Args:
            path: the file.
            rig: the rig at hand; None only to look at a file without using it.
            for_milling: refuse a calibration that must not guide the drill through bone.
            now: what its age is counted to, with time zone; None asks for no age.
            max_age_h: oldest that is accepted.

        Raises:
            ConfigError: no such file, corrupt, another schema, or a key that is unknown, missing or out of its range.
            WrongCalibrationError: it belongs to another rig, is too old, or is not for milling.
        """
        calibration = _parse(path)
        if now is not None:
            _require_fresh(calibration, path, now, max_age_h)
        if rig is not None:
            _require_same_rig(calibration.rig, rig, str(path))
        if for_milling and calibration.not_for_milling:
            raise WrongCalibrationError(
                f"{path}: not_for_milling: recipe {calibration.recipe!r} leaves height and handedness untested; "
                "run `mill calibrate` with the default recipe"
            )
        return calibration


def _body(calibration: Calibration) -> str:
    """Everything below the seal."""
    pair = calibration.pair
    document = tomlkit.document()
    document.add(
        tomlkit.comment(
            "Written by `mill calibrate`; do not edit. Lengths in mm, frame {R}; pixels of the full picture."
        )
    )
    document.update(
        {
            "schema": SCHEMA,
            "recipe": calibration.recipe,
            "model": calibration.model,
            "handedness": calibration.handedness,
            "not_for_milling": calibration.not_for_milling,
            "rmse_mm": calibration.rmse_mm,
            "predicted_rmse_mm": calibration.predicted_rmse_mm,
            "rig": _plain(calibration.rig.model_dump()),
            "provenance": _plain(calibration.provenance.model_dump()),
            "candidates_mm": calibration.candidates_mm,
            "optics": {
                "origin_mm": list(pair.optics.origin_mm),
                "center_px": list(pair.optics.center_px),
                "half_diagonal_px": pair.optics.half_diagonal_px,
            },
            "setpoints": [_plain(setpoint.model_dump()) for setpoint in calibration.setpoints],
            "eyes": {
                "sigma_px": list(pair.sigma_px),
                "left": pair.left.tolist(),
                "right": pair.right.tolist(),
                "covariance": pair.covariance.tolist(),
            },
        }
    )
    return tomlkit.dumps(document)


def _replace(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with temporary.open("w", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _plain(table: dict[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in table.items()}


def _parse(path: Path) -> Calibration:
    next_step = "run `mill calibrate` again"
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such calibration file; run `mill calibrate` first") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); {next_step}") from error
    seal = _SEAL.match(text)
    if seal is None:
        raise ConfigError(f"{path}: key sha256: not a calibration file, its first line is not a seal; {next_step}")
    body = text[seal.end() :]
    if (found := hashlib.sha256(body.encode()).hexdigest()) != seal[1]:
        raise ConfigError(
            f"{path}: key sha256: found {found[:12]}…, sealed {seal[1][:12]}…: torn or edited; {next_step}"
        )
    try:
        table = tomllib.loads(body)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: no TOML ({error}); {next_step}") from error
    if table.get("schema") != SCHEMA:
        raise ConfigError(f"{path}: key schema: found {table.get('schema')!r}, allowed {SCHEMA}; {next_step}")
    try:
        file = _File.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        value = "" if isinstance(first["input"], dict) else f": found {first['input']!r}"
        raise ConfigError(f"{path}: key {key}{value}: {first['msg']}; {next_step}") from error
    optics = Optics(file.optics.origin_mm, file.optics.center_px, file.optics.half_diagonal_px)
    eyes = file.eyes
    pair = CameraPair(optics, np.array(eyes.left), np.array(eyes.right), np.array(eyes.covariance), eyes.sigma_px)
    return Calibration(
        pair,
        file.recipe,
        file.model,
        file.candidates_mm,
        file.handedness,
        file.not_for_milling,
        file.rmse_mm,
        tuple(file.setpoints),
        file.rig,
        file.provenance,
    )


def _require_fresh(calibration: Calibration, path: Path, now: datetime, max_age_h: float) -> None:
    date = calibration.provenance.date
    try:
        age_h = (now - datetime.fromisoformat(date)).total_seconds() / 3600.0
    except (ValueError, TypeError):
        raise WrongCalibrationError(
            f"{path}: key provenance.date: found {date!r}, a date with time zone is needed; run `mill calibrate` again"
        ) from None
    if age_h < -_CLOCK_ERROR_H:
        raise WrongCalibrationError(f"{path}: dated {date}, which is yet to come; set this machine's clock")
    if age_h > max_age_h:
        raise WrongCalibrationError(
            f"{path}: {age_h:.0f} h old, allowed {max_age_h:g} h ([calibration] max_age_h); run `mill calibrate` again"
        )


def _require_same_rig(calibrated: RigIdentity, found: RigIdentity, path: str) -> None:
    ours, theirs = found.model_dump(), calibrated.model_dump()
    if calibrated == found.model_copy(update={"camera_settings": calibrated.camera_settings}) != found:
        raise WrongCalibrationError(
            f"{path}: was made with the cameras set to {calibrated.camera_settings or 'what it does not say'}; they "
            f"are set to {found.camera_settings} now; set them back, or run `mill calibrate` again"
        )
    if differing := [key for key in theirs if theirs[key] != ours[key]]:
        what = "; ".join(f"{key}: calibrated {theirs[key]!r}, found {ours[key]!r}" for key in differing)
        raise WrongCalibrationError(f"{path}: belongs to another rig ({what}); run `mill calibrate` on this rig")
