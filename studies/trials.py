"""Many trials over processes, each kept as a file when it is done: a study that was stopped goes on.

A trial must depend on its arguments alone, so that the same study gives the same figures however it was cut up.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from multiprocessing import active_children
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy.stats import bootstrap

from drivers.errors import ConfigError
from firmware_sim.specimen import Specimen, specimen_for

Figures = dict[str, Any]
Progress = Callable[[int, int], None]

Z_95 = 1.959964
CLUSTER_START_S = 10.0
COUNT = 20
"""Worlds of an experiment that names no other number."""
FIRST_SEED = 40_000_000
"""Specimens and rigs of the experiments begin here: networks are trained, chosen and judged on others."""


@dataclass(frozen=True)
class World:
    """A specimen on its rig, as an experiment meets it."""

    seed: int
    file: Path | None = None
    """A specimen file: it overrides what the seed draws."""

    @property
    def name(self) -> str:
        """Of its trials' files."""
        return f"{self.seed}" if self.file is None else f"{self.seed}-{self.file.stem}"

    def specimen(self) -> Specimen:
        """Drawn anew."""
        return specimen_for(FIRST_SEED + self.seed, self.file)


def worlds(count: int | None, seed: int, folder: Path | None) -> list[World]:
    """``count`` worlds from ``seed`` on; with a folder, its specimen files in turn override what the seeds draw.

    Without ``count`` each file is used once, or there are ``COUNT`` drawn ones.

    Raises:
        ConfigError: the folder holds no specimen files, or one that is not allowed.
    """
    files: Sequence[Path | None] = [None] if folder is None else sorted(folder.glob("*.toml"))
    if not files:
        raise ConfigError(f"{folder}: found no specimen files (*.toml); name a folder that has some")
    count = count or (COUNT if folder is None else len(files))
    chosen = [World(seed + k, files[k % len(files)]) for k in range(count)]
    for world in chosen[: len(files)]:
        world.specimen()
    return chosen


def run_trials(
    trial: Callable[..., Figures],
    arguments: Mapping[str, tuple[Any, ...]],
    out: Path,
    *,
    workers: int,
    progress: Progress,
    stamp: Mapping[str, str] | None = None,
    cluster: str | None = None,
) -> dict[str, Figures]:
    """Run ``trial(*arguments[name])`` for each name, and keep what it tells as ``out/NAME.json``.

    Args:
        trial: a function at the top of a module.
        arguments: by name of the trial.
        out: is made if it is missing; trials that are there already are not run again.
        workers: processes.
        progress: called with the trials done and their number.
        stamp: what made the figures, such as versions and weights; a trial of another make is refused.
        cluster: address of a Dask scheduler, whose workers run them in place of processes here.

    Returns:
        The figures of each trial, in the order of ``arguments``.

    Raises:
        ConfigError: a file in ``out`` is not one of ours, or of another make; no cluster, or one of another version.
    """
    made_by = dict(stamp or {})
    out.mkdir(parents=True, exist_ok=True)
    files = {name: out / f"{name}.json" for name in arguments}
    missing = [name for name, file in files.items() if not file.exists()]
    for name, file in files.items():
        if name not in missing:
            _read(file, made_by)
    done = len(arguments) - len(missing)
    progress(done, len(arguments))
    others = set(active_children())
    with _executor(workers, cluster) as pool:
        running = {pool.submit(trial, *arguments[name]): name for name in missing}
        try:
            for ended in as_completed(running):
                file = files[running[ended]]
                scratch = file.with_suffix(".new")
                scratch.write_text(
                    json.dumps({"made_by": made_by, **ended.result()}, allow_nan=False), encoding="utf-8"
                )
                scratch.replace(file)
                done += 1
                progress(done, len(arguments))
        except BaseException:
            for waiting in running:
                waiting.cancel()
            pool.shutdown(wait=False)
            # A trial takes a minute, and some wait where nothing can cancel them; each leaves nothing but its scratch.
            for worker in set(active_children()) - others:
                worker.kill()
                worker.join()
            raise
    return {name: _read(file, made_by) for name, file in files.items()}


def _executor(workers: int, cluster: str | None) -> AbstractContextManager[Executor]:
    return ProcessPoolExecutor(workers) if cluster is None else _cluster(cluster)


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler.

    Raises:
        ConfigError: nobody there, or workers with another version of mill, or with none.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ConfigError("--cluster needs Dask: pip install 'micromill[cluster]'") from None
    try:
        client: Any = Client(address, timeout=CLUSTER_START_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ConfigError(f"cluster {address}: no Dask scheduler answers there ({error})") from None
    with client:
        own = version("micromill")
        try:
            found = client.run(_own_version)
        except ImportError as error:
            raise ConfigError(f"cluster {address}: install mill {own} on its workers: {error}") from None
        if not found:
            raise ConfigError(f"cluster {address}: it has no workers; start some with `dask worker {address}`")
        if others := {name: other for name, other in found.items() if other != own}:
            raise ConfigError(f"cluster {address}: found other versions of mill on workers, {others}, needs {own}")
        # A trial that falls is a trial: it is not to be run again elsewhere.
        yield client.get_executor(pure=False, retries=0)


def _own_version() -> str:
    return version("micromill")


def _read(file: Path, made_by: dict[str, str]) -> Figures:
    remedy = "remove it, and the study runs it again"
    try:
        figures = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(f"{file}: is no trial: {error}; {remedy}") from None
    found = figures.pop("made_by", None) if isinstance(figures, dict) else None
    if found != made_by:
        raise ConfigError(f"{file}: was made by {found}, not by {made_by}; {remedy}, or name another --out")
    return cast(Figures, figures)


def by_recipe(
    trials: Mapping[str, Figures], recipes: Sequence[str], names: Sequence[str]
) -> dict[str, tuple[Figures, list[Figures]]]:
    """Of each recipe: ``trials``, how many ``failed``, each named RMSE with its interval; and those that succeeded."""
    result: dict[str, tuple[Figures, list[Figures]]] = {}
    for recipe in recipes:
        mine = [trial for trial in trials.values() if trial["recipe"] == recipe]
        good = [trial for trial in mine if trial["failed"] is None]
        figures: Figures = {"trials": len(mine), "failed": len(mine) - len(good)}
        for name in names if good else ():
            value, low, high = rms_interval([trial[name] for trial in good])
            figures |= {name: value, f"{name}_low": low, f"{name}_high": high}
        result[recipe] = (figures, good)
    return result


def rms(values: npt.ArrayLike) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def rms_interval(per_trial_rms: npt.ArrayLike) -> tuple[float, float, float]:
    """RMS over trials of equal size, and its 95 % interval over trials (bootstrap, percentile); equal for one trial."""
    values = np.asarray(per_trial_rms, dtype=np.float64)
    if len(values) < 2 or np.ptp(values) == 0.0:
        return rms(values), rms(values), rms(values)
    found = bootstrap((values**2,), np.mean, n_resamples=2000, method="percentile", rng=np.random.default_rng(0))
    low, high = np.sqrt(found.confidence_interval)
    return rms(values), float(low), float(high)


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (Wilson 1927)."""
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    center = share + Z_95**2 / (2 * trials)
    half = Z_95 * math.sqrt(share * (1 - share) / trials + Z_95**2 / (4 * trials**2))
    scale = 1 + Z_95**2 / trials
    return max(0.0, (center - half) / scale), min(1.0, (center + half) / scale)


def share_of(name: str, successes: int, trials: int) -> Figures:
    """A share with its 95 % interval (Wilson), as figures."""
    low, high = wilson(successes, trials)
    return {name: successes / trials if trials else None, f"{name}_low": low, f"{name}_high": high}
