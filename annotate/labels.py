"""What one person said of the pictures of an album, kept so that nothing said is lost.

Each annotator has one file, ``annotations/NAME.json``, which one process holds and which is replaced as a whole with
every picture: a process or a computer that dies leaves the old file or the new one.
"""

import fcntl
import json
import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from types import TracebackType
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers.errors import ConfigError
from vision.album import EXPORTED, FEWEST_RING_POINTS, MOST_RING_POINTS, POINTS

FOLDER = "annotations"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")
_SCHEMA = 1

PointName = Literal["bregma", "lambda", "tip"]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Told(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Place(_Told):
    """Where a point is, in px from the middle of the top left pixel."""

    x_px: float
    y_px: float
    origin: Literal["hand", "accepted", "moved"] = "hand"
    """Found by a person alone, or a network's suggestion, accepted as it was or moved."""


class Ring(_Told):
    """A ring in the picture and how far each of its points is milled; None where that cannot be told."""

    center_x_px: float
    center_y_px: float
    radius_px: Annotated[float, Field(gt=0.0)]
    ball_px: Annotated[float, Field(gt=0.0)]
    reference: str | None = None
    completion: Annotated[tuple[Share | None, ...], Field(min_length=FEWEST_RING_POINTS, max_length=MOST_RING_POINTS)]
    origin: Literal["hand", "accepted", "moved"] = "hand"


class Label(_Told):
    """What was said of one picture; a point that is missing was not looked for yet."""

    points: dict[PointName, Place | Literal["unseen"]] = {}
    ring: Ring | Literal["none"] | None = None

    def settled(self, tasks: Collection[str]) -> bool:
        """Whether everything that these tasks ask for has been said."""
        asked = [name for task in tasks for name in POINTS.get(task, ())]
        ring = self.ring == "none" or (isinstance(self.ring, Ring) and any(v is not None for v in self.ring.completion))
        return all(name in self.points for name in asked) and (ring or "completion" not in tasks)


Labels = Mapping[str, Label]
"""By picture."""


class Notebook:
    """One annotator's labels of one album, held by this process until it is closed."""

    def __init__(self, album: Path, annotator: str) -> None:
        """Take it up where it was left.

        Raises:
            ConfigError: the name cannot be that of a file, another process has the file, or it is damaged.
        """
        if not NAME.fullmatch(annotator) or annotator == Path(EXPORTED).stem:
            raise ConfigError(
                f"annotator {annotator!r}: allowed: 1 to 40 letters, digits, - and _; choose another name"
            )
        self.annotator = annotator
        self.file = album / FOLDER / f"{annotator}.json"
        self.file.parent.mkdir(exist_ok=True)
        self._lock = os.open(self.file.with_name(f".{annotator}.lock"), os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._labels = read_labels(self.file)
        except BlockingIOError:
            os.close(self._lock)
            raise ConfigError(
                f"{self.file}: another `mill annotate` has it; end that one, or take another --annotator"
            ) from None
        except ConfigError:
            os.close(self._lock)
            raise

    @property
    def labels(self) -> Labels:
        """What was said so far."""
        return self._labels

    def put(self, picture: str, label: Label) -> None:
        """Say ``label`` of a picture in place of what was said before. It is on the disk when this returns."""
        labels = {**self._labels, picture: label}
        if label == Label():
            del labels[picture]
        told = {name: each.model_dump(exclude_defaults=True) for name, each in labels.items()}
        write_whole(self.file, {"schema": _SCHEMA, "annotator": self.annotator, "labels": told})
        self._labels = labels

    def close(self) -> None:
        """Let others take it up."""
        os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_labels(file: Path) -> dict[str, Label]:
    """The labels in an annotator's file; none where there is no file yet.

    Raises:
        ConfigError: it is damaged.
    """
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        if told["schema"] != _SCHEMA:
            raise ConfigError(f"{file}: schema {told['schema']} found, {_SCHEMA} expected: a newer mill wrote it")
        return {str(name): Label.model_validate(label) for name, label in told["labels"].items()}
    except FileNotFoundError:
        return {}
    except ValidationError as error:
        raise ConfigError(f"{file}: {in_words(error)}; correct it, or restore it from a copy") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error!r}; restore it from a copy, or remove it") from None


def annotators_of(album: Path) -> list[str]:
    """Who has labelled something there."""
    names = [file.stem for file in (album / FOLDER).glob("*.json") if file.name != Path(EXPORTED).name]
    return sorted(name for name in names if NAME.fullmatch(name))


def in_words(error: ValidationError) -> str:
    """The first thing that is wrong, on one line."""
    first = error.errors()[0]
    return f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"


def write_whole(file: Path, content: object) -> None:
    """Replace a file by another; whatever dies meanwhile, one of the two is there."""
    replace_text(file, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def replace_text(file: Path, text: str) -> None:
    """As ``write_whole``, of any text."""
    scratch = file.with_name(f".{file.name}.new")
    with scratch.open("w", encoding="utf-8") as out:
        out.write(text)
        out.flush()
        os.fsync(out.fileno())
    scratch.replace(file)
    folder = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
