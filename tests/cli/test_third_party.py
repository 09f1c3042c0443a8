"""A package of another make, installed by pip and found by every command (docs/add-a-device.md)."""

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from mill_command import mill
from served_bench import MILL, line_from

from calib.calibration_file import Calibration, Provenance, RigIdentity
from calib.camera_fit import fit_camera_pair
from drivers.clock import SystemClock
from firmware_sim.clock import SimClock
from firmware_sim.mjpeg_camera import MjpegCameras
from milling.job import Job
from milling.record import RunRecorder

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "tests/plugin_example"


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """One in which the example package is installed."""
    folder = tmp_path_factory.mktemp("installed")
    source, target = folder / "source", folder / "target"
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-build-isolation", "--no-deps", "--no-index"]
    done = subprocess.run([*pip, "--target", str(target), str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    path = os.pathsep.join([str(target), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path}


class Emulator:
    """The example's own emulator, and which devices a host has opened since it was last asked."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._lines = process.stdout
        self.ports: dict[str, str] = json.loads(line_from(process.stdout))

    def opened(self) -> set[str]:
        assert self._lines is not None
        os.set_blocking(self._lines.fileno(), False)
        return set((self._lines.read() or b"").decode().split())


@pytest.fixture(scope="module")
def emulator(environment: dict[str, str]) -> Iterator[Emulator]:
    command, pipe = [sys.executable, "-m", "mill_example.emulator"], subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, bufsize=0) as process:
        yield Emulator(process)
        assert process.stdin is not None
        process.stdin.close()
        process.wait(10.0)


@pytest.fixture(scope="module")
def cameras() -> Iterator[MjpegCameras]:
    """Pictures of their number: one that never changes is that of a broken camera."""
    served, over, clock = MjpegCameras(), threading.Event(), SystemClock()
    ground = np.random.default_rng(0).integers(60, 120, (540, 960, 3), dtype=np.uint8)

    def expose() -> None:
        number = 0
        while not over.wait(0.05):
            number += 1
            picture = cv2.putText(ground.copy(), str(number), (300, 300), 0, 4.0, (255,) * 3, 5)
            jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
            served.publish(jpeg, jpeg, clock.now_s())

    thread = threading.Thread(target=expose)
    thread.start()
    yield served
    over.set()
    thread.join(5.0)
    served.close()


@pytest.fixture(scope="module")
def rig(emulator: Emulator, cameras: MjpegCameras, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    path.write_text(f"""
schema = 1
name = "another make"
[motion]
backend = "example"
port = "{emulator.ports["motion"]}"
[spindle]
backend = "example"
port = "{emulator.ports["spindle"]}"
speed_rpm = 20000.0
[camera]
left = "{cameras.url("left")}"
right = "{cameras.url("right")}"
fps = 20
[certificate]
required = false
""")
    return path


def calibration(path: Path) -> Path:
    """A good one, of another rig: what uses it has opened its devices and asked for their names."""
    points_mm = np.random.default_rng(0).uniform((0.0, -20.0, 0.0), (10.0, 0.0, 10.0), (16, 3))
    across_px, down_px = 480.0 + (points_mm[:, 1] + 10.0) / 0.0395, 270.0 + (points_mm[:, 0] - 5.0) / 0.0395
    left_px, right_px = (
        np.column_stack([across_px + sign * 3.2 * points_mm[:, 2], down_px]).round(1) for sign in (1.0, -1.0)
    )
    fit = fit_camera_pair(points_mm, left_px, right_px, size_px=(960, 540), detector_sigma_px=0.3)
    made = Provenance(date=datetime.now(UTC).isoformat(timespec="seconds"))
    other = RigIdentity(motion="stage 6", camera="eyes L1 R2")
    Calibration(fit.pair, "default", fit.model, {}, "right-handed", False, fit.rmse_mm, (), other, made).save(path)
    return path


def begun_run(folder: Path) -> Path:
    """The record of a window that was begun and stopped."""
    job = Job()
    theta = 2 * np.pi * np.arange(1, job.n_points + 1) / job.n_points
    ring = np.column_stack([2 * np.cos(theta), 2 * np.sin(theta), 0 * theta]).tolist()
    zeros = [0.0] * job.n_points
    rows = dict.fromkeys(("fit_mm", "normals", "ball_mm", "tip_mm"), ring)
    heights = {"sigma_mm": zeros, "contact_z_mm": zeros}
    header = {"command": "run", "seed": None, "job": asdict(job)}
    with RunRecorder(folder, header, SimClock()) as recorder:
        recorder.frame("reference_left", np.zeros((540, 960, 3), np.uint8))
        recorder.event("trajectory", center_mm=[0.0, 0.0, 0.0], offset_mm=0.5, note="", **rows, **heights)
        for point in range(1, job.n_points + 1):
            recorder.event("contact", point=point, z_mm=0.0)
        recorder.event("cut", point=1, depth_mm=0.05)
    calibration(folder / "calibration.toml")
    return folder


def call(environment: dict[str, str], folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([*MILL, *words], env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    return done


@pytest.mark.parametrize(
    ("command", "words", "code", "says", "opens"),
    [
        ("devices", [], 0, r"serial +/dev/pts/\d+ +ready", set()),
        ("devices", ["--identify"], 0, "not asked: backend 'example'", set()),
        ("jog", ["--home", "--by", "-1", "0", "-2"], 0, r"idle .*x 28.000  y 14.000  z 12.000", {"motion"}),
        ("stop", [], 0, "motion: stopped\nspindle: stopped", {"motion", "spindle"}),
        ("doctor", ["--no-motion"], 0, r"motion: identity +Example stage 1.0 S7", {"motion", "spindle"}),
        ("calibrate", ["--verify", "--out", "cal.toml"], 2, "another rig.*Example stage", {"motion", "spindle"}),
        ("run", ["--calibration", "cal.toml"], 2, "another rig.*Example stage 1.0 S7", {"motion", "spindle"}),
        ("resume", ["begun"], 2, "another rig.*Example stage 1.0 S7", {"motion", "spindle"}),
        ("support-bundle", ["--out", "bundle.zip"], 0, r"in +rig\.toml", set()),
        ("dataset", ["collect", "--out", "set", "--pairs", "1"], 0, "", {"motion", "spindle"}),
    ],
)
def test_every_command_opens_devices_of_another_make(
    environment: dict[str, str],
    emulator: Emulator,
    rig: Path,
    tmp_path: Path,
    command: str,
    words: list[str],
    code: int,
    says: str,
    opens: set[str],
) -> None:
    calibration(tmp_path / "cal.toml")
    if command == "resume":
        begun_run(tmp_path / "begun")
    emulator.opened()
    done = call(environment, tmp_path, command, *words, "--rig", str(rig))
    said = done.stdout + done.stderr
    assert done.returncode == code, said
    assert re.search(says, said), said
    assert opens <= emulator.opened()


@pytest.mark.parametrize(
    ("line", "wrong", "says"),
    [
        ('backend = "example"\nport', 'backend = "example"\nprot', r"\[motion\] (port|prot): .*allowed keys: port"),
        (
            'backend = "example"',
            'backend = "exmaple"',
            "motion.backend = 'exmaple': unknown; allowed: bcap, example, grbl, tinyg",
        ),
        ("/dev/pts/", "/dev/nowhere/", r"/dev/nowhere/\d+: cannot be opened.*mill devices"),
    ],
)
def test_what_is_wrong_is_said_as_of_any_device(
    environment: dict[str, str], rig: Path, tmp_path: Path, line: str, wrong: str, says: str
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(rig.read_text().replace(line, wrong, 1))
    done = call(environment, tmp_path, "jog", "--rig", str(path))
    assert done.returncode in {2, 3}
    assert done.stderr.count("\n") == 1
    assert re.search(says, done.stderr), done.stderr


def test_without_the_package_the_rig_file_is_refused(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("jog", "--rig", str(rig)) == 2
    assert "install the package that adds motion.example" in capsys.readouterr().err


def test_the_conformance_tests_hold_on_it(environment: dict[str, str], rig: Path) -> None:
    files = [str(ROOT / f"tests/conformance/test_{kind}.py") for kind in ("motion", "spindle")]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files, "--rig", str(rig)]
    done = subprocess.run(
        [*command, "-k", "hardware"], env=environment, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout
    assert int(re.findall(r"(\d+) passed", done.stdout)[0]) >= 16
