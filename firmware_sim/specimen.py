"""What lies under the microscope, and the rig round it: the specimen file.

Every key is optional; a key that is not known is refused by its name. ``docs/specimen.md`` describes the file.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from drivers.errors import ConfigError

Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Vector3 = tuple[float, float, float]
Kind = Literal["mouse", "eggshell"]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Curvature(_Table):
    """Radii of curvature of the outer surface at the middle of bregma and lambda, in mm."""

    lateral: Positive = 7.0
    """Across the midline."""
    rostrocaudal: Positive = 12.0
    """Along the midline."""


class Tilt(_Table):
    """How the skull sits in {R}, in degrees: pitch lifts the nose, roll the animal's right side; yaw turns about +z."""

    pitch: Annotated[float, Field(ge=-20, le=20)] = 3.0
    """Lifts the nose."""
    roll: Annotated[float, Field(ge=-20, le=20)] = -2.0
    """Lifts the animal's right side."""
    yaw: Annotated[float, Field(ge=-180, le=180)] = 8.0
    """About +z of {R}; without it the nose points along -x."""


class Thickness(_Table):
    """Local bone thickness, in mm; waviness is the standard deviation of its smooth variation."""

    mean: Positive = 0.38
    """In mm, as all of these."""
    min: Positive = 0.27
    """Nowhere thinner."""
    max: Positive = 0.51
    """Nowhere thicker."""
    waviness: Annotated[float, Field(ge=0)] = 0.03
    """Standard deviation of its smooth variation."""

    @model_validator(mode="after")
    def _ordered(self) -> "Thickness":
        if not self.min <= self.mean <= self.max:
            raise ValueError(f"min <= mean <= max is asked; found {self.min}, {self.mean}, {self.max} mm")
        return self


class SkullShape(_Table):
    """Where the bone is."""

    bregma_lambda_mm: Annotated[float, Field(ge=2, le=8)] = 4.2
    """From bregma to lambda."""
    radius_of_curvature_mm: Curvature = Curvature()
    tilt_deg: Tilt = Tilt()
    center_mm: Vector3 = (5.0, -10.0, -2.5)
    """The outer surface midway between bregma and lambda, in {R}."""
    thickness_mm: Thickness = Thickness()
    height_map: Path | None = None
    """NumPy file of float32 mm, spaced by `grid_mm`; replaces the curvature."""
    thickness_map: Path | None = None
    """The same of the thickness; replaces `thickness_mm`."""
    grid_mm: Annotated[float, Field(ge=0.01, le=0.05)] = 0.02
    """Of both maps and of the bone."""


class Membrane(_Table):
    """The dura below the bone's inner surface."""

    clearance_mm: Annotated[float, Field(ge=0, le=1)] = 0.10
    """From the bone's inner surface down to the dura."""


class AppearanceStyle(_Table):
    """What it looks like; the hue, the light and the texture themselves are drawn from the specimen's seed."""

    texture: Path | None = None
    """A photograph of a skull in place of the drawn one."""
    bregma_px: tuple[float, float] | None = None
    """Where the photograph shows it: x right, y down, from its top left corner."""
    lambda_px: tuple[float, float] | None = None
    """The same of lambda."""
    brightness: Annotated[float, Field(gt=0.05, le=4)] = 1.0
    """Times the usual light."""
    wetness: Share = 0.5
    """0 dry to 1 wet: highlights, drops of saline."""
    dust: Share = 0.5
    """0 none to 1: bone dust round the kerf."""

    @model_validator(mode="after")
    def _complete(self) -> "AppearanceStyle":
        if self.texture is not None and (self.bregma_px is None or self.lambda_px is None):
            raise ValueError("a texture needs bregma_px and lambda_px, its pixel places of bregma and lambda")
        return self


class BoneMechanics(_Table):
    """How the bone answers to the drill."""

    stiffness_n_per_mm: Positive = 20.0
    """Of the skull under axial force."""
    flap_softening: Annotated[float, Field(ge=0, lt=1)] = 0.6
    """Share of that stiffness that a freed flap has lost."""


class SpindleSignal(_Table):
    """Imperfections of the torque signal, as shares of the nominal cutting torque."""

    torque_noise: Annotated[float, Field(ge=0)] = 0.03
    """One standard deviation at 100 Hz."""
    torque_ripple: Annotated[float, Field(ge=0)] = 0.05
    """With the turning of the shaft."""
    torque_drift: float = 0.02
    """Per minute."""


class Rig(_Table):
    """The truth that calibration must find."""

    seed: int = 3
    """Direction of the tilt, twist, roll, scales and centres of each eye, shape and colour of the drill."""
    microscope_tilt_deg: Annotated[float, Field(ge=0, le=25)] = 12.0
    """Of the microscope against {R}."""
    toe_in_deg: Annotated[float, Field(gt=0, le=20)] = 7.26
    """Of each eye."""
    perspective: Annotated[float, Field(ge=0, le=0.2)] = 0.02
    """Relative change of scale per 10 mm of depth."""
    distortion: Annotated[float, Field(ge=-0.1, le=0.1)] = 0.01
    """Relative shift 480 px from the picture's centre."""
    noise_dn: Annotated[float, Field(ge=0, le=40)] = 2.0
    """Grey levels, one standard deviation in the mid tones."""
    backlash_mm: Annotated[float, Field(ge=0, le=0.5)] = 0.005
    """Play of each axis."""
    run_out_mm: Annotated[float, Field(ge=0, le=0.2)] = 0.01
    """Radius of the ball centre's orbit while it turns."""


def _unit(axis: Vector3) -> Vector3:
    length = float(np.linalg.norm(axis))
    if length < 1e-6 or axis[2] <= 0:
        raise ValueError("the axis points from the tip up the shank: its z must be above 0")
    return (axis[0] / length, axis[1] / length, axis[2] / length)


class Tool(_Table):
    """The ball drill: axis from the tip up the shank, in {R}."""

    ball_radius_mm: Annotated[float, Field(ge=0.1, le=1.5)] = 0.5
    """Of the ball."""
    axis: Annotated[Vector3, AfterValidator(_unit)] = (0.6427876096865393, 0.0, 0.766044443118978)
    """From the tip up the shank; any length."""


class Specimen(_Table):
    """One specimen on one rig."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    """Of this kind of file."""
    kind: Kind = "mouse"
    """A mouse's skull, or a smooth pale shell without landmarks."""
    seed: int = 0
    """Hue, light, patches, vessels, sutures, fur, where thickness waves, what spills when."""
    skull: SkullShape = SkullShape()
    membrane: Membrane = Membrane()
    appearance: AppearanceStyle = AppearanceStyle()
    mechanics: BoneMechanics = BoneMechanics()
    spindle: SpindleSignal = SpindleSignal()
    rig: Rig = Rig()
    tool: Tool = Tool()


def load_specimen(path: str | Path, base: Specimen | None = None) -> Specimen:
    """Read a specimen file; what it does not name comes from ``base``, or else from the defaults.

    Paths in the file are relative to the file.

    Raises:
        ConfigError: the file cannot be read, or has a key or value that is not allowed; the message names it.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            named = tomllib.load(file)
    except OSError as error:
        raise ConfigError(f"specimen file {path}: {error.strerror}; name a file that exists") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"specimen file {path}: not TOML: {error}") from error
    values = _merged({} if base is None else base.model_dump(by_alias=True), named)
    if named.get("kind", "mouse") == "eggshell" and base is None:
        values = _merged(_EGGSHELL, values)
    try:
        specimen = Specimen.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"specimen file {path}: " + "; ".join(map(_complaint, error.errors()))) from error
    return _with_paths_from(specimen, path.parent)


def draw_specimen(seed: int, kind: Kind = "mouse") -> Specimen:
    """A specimen on a rig of its own, drawn widely but possibly; the same seed draws the same."""
    rng = np.random.default_rng([seed, 20817 if kind == "mouse" else 20818])
    draw = {
        "kind": kind,
        "seed": int(seed),
        "skull": _draw_mouse_skull(rng) if kind == "mouse" else _draw_eggshell(rng),
        "membrane": {"clearance_mm": rng.uniform(0.07, 0.15)},
        "appearance": {
            "brightness": np.exp(rng.normal(0.0, 0.15)),
            "wetness": rng.uniform(0.05, 0.95),
            "dust": rng.uniform(0.1, 0.9),
        },
        "mechanics": {"stiffness_n_per_mm": rng.uniform(12, 30), "flap_softening": rng.uniform(0.4, 0.8)},
        "spindle": {
            "torque_noise": rng.uniform(0.02, 0.05),
            "torque_ripple": rng.uniform(0.02, 0.08),
            "torque_drift": rng.uniform(-0.04, 0.04),
        },
        "rig": {
            "seed": int(rng.integers(2**31)),
            "microscope_tilt_deg": rng.uniform(0.0, 14.0),
            "toe_in_deg": rng.uniform(6.6, 7.9),
            "perspective": rng.uniform(0.005, 0.03),
            "distortion": rng.uniform(-0.012, 0.012),
            "noise_dn": rng.uniform(1.0, 3.5),
            "backlash_mm": rng.uniform(0.0, 0.01),
            "run_out_mm": rng.uniform(0.002, 0.015),
        },
    }
    return Specimen.model_validate(_plain(draw))


def specimen_for(seed: int, path: str | Path | None = None) -> Specimen:
    """What ``seed`` draws; a specimen file overrides what it names.

    Raises:
        ConfigError: as of ``load_specimen``.
    """
    if path is None:
        return draw_specimen(seed)
    return load_specimen(path, base=draw_specimen(seed, load_specimen(path).kind))


def _draw_mouse_skull(rng: np.random.Generator) -> dict[str, Any]:
    mean = rng.uniform(0.33, 0.43)
    return {
        "bregma_lambda_mm": rng.uniform(3.85, 4.5),
        "radius_of_curvature_mm": {"lateral": rng.uniform(6.0, 8.5), "rostrocaudal": rng.uniform(8.0, 16.0)},
        "tilt_deg": {"pitch": rng.uniform(-5, 5), "roll": rng.uniform(-5, 5), "yaw": rng.uniform(-15, 15)},
        "center_mm": [5 + rng.uniform(-1, 1), -10 + rng.uniform(-1, 1), -2.5 + rng.uniform(-0.8, 0.5)],
        "thickness_mm": {"mean": mean, "min": 0.27, "max": 0.51, "waviness": rng.uniform(0.015, 0.045)},
    }


def _draw_eggshell(rng: np.random.Generator) -> dict[str, Any]:
    mean = rng.uniform(0.34, 0.44)
    radius = rng.uniform(18.5, 21.5)
    return {
        "radius_of_curvature_mm": {"lateral": radius, "rostrocaudal": radius * rng.uniform(1.0, 1.2)},
        "tilt_deg": {"pitch": rng.uniform(-5, 5), "roll": rng.uniform(-5, 5), "yaw": rng.uniform(-90, 90)},
        "center_mm": [5 + rng.uniform(-1, 1), -10 + rng.uniform(-1, 1), -2.5 + rng.uniform(-0.8, 0.5)],
        "thickness_mm": {"mean": mean, "min": mean - 0.05, "max": mean + 0.05, "waviness": rng.uniform(0.005, 0.015)},
    }


_EGGSHELL: dict[str, Any] = {
    "skull": {
        "radius_of_curvature_mm": {"lateral": 20.0, "rostrocaudal": 20.0},
        "thickness_mm": {"mean": 0.40, "min": 0.35, "max": 0.45, "waviness": 0.01},
    }
}


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        both_tables = isinstance(below, Mapping) and isinstance(value, Mapping)
        merged[key] = _merged(below, value) if both_tables else value  # type: ignore[arg-type]
    return merged


def _plain(value: Any) -> Any:
    """Numbers of a drawing as a file would hold them: rounded, and no numpy types."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return round(float(value), 5) if isinstance(value, (float, np.floating)) else value


def _complaint(error: Any) -> str:
    place = [str(part) for part in error["loc"]]
    key = ".".join(place) or "the file"
    if error["type"] == "extra_forbidden":
        return f"key {key} is not known; allowed here: {', '.join(_allowed(place[:-1]))}"
    found = "" if error["type"] == "value_error" else f" (found {error['input']!r})"
    return f"{key}: {error['msg'].removeprefix('Value error, ')}{found}"


def _allowed(place: list[str]) -> list[str]:
    table: type[BaseModel] = Specimen
    for part in place:
        table = table.model_fields[part].annotation  # type: ignore[assignment]
    return [field.alias or name for name, field in table.model_fields.items()]


def _with_paths_from(specimen: Specimen, folder: Path) -> Specimen:
    """Resolve the file's paths, and say now, not later, when one is missing."""
    found: dict[str, dict[str, Path]] = {"skull": {}, "appearance": {}}
    for table, key in (("skull", "height_map"), ("skull", "thickness_map"), ("appearance", "texture")):
        path = getattr(getattr(specimen, table), key)
        if path is None:
            continue
        found[table][key] = folder / path
        if not found[table][key].is_file():
            raise ConfigError(
                f"specimen key {table}.{key}: no file {folder / path}; paths are relative to the specimen"
            )
    return specimen.model_copy(
        update={
            "skull": specimen.skull.model_copy(update=found["skull"]),
            "appearance": specimen.appearance.model_copy(update=found["appearance"]),
        }
    )
