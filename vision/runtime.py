"""The one inference seam: ONNX Runtime, one thread, no spinning, weights that are what the manifest says.

One thread per model: two threads that spin for each other starve the control loop on a busy machine.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.errors import ConfigError, DetectionError

Image = npt.NDArray[np.uint8]
"""A picture: (H, W, 3), RGB."""
Floats = npt.NDArray[np.floating[Any]]

WEIGHTS = Path(__file__).parent / "weights"
MANIFEST = "manifest.json"


class Network:
    """A trained network, loaded once and run many times."""

    def __init__(self, path: Path, task: str | None = None) -> None:
        """Load ``path``, which must have been trained for ``task`` if one is named.

        Raises:
            ConfigError: the file is missing, is not the one that ``manifest.json`` beside it describes, was trained for
                another task, or takes something else than that task's network.
        """
        self.sha256 = verify(path, task)
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.add_session_config_entry("session.inter_op.allow_spinning", "0")
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self._shapes = {entry.name: tuple(entry.shape) for entry in self._session.get_inputs()}
        if task is not None and set(self._shapes) != {INPUTS[task]}:
            raise ConfigError(
                f"{path}: takes {', '.join(self._shapes)}, {INPUTS[task]} is needed: another version of mill made it; "
                f"train it anew: mill train {task} --out {path}"
            )
        self.path = path
        self.constants: Mapping[str, float] = {
            key: float(value) for key, value in self._session.get_modelmeta().custom_metadata_map.items()
        }
        """Figures that were measured after training and belong to these weights."""

    def run(self, **inputs: npt.NDArray[Any]) -> Sequence[npt.NDArray[Any]]:
        """All outputs, in the order of the file.

        Raises:
            DetectionError: an input of another shape than the network was made for, or an output that is not finite.
        """
        for name, value in inputs.items():
            if value.shape != self._shapes[name]:
                raise DetectionError(
                    f"{self.path.name}: {name} has shape {value.shape}; allowed: {self._shapes[name]}; "
                    "check the cameras' picture size"
                )
        outputs = self._session.run(None, inputs)
        if not all(np.isfinite(output).all() for output in outputs):
            raise DetectionError(f"{self.path.name}: the network answered NaN or infinity; take another picture")
        return outputs  # type: ignore[no-any-return]


def sha256_of(path: Path) -> str:
    """Hash of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


INPUTS = {"tip": "picture", "landmarks": "picture", "completion": "strips"}
"""What the network of each task is shown."""
TASKS = tuple(INPUTS)
"""What networks are trained for, and the names of the weights that come with mill."""


def verify(path: Path, task: str | None = None) -> str:
    """Check ``path`` against the manifest beside it and return its hash."""
    named = task or (path.stem if path.stem in TASKS else "TASK")
    remedy = f"restore the file, or train it anew: mill train {named} --out {path}"
    if not path.is_file():
        raise ConfigError(f"{path}: no such weights; {remedy}")
    found = sha256_of(path)
    about = read_manifest(path.parent).get(path.name, {})
    expected = about.get("sha256")
    if found == expected and task is not None and about.get("task", task) != task:
        raise ConfigError(f"{path}: weights for {about['task']}; those for {task} are needed; {remedy}")
    if found != expected:
        raise ConfigError(
            f"{path}: SHA-256 {found} found, {expected or 'none'} expected by {path.parent / MANIFEST}; {remedy}"
        )
    return found


def read_manifest(folder: Path) -> dict[str, dict[str, Any]]:
    """What is known of each weights file of a folder: its hash, and how it was trained and judged."""
    file = folder / MANIFEST
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}; restore it with the weights it belongs to") from None
    if not isinstance(manifest, dict) or not all(isinstance(entry, dict) for entry in manifest.values()):
        raise ConfigError(f"{file}: found something else than an object per weights file; restore it")
    return manifest


def write_manifest(path: Path, about: Mapping[str, Any]) -> None:
    """Enter a new weights file into the manifest beside it, also where several trainings end at once."""
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        manifest = read_manifest(path.parent)
        manifest[path.name] = {"sha256": sha256_of(path), **about}
        text = json.dumps(dict(sorted(manifest.items())), indent=2) + "\n"
        scratch = path.parent / f".{MANIFEST}.new"
        scratch.write_text(text, encoding="utf-8")
        scratch.replace(path.parent / MANIFEST)
    finally:
        os.close(folder)
