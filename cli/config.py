"""The rig file: what is on the bench and what job it does. TOML; unknown keys are refused by name."""

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from drivers.backends import Kind, backend_names
from drivers.errors import ConfigError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Model = TypeVar("Model", bound=BaseModel)
MOST_STUDY_LETTERS = 120


class Table(BaseModel):
    """A table of the rig file."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class BoardTable(Table):
    """A motion board on a serial port."""

    port: str
    """Serial port, by a name that stays."""
    baud: int = Field(115200, gt=0)
    """USB boards take any."""
    origin_mm: Vector
    """Where the board's machine coordinates put the origin of {R}."""
    max_feed_mm_s: Positive = 20.0
    """A faster move is refused."""
    reply_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.1
    """How long a status report is waited for; three missed ones in a row stop the machine."""
    firmware: str = ""
    """What the firmware's version or build must begin with, such as "1.1h" or "101."."""


class GrblMotion(BoardTable):
    """GRBL 1.1 (gnea or grblHAL)."""

    backend: Literal["grbl"] = "grbl"
    settings: dict[Annotated[str, Field(pattern=r"^\$?[0-9]+$")], Finite] = {}
    """Firmware settings that must read back as given, such as "$100" = 1000."""


class TinyGMotion(BoardTable):
    """A g2core board (TinyG's successor), JSON."""

    backend: Literal["tinyg"] = "tinyg"
    settings: dict[Annotated[str, Field(pattern=r"^[a-z0-9]{1,5}$")], Finite] = {}
    """Firmware settings that must read back as given, such as "xtn" = -35."""


class BcapMotion(Table):
    """A DENSO robot: an RC8 over b-CAP (UDP)."""

    backend: Literal["bcap"] = "bcap"
    host: str
    """The controller's address."""
    port: int = Field(5007, ge=1, le=65_535)
    """UDP port of its b-CAP server."""
    origin_mm: Vector
    """Where the origin of {R} is in the robot's frame."""
    orientation_deg: Vector
    """RX, RY, RZ of the tool, the same in every move."""
    travel_low_mm: Vector
    """The low corner of the box in {R} that targets stay in: the controller has none of its own."""
    travel_high_mm: Vector
    """Its high corner."""
    max_feed_mm_s: Positive = 20.0
    """A faster move is refused."""
    reply_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.1
    """How long a reply is waited for before asking again; three tries without one are an error."""


class SpindleTable(Table):
    """What every drill is told."""

    speed_rpm: Positive = 45_000.0
    """Milling speed."""
    max_speed_rpm: Annotated[Positive, Field(validate_default=True)] = 60_000.0
    """Refused above this, whatever the drive allows."""

    @field_validator("max_speed_rpm")
    @classmethod
    def _allows_the_speed(cls, max_speed_rpm: float, others: ValidationInfo) -> float:
        if max_speed_rpm < (speed_rpm := others.data.get("speed_rpm", 0.0)):
            raise ValueError(f"speed_rpm = {speed_rpm:g} is above it")
        return max_speed_rpm


class Cia402SpindleTable(SpindleTable):
    """A CiA 402 drive on a CAN bus."""

    backend: Literal["cia402"] = "cia402"
    interface: Literal["slcan", "socketcan"] = "slcan"
    """A serial adapter, or a CAN interface of the kernel."""
    channel: str
    """The adapter's serial port, or the interface's name."""
    bitrate: Literal[10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] = 1_000_000
    """Of the bus, as the drive is set."""
    node_id: int = Field(1, ge=1, le=126)
    """Of the drive on the bus."""
    heartbeat_s: Annotated[float, Field(ge=0.05, le=1.0)] = 0.25
    """The drive stops by itself after this silence of the host, the host after 0.8 of it of the drive."""


class ModbusSpindleTable(SpindleTable):
    """A Delta VFD on Modbus RTU."""

    backend: Literal["modbus"] = "modbus"
    port: str
    """Serial port, by a name that stays."""
    baud: Literal[4_800, 9_600, 19_200, 38_400, 57_600, 115_200] = 38_400
    """Parameter 09-01."""
    framing: Literal["8N1", "8N2", "8E1", "8O1"] = "8N2"
    """Data bits, parity, stop bits: parameter 09-04."""
    station: int = Field(1, ge=1, le=247)
    """Parameter 09-00."""
    rated_current_a: Positive
    """Of the motor; torque is told as a share of it."""
    poles: Literal[2, 4, 6, 8] = 2
    """Of the motor; rpm = 60 x Hz x 2 / poles."""
    frequency_decimals: Literal[1, 2] = 2
    """1 for high-speed models, which count in 0.1 Hz."""
    heartbeat_s: Annotated[float, Field(ge=0.2, le=1.0)] = 0.3
    """In steps of 0.1; written into 09-03 while the drill is to turn."""

    @field_validator("heartbeat_s")
    @classmethod
    def _is_in_tenths(cls, heartbeat_s: float) -> float:
        if not math.isclose(heartbeat_s, round(heartbeat_s, 1)):
            raise ValueError("the drive counts in 0.1 s")
        return heartbeat_s


class GrblSpindleTable(SpindleTable):
    """A drill on the spindle output of the motion's GRBL controller."""

    backend: Literal["grbl"] = "grbl"
    run_up_s: Annotated[float, Field(gt=0, le=5.0)] = 2.0
    """How long the drill takes to any speed and to standstill, which the controller does not see."""


class OpenCvCamera(Table):
    """Two V4L2 devices by stable path, or two URLs."""

    backend: Literal["opencv"] = "opencv"
    left: str
    """A V4L2 device by stable path, or a URL."""
    right: str
    """The same of the right eye."""
    size_px: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] = (960, 540)
    """Width and height of each picture."""
    fps: Positive = 30.0
    """Pictures per second and eye."""
    max_skew_s: Positive = 0.02
    """Between the exposures of left and right."""
    exposure: Annotated[Finite | None, Field(validate_default=True)] = None
    """Fixed, in the camera's own unit; needed for V4L2 devices."""
    gain: Finite | None = None
    """Fixed, in the camera's own unit."""
    white_balance_k: Positive | None = None
    """Fixed, in kelvin."""

    @field_validator("exposure")
    @classmethod
    def _is_fixed_on_devices(cls, exposure: float | None, others: ValidationInfo) -> float | None:
        if exposure is None and any("://" not in others.data.get(side, "://") for side in ("left", "right")):
            raise ValueError("a V4L2 camera needs a fixed exposure")
        return exposure


class OtherBackend(BaseModel):
    """A device of a third party: its own entry point checks the keys."""

    model_config = ConfigDict(extra="allow", frozen=True)
    backend: str


class ToolTable(Table):
    """The ball at the end of the drill, and which way the shank goes up, in {R}."""

    ball_radius_mm: Annotated[float, Field(ge=0.1, le=2.0)] = 0.5
    """Of the drill."""
    axis: Vector = (math.sin(math.radians(40.0)), 0.0, math.cos(math.radians(40.0)))
    """From the tip up the shank, in {R}; any length."""

    @property
    def center_from_tip_mm(self) -> tuple[float, float, float]:
        """From the tip to the centre of the ball, in {R}."""
        length = math.hypot(*self.axis)
        x, y, z = (self.ball_radius_mm * value / length for value in self.axis)
        return (x, y, z)


class BenchTable(Table):
    """Places on the bench, in {R}."""

    park_mm: Vector = (23.0, -10.0, 12.0)
    """Where the drill is out of both pictures."""


class CalibrationTable(Table):
    """How long a calibration is good for."""

    max_age_h: Positive = 168.0
    """A rig that was left alone for longer is calibrated again before it mills."""


class CertificateTable(Table):
    """What `mill doctor` must have found before `mill run` mills."""

    required: bool = True
    """Whether `mill run` asks for one."""
    max_age_h: Positive = 168.0
    """An older one is refused."""
    hold_ms: Positive = 250.0
    """From the request to hold until the axes stand."""
    round_trip_ms: Positive = 50.0
    """Of a motion report, 99 of 100."""
    frame_age_ms: Positive = 100.0
    """Of a pair of pictures at delivery, the median."""
    spindle_stop_s: Positive = 3.0
    """From the request to standstill."""
    backlash_mm: Positive = 0.025
    """Of X and Y, seen by the cameras; four times that of Z."""
    scale: Positive = 0.005
    """Change of the steps per mm since the certificate before, as a share."""
    free_disk_mb: Positive = 1000.0
    """Where records go."""


class WeightsTable(Table):
    """Networks in place of mill's own, as `mill train` writes them; paths count from the rig file."""

    tip: Path | None = None
    """Finds the drill's ball."""
    landmarks: Path | None = None
    """Finds bregma and lambda."""
    completion: Path | None = None
    """Reads how far the ring is through."""


def study_word(text: str) -> str:
    """A name that a lab gives: one line, not empty.

    Raises:
        ValueError: it is none.
    """
    text = text.strip()
    if not text or len(text) > MOST_STUDY_LETTERS or not text.isprintable():
        raise ValueError(f"one line of 1 to {MOST_STUDY_LETTERS} letters is needed")
    return text


StudyWord = Annotated[str, AfterValidator(study_word)]


class StudyTable(Table):
    """What the records belong to; the command line says otherwise for one run."""

    specimen_id: StudyWord | None = None
    """Whose skull it is. `mill resume` refuses another one than the record's."""
    protocol: StudyWord | None = None
    """Of the study."""
    operator: StudyWord | None = None
    """Who mills."""


class RigConfig(BaseModel):
    """A whole rig file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: Literal[1] = Field(alias="schema")
    """Of this kind of file."""
    name: str
    """The calibration file and the certificate are called after it."""
    motion: GrblMotion | TinyGMotion | BcapMotion | OtherBackend
    spindle: Cia402SpindleTable | ModbusSpindleTable | GrblSpindleTable | OtherBackend
    camera: OpenCvCamera | OtherBackend
    tool: ToolTable = ToolTable()
    bench: BenchTable = BenchTable()
    calibration: CalibrationTable = CalibrationTable()
    certificate: CertificateTable = CertificateTable()
    weights: WeightsTable = WeightsTable()
    study: StudyTable = StudyTable()
    job: dict[str, Any] = {}
    """Checked by milling.job, which knows the limits of a job."""

    @field_validator("spindle")
    @classmethod
    def _has_its_controller(cls, spindle: BaseModel, others: ValidationInfo) -> BaseModel:
        if isinstance(spindle, GrblSpindleTable) and not isinstance(others.data.get("motion"), GrblMotion):
            raise ValueError('a drill on the controller of the motion needs [motion] backend = "grbl"')
        return spindle

    @property
    def camera_settings(self) -> str:
        """What the cameras are set to, besides which ones they are."""
        table = self.camera.model_dump(exclude={"backend", "left", "right", "max_skew_s"}, exclude_none=True)
        return ", ".join(f"{key} {value}" for key, value in sorted(table.items()))


BUILT_IN: Mapping[Kind, Mapping[str, type[Table]]] = {
    "motion": {"grbl": GrblMotion, "tinyg": TinyGMotion, "bcap": BcapMotion},
    "spindle": {"cia402": Cia402SpindleTable, "modbus": ModbusSpindleTable, "grbl": GrblSpindleTable},
    "camera": {"opencv": OpenCvCamera},
}


def load_rig(path: Path) -> RigConfig:
    """Read and check a rig file.

    Raises:
        ConfigError: one line with file, key, what was found and what is allowed.
    """
    data = read_toml(path, "rig file", "`mill emulate --rig-out rig.toml` writes one to start from")
    for kind, models in BUILT_IN.items():
        table = data.get(kind)
        if isinstance(table, dict):
            data[kind] = _device_table(path, kind, table, models)
    weights = data.get("weights")
    if isinstance(weights, dict):
        data["weights"] = {
            task: str(path.parent / file) if isinstance(file, str) else file for task, file in weights.items()
        }
    return _checked(RigConfig, data, path)


def read_toml(path: Path, what: str, next_step: str) -> dict[str, Any]:
    """The tables of a TOML file a person wrote."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such {what}; {next_step}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot read this {what}: {error.strerror}; {next_step}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}; {next_step}") from None


def _device_table(path: Path, kind: Kind, table: dict[str, Any], models: Mapping[str, type[Table]]) -> BaseModel:
    name, known = table.get("backend", next(iter(models))), backend_names(kind)
    if name not in known:
        raise ConfigError(
            f"{path}: {kind}.backend = {name!r}: unknown; allowed: {', '.join(known)}; correct it, or install the "
            f"package that adds {kind}.{name}"
        )
    if name in models:
        return _checked(models[name], table, path, prefix=f"{kind}.")
    return _checked(OtherBackend, table, path, prefix=f"{kind}.")


def _checked(model: type[Model], data: dict[str, Any], path: Path, prefix: str = "") -> Model:
    try:
        return model.model_validate(data)
    except pydantic.ValidationError as error:
        raise ConfigError(f"{path}: {_first_problem(error, model, prefix)}") from None


def _first_problem(error: pydantic.ValidationError, model: type[BaseModel], prefix: str) -> str:
    """One line for the first of pydantic's findings."""
    problem = error.errors(include_url=False)[0]
    key = prefix + ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        allowed = ", ".join(_keys_at(model, problem["loc"][:-1]))
        return f"{key}: unknown key; allowed: {allowed}"
    if problem["type"] == "missing":
        return f"{key}: missing; add this key"
    return f"{key} = {problem['input']!r}: {problem['msg']}; correct this value"


def _keys_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The keys that the table at ``location`` may have."""
    for part in location:
        annotation = model.model_fields[str(part)].annotation
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return [field.alias or name for name, field in model.model_fields.items()]
