"""How a network is trained, exported and made trustworthy: one loop for every task.

Each step draws its batch from the seed and its own number, so a killed training resumes from its checkpoint and ends
where the uninterrupted one would have ended.
"""

import hashlib
import math
import pickle
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
import onnx
import torch
from torch import Tensor, nn

from drivers.errors import ConfigError
from vision.runtime import Image, Network, write_manifest
from vision.samples import Arrays, Data

Batch = dict[str, Tensor]
Progress = Callable[[int, int, float], None]
"""Called with the step, the number of steps and the loss."""

CHECKPOINT_STEPS = 100
CHECKS = 20
"""How often a training is judged on validation data."""
CHECK_BATCHES = 6
DIGEST_BYTES = 1 << 24
DRAWS = 400
"""For an interval."""
PARITY = 2e-3
"""Largest difference allowed between torch and the exported file."""


@dataclass(frozen=True)
class Recipe:
    """How long and how fast."""

    batch: int
    learning_rate: float
    steps: int = 0
    epochs: int = 0
    """In place of ``steps``: how often each sample is drawn."""
    plan: Literal["one-cycle", "three-rates"] = "one-cycle"
    """AdamW with a warm-up and a long decay; or Adam at the rate, a tenth and a hundredth of it, a third each."""

    patience: int = 8
    """A training ends once so many of its ``CHECKS`` have brought nothing better."""

    def steps_for(self, samples: int) -> int:
        """How many steps a training on so many samples takes."""
        return self.steps or math.ceil(self.epochs * samples / self.batch)


@dataclass(frozen=True)
class History:
    """How a training went."""

    losses: tuple[float, ...]
    """Of each step."""
    checks: tuple[tuple[int, float], ...]
    """Step and loss on validation data."""


@dataclass(frozen=True)
class Worst:
    """One of the worst readings, to be looked at."""

    picture: Image
    """With the truth and the reading drawn in."""
    caption: str


class Task(Protocol):
    """What a network is to learn."""

    name: str
    recipes: Mapping[str, Recipe]
    arrays: Arrays

    def network(self) -> nn.Module:
        """A fresh network."""

    def batch(self, data: Data, size: int, rng: np.random.Generator) -> Batch:
        """A batch drawn from the training data, with its augmentation."""

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """What the training makes small."""

    def example(self, data: Data) -> dict[str, Tensor]:
        """Inputs of the exported network, by name: the first sample of ``data``."""

    def calibrate(self, network: Network, data: Data) -> dict[str, float]:
        """Constants measured on validation data, which make the network's own doubts honest."""

    def judge(self, network: Network, data: Data) -> dict[str, float]:
        """Figures on held-out data, with the unit in each key."""

    def judge_draws(
        self, network: Network, data: Data, draws: Iterable[npt.NDArray[np.int64]]
    ) -> list[dict[str, float]]:
        """The same of each of several draws of the samples, which are read once."""

    def worst(self, network: Network, data: Data, count: int) -> list[Worst]:
        """The readings that are furthest off, the worst first."""


def train(
    task: Task, data: Data, validation: Data, recipe: Recipe, *, seed: int, checkpoint: Path, progress: Progress
) -> tuple[nn.Module, History]:
    """Train a network, resuming from ``checkpoint`` where one of the same task, recipe, seed and data is found.

    It is judged ``CHECKS`` times on the way by its loss on ``validation``; the best of them is what comes back, and the
    training ends early once the best is ``patience`` checks old.

    Returns:
        The network, and the losses on the way.

    Raises:
        ConfigError: the checkpoint is of another training, or the loss is not a number.
    """
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = task.network().train().to(device)
    steps = recipe.steps_for(len(next(iter(data.values()))))
    optimizer, schedule = _plan(network, recipe, steps)
    identity = {"task": task.name, "seed": seed, **asdict(recipe), "steps": steps}
    identity["data"] = [_digest(part) for part in (data, validation)]
    state: dict[str, Any] = {"step": 0, "best": None, "losses": [], "checks": []}
    if checkpoint.is_file():
        state = _resumed(checkpoint, identity)
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        schedule.load_state_dict(state["schedule"])

    def drawn(step: int) -> Batch:
        return task.batch(data, recipe.batch, np.random.default_rng((seed, step)))

    held_out = [task.batch(validation, recipe.batch, np.random.default_rng((seed, 1, k))) for k in range(CHECK_BATCHES)]
    every = max(1, steps // CHECKS)
    # The next batch is made while the network computes: pictures are cut and relit without the interpreter's lock.
    with ThreadPoolExecutor(1) as maker:
        coming = maker.submit(drawn, state["step"])
        for step in range(state["step"], steps):
            batch = _on(device, coming.result())
            coming = maker.submit(drawn, step + 1)
            with torch.autocast(device, dtype=torch.bfloat16):
                loss = task.loss(network, batch)
            _require_finite(loss.item(), task.name, step + 1, checkpoint)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            schedule.step()
            state["step"] = step + 1
            state["losses"].append(loss.item())
            progress(step + 1, steps, loss.item())
            if (step + 1) % every == 0 or step + 1 == steps:
                check = _held_out_loss(task, network, held_out, device)
                state["checks"].append((step + 1, check))
                _require_finite(check, f"{task.name} on validation data", step + 1, checkpoint)
                if check <= min(value for _, value in state["checks"]):
                    state["best"] = {name: value.detach().clone() for name, value in network.state_dict().items()}
                if _stale(state["checks"], recipe.patience):
                    break
            if (step + 1) % CHECKPOINT_STEPS == 0:
                _save(checkpoint, identity, state, network, optimizer, schedule)
    network.load_state_dict(state["best"])
    return network.cpu().eval(), History(tuple(state["losses"]), tuple(tuple(check) for check in state["checks"]))


def _require_finite(loss: float, what: str, step: int, checkpoint: Path) -> None:
    if not math.isfinite(loss):
        raise ConfigError(
            f"the loss of {what} is not a number at step {step}; look through the data, or use another --seed; "
            f"nothing was written but {checkpoint}"
        )


def _digest(data: Data) -> str:
    """Of the labels and of all shapes: pictures are too many to be read for it."""
    found = hashlib.sha256()
    for name, values in sorted(data.items()):
        found.update(f"{name} {values.shape}".encode())
        if values.nbytes <= DIGEST_BYTES:
            found.update(np.ascontiguousarray(values).tobytes())
    return found.hexdigest()


def _on(device: str, batch: Batch) -> Batch:
    return {name: value.to(device) for name, value in batch.items()}


def _stale(checks: list[tuple[int, float]], patience: int) -> bool:
    """Whether the best check is ``patience`` old."""
    values = [value for _, value in checks]
    return len(values) - 1 - values.index(min(values)) >= patience


def _held_out_loss(task: Task, network: nn.Module, batches: list[Batch], device: str) -> float:
    network.eval()
    with torch.no_grad(), torch.autocast(device, dtype=torch.bfloat16):
        losses = [task.loss(network, _on(device, batch)).item() for batch in batches]
    network.train()
    return float(np.mean(losses))


def _resumed(checkpoint: Path, identity: dict[str, Any]) -> dict[str, Any]:
    try:
        saved: dict[str, Any] = torch.load(checkpoint, map_location="cpu", weights_only=True)
        found = saved["identity"]
    except (OSError, RuntimeError, KeyError, TypeError, EOFError, pickle.UnpicklingError):
        raise ConfigError(f"{checkpoint}: is no checkpoint of a training; delete it to start anew") from None
    if found != identity:
        raise ConfigError(f"{checkpoint}: checkpoint of {found} found, {identity} expected; delete it to start anew")
    return saved


def _save(
    checkpoint: Path,
    identity: dict[str, Any],
    state: dict[str, Any],
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
) -> None:
    parts: dict[str, Any] = {"network": network, "optimizer": optimizer, "schedule": schedule}
    scratch = checkpoint.with_suffix(".new")
    torch.save({**state, "identity": identity, **{name: part.state_dict() for name, part in parts.items()}}, scratch)
    scratch.replace(checkpoint)


def _plan(
    network: nn.Module, recipe: Recipe, steps: int
) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
    if recipe.plan == "three-rates":
        adam = torch.optim.Adam(network.parameters(), lr=recipe.learning_rate)
        return adam, torch.optim.lr_scheduler.MultiStepLR(adam, [steps // 3, 2 * steps // 3])
    adam_w = torch.optim.AdamW(network.parameters(), lr=recipe.learning_rate, weight_decay=1e-4)
    one_cycle = torch.optim.lr_scheduler.OneCycleLR
    return adam_w, one_cycle(adam_w, max_lr=recipe.learning_rate, total_steps=steps, pct_start=0.1)


def finish(
    task: Task, network: nn.Module, path: Path, validation: Data, test: Data, about: Mapping[str, Any]
) -> dict[str, float]:
    """Export a trained network, calibrate it, judge it, and only then put it to ``path`` and into the manifest there.

    Returns:
        The figures on ``test``.

    Raises:
        ConfigError: the network is not fit for use; what was at ``path`` stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as scratch:
        draft = Path(scratch) / path.name
        export(task, network, draft, validation)
        _set_constants(draft, task.calibrate(Network(draft), validation))
        write_manifest(draft, {})
        figures, intervals = judged(task, Network(draft), test)
        draft.replace(path)
    write_manifest(path, {**about, "held_out": figures, "held_out_95": intervals})
    return figures


def judged(task: Task, network: Network, data: Data) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Figures on held-out data, and the 95 % interval of each over the samples (bootstrap, percentile).

    A figure that every draw has alike, such as that nothing was missed, tells no interval, nor does a worst case.
    """
    count = len(next(iter(data.values())))
    draws = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    figures, *drawn = task.judge_draws(network, data, [np.arange(count), *draws])
    intervals = {}
    for name in figures:
        values = np.array([each.get(name, math.nan) for each in drawn])
        values = values[np.isfinite(values)]
        if "worst" not in name and len(values) and values.min() < values.max():
            low, high = np.percentile(values, [2.5, 97.5])
            intervals[name] = (float(low), float(high))
    return figures, intervals


def export(task: Task, network: nn.Module, path: Path, data: Data) -> None:
    """Write ONNX, and make sure that ONNX Runtime computes what torch does from the first sample of ``data``."""
    example = task.example(data)
    network.eval()
    with warnings.catch_warnings():
        # The tracing exporter is announced to go; its successor needs a package that nothing else here needs.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            tuple(example.values()),
            path,
            dynamo=False,
            opset_version=17,
            input_names=list(example),
            output_names=None,
        )
    write_manifest(path, {})
    answers = Network(path).run(**{name: value.numpy() for name, value in example.items()})
    with torch.no_grad():
        expected = network(*example.values())
    for answer, wanted in zip(answers, expected if isinstance(expected, tuple) else (expected,), strict=True):
        difference = float(np.abs(answer - wanted.numpy()).max())
        if difference > PARITY:
            raise ConfigError(f"{path}: differs from torch by {difference:.2e}; allowed {PARITY:.0e}; export anew")


def _set_constants(path: Path, constants: Mapping[str, float]) -> None:
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {key: repr(float(value)) for key, value in constants.items()})
    onnx.save(model, path)
