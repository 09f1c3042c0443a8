"""`mill emulate` as its own process."""

import json
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from served_bench import MILL, ServedBench, served_bench

from cli.config import BcapMotion, GrblMotion, OpenCvCamera, TinyGMotion, load_rig
from cli.makes import open_bcap
from cli.rig import WiredRig
from drivers.clock import SystemClock


@pytest.fixture
def started(tmp_path: Path) -> Iterator[ServedBench]:
    """A bench of seed 4."""
    with served_bench(tmp_path, ["--seed", "4"]) as bench:
        yield bench


def test_the_rig_file_loads_and_the_bench_ends_with_its_parent(started: ServedBench) -> None:
    assert started.announced.endswith(f"mill doctor --rig {started.rig_file}\n")
    rig = load_rig(started.rig_file)
    assert isinstance(rig.motion, GrblMotion)
    assert isinstance(rig.camera, OpenCvCamera)
    assert rig.motion.settings["$100"] == 1000
    assert rig.motion.origin_mm == (-25.0, -10.0, -20.0)
    assert rig.camera.size_px == (960, 540)
    assert rig.tool.ball_radius_mm == 0.5
    assert rig.bench.park_mm == (23.0, -10.0, 12.0)
    started.process.communicate(timeout=20.0)
    assert started.process.returncode == 0
    assert json.loads(started.truth_file.read_text())["membrane_touched"] is False


def test_a_g2core_board_is_opened_by_its_rig_file(tmp_path: Path) -> None:
    with served_bench(tmp_path, ["--seed", "4", "--motion", "tinyg"]) as bench:
        rig = load_rig(bench.rig_file)
        assert isinstance(rig.motion, TinyGMotion)
        assert rig.motion.settings["ztn"] == -28
        with WiredRig(rig, SystemClock()).open_motion() as motion:
            assert motion.identity.startswith("g2core 101.03")
            assert motion.travel.low_mm == (-10.0, -30.0, -8.0)


def test_a_robot_is_served_over_udp(tmp_path: Path) -> None:
    with served_bench(tmp_path, ["--seed", "4", "--motion", "bcap"]) as bench:
        rig = load_rig(bench.rig_file)
        assert isinstance(rig.motion, BcapMotion)
        with open_bcap(rig.motion, SystemClock(), silence_s=0.55) as robot:
            assert "mill-bench-" in robot.identity
            robot.home()
            assert robot.travel.contains(robot.status().position_mm)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_bench_in_order(started: ServedBench, number: signal.Signals) -> None:
    started.process.send_signal(number)
    assert started.process.wait(timeout=20.0) == 0
    assert started.truth_file.is_file()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--specimen", "nowhere.toml"], ["nowhere.toml"]),
        (["--specimen", "bad.toml"], ["bad.toml", "thicknes_mm"]),
        (["--motion", "tinyg", "--dialect", "grblhal"], ["--dialect grblhal", "--motion grbl"]),
        (["--motion", "tinyg", "--fault", "motion.alarm=5"], ["motion.alarm=5", "limit switch"]),
        (["--rig-out", "no/such/folder/rig.toml"], ["no/such/folder"]),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    (tmp_path / "bad.toml").write_text("[skull]\nthicknes_mm = 3\n")
    command = [*MILL, "emulate", *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert all(word in done.stderr for word in words)
