"""How a network is trained, exported and made trustworthy: one loop for every task.

Each step draws its batch from the seed and its own number, so a killed training resumes from its checkpoint and ends
where the uninterrupted one would have ended.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt
import onnx
import torch
from torch import Tensor, nn

from drivers.errors import ConfigError
from vision.runtime import Image, Network, write_manifest

Batch = dict[str, Tensor]
Data = Mapping[str, npt.NDArray[Any]]
Progress = Callable[[int, int, float], None]
"""Called with the step, the number of steps and the loss."""

CHECKPOINT_STEPS = 100
PARITY = 2e-3
"""Largest difference allowed between torch and the exported file."""


@dataclass(frozen=True)
class Recipe:
    """How long and how fast."""

    steps: int
    batch: int
    learning_rate: float


class Task(Protocol):
    """What a network is to learn."""

    name: str
    recipes: Mapping[str, Recipe]

    def network(self) -> nn.Module:
        """A fresh network."""

    def batch(self, data: Data, size: int, rng: np.random.Generator) -> Batch:
        """A batch drawn from the training data, with its augmentation."""

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """What the training makes small."""

    def example(self) -> dict[str, Tensor]:
        """Inputs of the exported network, by name."""

    def calibrate(self, network: Network, data: Data) -> dict[str, float]:
        """Constants measured on validation data, which make the network's own doubts honest."""

    def judge(self, network: Network, data: Data) -> dict[str, float]:
        """Figures on held-out data, with the unit in each key."""


def load_data(folder: Path, split: str) -> Data:
    """The arrays of ``folder/split``, mapped rather than read."""
    files = sorted((folder / split).glob("*.npy"))
    if not files:
        raise ConfigError(f"{folder / split}: found no .npy arrays; leave --data out to have pictures rendered")
    return {file.stem: np.load(file, mmap_mode="r", allow_pickle=False) for file in files}


def train(task: Task, data: Data, recipe: Recipe, *, seed: int, checkpoint: Path, progress: Progress) -> nn.Module:
    """Train a network, resuming from ``checkpoint`` where one of the same task, recipe and seed is found."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    network = task.network().train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=recipe.learning_rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=recipe.learning_rate, total_steps=recipe.steps, pct_start=0.1
    )
    identity = {"task": task.name, "seed": seed, **asdict(recipe)}
    first = 0
    if checkpoint.is_file():
        saved = torch.load(checkpoint, weights_only=True)
        if saved["identity"] != identity:
            raise ConfigError(
                f"{checkpoint}: checkpoint of {saved['identity']} found, {identity} expected; delete it to start anew"
            )
        network.load_state_dict(saved["network"])
        optimizer.load_state_dict(saved["optimizer"])
        schedule.load_state_dict(saved["schedule"])
        first = saved["step"]
    for step in range(first, recipe.steps):
        batch = task.batch(data, recipe.batch, np.random.default_rng((seed, step)))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            loss = task.loss(network, batch)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        progress(step + 1, recipe.steps, loss.item())
        if (step + 1) % CHECKPOINT_STEPS == 0:
            scratch = checkpoint.with_suffix(".new")
            torch.save(
                {
                    "identity": identity,
                    "step": step + 1,
                    "network": network.state_dict(),
                    "optimizer": optimizer.state_dict(),
                    "schedule": schedule.state_dict(),
                },
                scratch,
            )
            scratch.replace(checkpoint)
    return network.eval()


def finish(
    task: Task, network: nn.Module, path: Path, validation: Data, test: Data, about: Mapping[str, Any]
) -> dict[str, float]:
    """Export a trained network to ``path``, calibrate it, judge it, and enter it into the manifest beside it.

    Returns:
        The figures on ``test``.
    """
    export(task, network, path)
    write_manifest(path, about)
    constants = task.calibrate(Network(path), validation)
    _set_constants(path, constants)
    write_manifest(path, about)
    figures = task.judge(Network(path), test)
    write_manifest(path, {**about, "held_out": figures})
    return figures


def export(task: Task, network: nn.Module, path: Path) -> None:
    """Write ONNX, and make sure that ONNX Runtime computes what torch does."""
    example = task.example()
    path.parent.mkdir(parents=True, exist_ok=True)
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


def relit(picture: Image, rng: np.random.Generator) -> Image:
    """The same picture under another light and through another camera: gain, gamma, tint, haze, blur, noise."""
    level = np.arange(256, dtype=np.float32) / 255.0
    gamma = np.exp(rng.uniform(-0.35, 0.35))
    gain = np.exp(rng.uniform(-0.25, 0.25) + rng.uniform(-0.1, 0.1, size=picture.shape[2]))
    offset = rng.uniform(-0.05, 0.05)
    table = np.clip(255.0 * (gain[None, :] * level[:, None] ** gamma + offset), 0, 255).astype(np.uint8)
    result = np.stack([cv2.LUT(picture[..., c], table[:, c]) for c in range(picture.shape[2])], axis=-1)
    if rng.random() < 0.25:
        result = cv2.GaussianBlur(result, (0, 0), rng.uniform(0.4, 1.6))
    if rng.random() < 0.3:
        noise = rng.normal(0.0, rng.uniform(1.0, 5.0), size=picture.shape).astype(np.float32)
        result = np.clip(result + noise, 0, 255)
    return np.asarray(result, dtype=np.uint8)
