"""What the page may ask, and what it is answered: one annotator at one album.

A message is a JSON object with ``do`` and what that needs; the answer has ``kind``. ``put`` saves the label of a
picture and is answered when it is on the disk; ``suggest`` asks the networks; ``export`` writes the tables. What cannot
be done is answered ``refused`` with the reason, and changes nothing.
"""

import json
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from annotate.compare import as_json, differences, summary
from annotate.export import export
from annotate.labels import FOLDER, Label, Labels, Notebook, Place, Ring, annotators_of, in_words, read_labels
from annotate.suggest import Suggester
from drivers.errors import MillError
from vision.album import IMAGES, pictures_in, read_picture
from vision.runtime import Image

KEPT_PICTURES = 6


class _Asked(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Put(_Asked):
    """Save what was said of a picture."""

    do: Literal["put"]
    picture: str
    label: Label


class Suggest(_Asked):
    """Ask the networks for points, or for the completion along ``ring``."""

    do: Literal["suggest"]
    picture: str
    task: Literal["landmarks", "tip", "completion"]
    ring: Ring | None = None


class Export(_Asked):
    """Write the tables, of all annotators or of this one alone."""

    do: Literal["export"]
    alone: bool = False


_ASKED: TypeAdapter[Put | Suggest | Export] = TypeAdapter(Annotated[Put | Suggest | Export, Field(discriminator="do")])


class Desk:
    """One annotator at work."""

    def __init__(self, album: Path, notebook: Notebook, tasks: Sequence[str], suggester: Suggester) -> None:
        """``tasks`` tell what is asked of every picture.

        Raises:
            ConfigError: the album has no pictures, or another annotator's labels are damaged.
        """
        self._album = album
        self._notebook = notebook
        self._tasks = tuple(tasks)
        self._suggester = suggester
        self._names = pictures_in(album)
        self._known = set(self._names)
        self._read: dict[str, tuple[float, Labels]] = {}
        self.picture: Callable[[str], Image] = lru_cache(KEPT_PICTURES)(self._picture)
        """By its name, which must be ``known``."""
        self._compared([])

    def known(self, name: str) -> bool:
        """Whether it is one of the album's pictures."""
        return name in self._known

    def progress(self) -> tuple[int, int]:
        """Pictures of which everything asked for is said, and all of them."""
        return sum(self._settled(name) for name in self._names), len(self._names)

    def told(self) -> dict[str, Any]:
        """Everything that a page needs to begin."""
        label = self._notebook.labels
        pictures = [
            {"name": name, "label": _plain(label.get(name, Label())), "settled": self._settled(name)}
            for name in self._names
        ]
        return {
            "kind": "album",
            "title": self._album.resolve().name,
            "annotator": self._notebook.annotator,
            "tasks": self._tasks,
            "pictures": pictures,
            **self._compared(self._names),
        }

    def answer(self, message: str) -> dict[str, Any]:
        """What one message comes to."""
        picture = None
        try:
            asked = _ASKED.validate_json(message)
            if isinstance(asked, Export):
                done = export(self._album, [self._notebook.annotator] if asked.alone else [])
                return {"kind": "exported", "rows": done.rows, "unsettled": done.unsettled}
            picture = asked.picture
            if not self.known(picture):
                return _refused(None, f"no picture {picture} in {self._album / IMAGES}")
            return self._put(asked) if isinstance(asked, Put) else self._suggest(asked)
        except ValidationError as error:
            return _refused(picture, in_words(error))
        except (MillError, OSError) as error:
            return _refused(picture, str(error))

    def _put(self, asked: Put) -> dict[str, Any]:
        self._require_inside(asked.picture, asked.label)
        self._notebook.put(asked.picture, asked.label)
        done, _ = self.progress()
        settled = self._settled(asked.picture)
        return {
            "kind": "saved",
            "picture": asked.picture,
            "settled": settled,
            "done": done,
            **self._compared([asked.picture]),
        }

    def _suggest(self, asked: Suggest) -> dict[str, Any]:
        picture = self.picture(asked.picture)
        told: dict[str, Any] = {"kind": "suggested", "picture": asked.picture, "task": asked.task}
        if asked.task != "completion":
            return {**told, "points": self._suggester.points(asked.task, picture)}
        if asked.ring is None:
            return _refused(asked.picture, "a ring is needed to read the completion along it")
        self._require_inside(asked.picture, Label(ring=asked.ring))
        reference = self.picture(asked.ring.reference) if asked.ring.reference else None
        return {**told, "completion": self._suggester.ring(asked.ring, picture, reference)}

    def _require_inside(self, name: str, label: Label) -> None:
        height, width = self.picture(name).shape[:2]
        spots: dict[str, tuple[float, float, float]]
        spots = {what: (each.x_px, each.y_px, 0.0) for what, each in label.points.items() if isinstance(each, Place)}
        if isinstance(ring := label.ring, Ring):
            spots["ring"] = (ring.center_x_px, ring.center_y_px, ring.radius_px)
            if ring.reference is not None and not self.known(ring.reference):
                raise MillError(f"no picture {ring.reference} in {self._album / IMAGES} to refer to")
        for what, (x, y, r) in spots.items():
            if min(x, y) - r < 0 or x + r > width - 1 or y + r > height - 1:
                raise MillError(f"{what} at {x:g},{y:g} does not lie inside the {width}x{height} px of {name}")

    def _settled(self, name: str) -> bool:
        return self._notebook.labels.get(name, Label()).settled(self._tasks)

    def _compared(self, pictures: Sequence[str]) -> dict[str, Any]:
        """How far this annotator and the others differ, over the pictures that this one has finished."""
        mine = {name: label for name, label in self._notebook.labels.items() if self._settled(name)}
        labels: dict[str, Labels] = {self._notebook.annotator: mine}
        for name in annotators_of(self._album):
            if name != self._notebook.annotator:
                labels[name] = self._others(name)
        found = [each for each in differences(labels) if self._notebook.annotator in each.between]
        theirs = {
            picture: {who: _plain(each[picture]) for who, each in labels.items() if picture in each}
            for picture in pictures
            if picture in mine
        }
        apart = {picture: as_json(each for each in found if each.picture == picture) for picture in theirs}
        return {"summary": summary(found), "apart": apart, "theirs": theirs}

    def _others(self, name: str) -> Labels:
        """Read again when its file has changed."""
        file = self._album / FOLDER / f"{name}.json"
        changed = file.stat().st_mtime_ns
        if self._read.get(name, (0, {}))[0] != changed:
            self._read[name] = changed, read_labels(file)
        return self._read[name][1]

    def _picture(self, name: str) -> Image:
        return read_picture(self._album / IMAGES / name)


def _plain(label: Label) -> dict[str, Any]:
    plain: dict[str, Any] = json.loads(label.model_dump_json(exclude_defaults=True))
    return plain


def _refused(picture: str | None, why: str) -> dict[str, Any]:
    return {"kind": "refused", "picture": picture, "why": why}
