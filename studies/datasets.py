"""Labelled pictures of the virtual bench, for training and for judging what was trained.

Training, validation and test never share a specimen or a rig: each split draws from a range of seeds of its own,
stated here and nowhere else.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError
from firmware_sim.specimen import Specimen, draw_specimen, specimen_for
from studies.scenes import Sample, completion_samples, landmark_samples, tip_samples

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Split:
    """Seeds ``first`` to ``first + 999_999`` belong to this split; ``--seed`` chooses where in it to begin."""

    first: int
    specimens: dict[str, int]

    def seed_of(self, index: int, seed: int) -> int:
        """Seed of the split's ``index``-th specimen."""
        return self.first + (seed * 10_007 + index) % 1_000_000


SPLITS = {
    "train": Split(10_000_000, {"tip": 150, "landmarks": 320, "completion": 120}),
    "validation": Split(20_000_000, {"tip": 12, "landmarks": 20, "completion": 24}),
    "test": Split(30_000_000, {"tip": 12, "landmarks": 20, "completion": 24}),
}
CARD = "card.json"
EGGSHELL_EVERY = 8
"""Every eighth specimen is an eggshell: another bone, and one without landmarks."""
_SAMPLES: dict[str, Callable[[Specimen, np.random.Generator], Iterator[Sample]]] = {
    "tip": tip_samples,
    "landmarks": landmark_samples,
    "completion": completion_samples,
}


def ensure(
    task: str, split: str, folder: Path, *, seed: int, specimens: Path | None = None, progress: Progress
) -> None:
    """Render ``folder/split`` unless it is there; a run that was killed goes on where it stopped.

    Args:
        task: ``tip``, ``landmarks`` or ``completion``.
        split: a key of ``SPLITS``.
        folder: receives one ``.npy`` array per kind of datum, see the tasks in ``vision``.
        seed: where in the split's range of seeds to begin.
        specimens: a folder of specimen files to use in place of drawn ones.
        progress: called with the specimens done and their number.
    """
    origin: dict[str, object] = {"source": "renderings", "seed": seed}
    if specimens is None:
        origin["first_specimen_seed"] = SPLITS[split].seed_of(0, seed)
    else:
        origin["source"] = f"renderings of {specimens.name}"
    _require_same(folder, task, split, origin)
    final = folder / split
    if final.is_dir():
        return
    worlds = _drawn(task, split, seed) if specimens is None else _read(specimens, split, seed)
    draft = folder / f"{split}.part"
    draft.mkdir(parents=True, exist_ok=True)
    marker = draft / "specimens_done.json"
    begun: dict[str, Any] = (
        json.loads(marker.read_text()) if marker.is_file() else {"task": task, "origin": origin, "done": 0}
    )
    if (begun["task"], begun["origin"]) != (task, origin):
        raise ConfigError(f"{draft}: is of {begun['task']}, {begun['origin']}; remove it, or ask for the same again")
    for index in range(begun["done"], len(worlds)):
        specimen = worlds[index]()
        samples = list(_SAMPLES[task](specimen, np.random.default_rng((SPLITS[split].first, seed, index))))
        for name in samples[0]:
            values = np.stack([sample[name] for sample in samples])
            store(draft / f"{name}.npy", values, index, len(worlds))
        marker.write_text(json.dumps({**begun, "done": index + 1}))
        progress(index + 1, len(worlds))
    marker.unlink(missing_ok=True)
    shutil.move(draft, final)
    write_card(folder, task, split, **origin, specimens=len(worlds), samples=_count(final))


def _require_same(folder: Path, task: str, split: str, origin: dict[str, object]) -> None:
    """What is in ``folder`` already is what is asked for, as far as its card tells."""
    card = read_card(folder)
    found = card.get("splits", {}).get(split, origin)
    if card.get("task", task) != task or any(found.get(key) != value for key, value in origin.items()):
        raise ConfigError(
            f"{folder}: holds {card['task']}, {split} from {found.get('source')}, seed {found.get('seed')}; "
            f"{task} from {origin['source']}, seed {origin['seed']} is asked for; remove it, or name another folder"
        )


def write_card(folder: Path, task: str, split: str, **about: object) -> None:
    """Enter a split into the data set's card: what it is, how many, and where it comes from."""
    card = read_card(folder) or {"task": task, "splits": {}}
    card["splits"][split] = about
    (folder / CARD).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")


def read_card(folder: Path) -> dict[str, Any]:
    """The data set's card; empty where there is none."""
    file = folder / CARD
    if not file.is_file():
        return {}
    try:
        card: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        card["task"], card["splits"].items()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file}: is no card of a data set: {error!r}; make the data set anew") from None
    return card


def _count(folder: Path) -> int:
    return len(np.load(next(folder.glob("*.npy")), mmap_mode="r"))


def _drawn(task: str, split: str, seed: int) -> list[Callable[[], Specimen]]:
    chosen = SPLITS[split]

    def draw(index: int) -> Specimen:
        egg = index % EGGSHELL_EVERY == EGGSHELL_EVERY - 1
        return draw_specimen(chosen.seed_of(index, seed), kind="eggshell" if egg else "mouse")

    return [lambda index=index: draw(index) for index in range(chosen.specimens[task])]  # type: ignore[misc]


def _read(folder: Path, split: str, seed: int) -> list[Callable[[], Specimen]]:
    """A specimen per file, which overrides what the split draws."""
    files = sorted(folder.glob("*.toml"))
    if not files:
        raise ConfigError(f"{folder}: found no specimen files (*.toml); name a folder that has some")
    seeds = [SPLITS[split].seed_of(index, seed) for index in range(len(files))]
    return [partial(specimen_for, *pair) for pair in zip(seeds, files, strict=True)]


def store(file: Path, values: npt.NDArray[np.generic], index: int, count: int) -> None:
    """Write the samples ``index`` of ``count`` equal parts into their place of one array."""
    per_specimen = len(values)
    if index == 0:
        shape = (count * per_specimen, *values.shape[1:])
        array = np.lib.format.open_memmap(file, mode="w+", dtype=values.dtype, shape=shape)
    else:
        array = np.lib.format.open_memmap(file, mode="r+")
    array[index * per_specimen : (index + 1) * per_specimen] = values
    array.flush()
