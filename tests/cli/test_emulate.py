"""`mill emulate` as its own process."""

import json
import signal
import subprocess
import sys
import time

import pytest

from cli.config import load_rig

COMMAND = [sys.executable, "-m", "cli.main", "emulate"]


@pytest.fixture
def started(tmp_path):
    """A bench of seed 4 in another process, with its rig file and its truth."""
    rig_file, truth_file = tmp_path / "rig.toml", tmp_path / "truth.json"
    arguments = ["--seed", "4", "--rig-out", str(rig_file), "--truth-out", str(truth_file), "--until-stdin-closes"]
    process = subprocess.Popen([*COMMAND, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    deadline_s = time.monotonic() + 120.0
    while not rig_file.is_file():
        assert process.poll() is None
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    yield process, rig_file, truth_file
    process.kill()
    process.communicate()


def test_the_rig_file_loads_and_the_bench_ends_with_its_parent(started):
    process, rig_file, truth_file = started
    rig = load_rig(rig_file)
    assert rig.motion.settings["$100"] == 1000
    assert rig.motion.origin_mm == (-25.0, -10.0, -20.0)
    assert rig.camera.size_px == (960, 540)
    assert rig.tool.ball_radius_mm == 0.5
    assert rig.bench.park_mm == (23.0, -10.0, 12.0)
    said, _ = process.communicate(timeout=20.0)
    assert process.returncode == 0
    assert f"mill doctor --rig {rig_file}" in said.decode()
    assert json.loads(truth_file.read_text())["membrane_touched"] is False


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_bench_in_order(started, number):
    process, _, truth_file = started
    process.send_signal(number)
    assert process.wait(timeout=20.0) == 0
    assert truth_file.is_file()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--specimen", "nowhere.toml"], ["nowhere.toml"]),
        (["--specimen", "bad.toml"], ["bad.toml", "thicknes_mm"]),
        (["--rig-out", "no/such/folder/rig.toml"], ["no/such/folder"]),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(tmp_path, arguments, words):
    (tmp_path / "bad.toml").write_text("[skull]\nthicknes_mm = 3\n")
    done = subprocess.run([*COMMAND, *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert all(word in done.stderr for word in words)
