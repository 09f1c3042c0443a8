import json
import re

import numpy as np
import pytest
import torch

from drivers.errors import ConfigError, DetectionError
from vision.runtime import MANIFEST, WEIGHTS, Network, write_manifest
from vision.training import export


class Double(torch.nn.Module):
    def forward(self, x):
        return x * 2.0


class DoubleTask:
    name = "double"

    def example(self, data):
        return {"x": torch.ones(3)}


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "double.onnx"
    export(DoubleTask(), Double(), path, {})
    return path


def test_runs_what_was_exported(weights):
    (answer,) = Network(weights).run(x=np.array([1, 2, 3], np.float32))
    assert answer.tolist() == [2, 4, 6]


def test_missing_weights_name_the_file_and_the_next_step(tmp_path):
    with pytest.raises(
        ConfigError, match=re.escape(f"{tmp_path}/tip.onnx: no such weights; ") + ".*mill train tip --out"
    ):
        Network(tmp_path / "tip.onnx")


def test_a_changed_byte_is_refused_with_both_hashes(weights):
    good = Network(weights).sha256
    weights.write_bytes(weights.read_bytes()[:-1] + b"?")
    with pytest.raises(ConfigError, match=f"SHA-256 [0-9a-f]{{64}} found, {good} expected by .*mill train TASK --out"):
        Network(weights)


def test_weights_that_no_manifest_knows_are_refused(weights):
    (weights.parent / MANIFEST).unlink()
    with pytest.raises(ConfigError, match="none expected"):
        Network(weights)


def test_a_broken_manifest_is_named(weights):
    (weights.parent / MANIFEST).write_text("{")
    with pytest.raises(ConfigError, match=MANIFEST):
        Network(weights)


def test_the_manifest_keeps_the_other_files(weights):
    write_manifest(weights, {"seed": 5})
    other = weights.with_name("other.onnx")
    other.write_bytes(b"x")
    write_manifest(other, {})
    manifest = json.loads((weights.parent / MANIFEST).read_text())
    assert set(manifest) == {"double.onnx", "other.onnx"}
    assert manifest["double.onnx"]["seed"] == 5


def test_a_picture_of_another_size_is_named(weights):
    with pytest.raises(DetectionError, match=r"x has shape \(4,\); allowed: \(3,\)"):
        Network(weights).run(x=np.ones(4, np.float32))


def test_nan_is_no_answer(weights):
    with pytest.raises(DetectionError, match="NaN"):
        Network(weights).run(x=np.array([1, np.nan, 3], np.float32))


@pytest.mark.parametrize("task", ["tip", "landmarks", "completion"])
def test_shipped_weights_are_small_and_as_described(task):
    path = WEIGHTS / f"{task}.onnx"
    Network(path)
    assert path.stat().st_size < 4e6


def test_weights_of_another_task_are_refused(weights):
    write_manifest(weights, {"task": "tip"})
    with pytest.raises(ConfigError, match="weights for tip; those for landmarks are needed"):
        Network(weights, "landmarks")


def test_weights_of_another_version_are_refused(weights):
    write_manifest(weights, {"task": "tip"})
    with pytest.raises(
        ConfigError, match=r"takes x, picture is needed: another version of mill .* mill train tip --out"
    ):
        Network(weights, "tip")
