"""The commands on real wires: a bench in another process, its rig file, and nothing else that they share."""

import csv
import errno
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import serial
from mill_command import mill
from pytest_mock import MockerFixture
from served_bench import MILL, line_from, served_bench

from calib.calibration_file import Calibration, Provenance, RigIdentity
from calib.camera_fit import fit_camera_pair
from cli.config import load_rig
from cli.doctor import software
from cli.rig import WiredRig
from doctor.certificate import Certificate, require
from drivers.clock import SystemClock
from drivers.lock import owner_of
from drivers.motion.grbl.driver import GrblController
from drivers.motion.serial_line import open_serial
from drivers.spindle.cia402 import Cia402Spindle
from drivers.trace_file import read_trace

HOLDER = """
import signal, sys
from drivers.motion.serial_line import open_serial
line = open_serial(sys.argv[1], 115200)
if sys.argv[2] == "stubborn":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
line.write(b"G91G1X-5F60\\n")
print("holding", flush=True)
signal.alarm(60)
while True:
    signal.pause()
"""
"""Holds the motion port and knows nothing of stopping well."""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The rig file of a served bench, with the bench's truth beside it."""
    with served_bench(tmp_path_factory.mktemp("bench")) as served:
        yield served.rig_file


def test_pictures_are_collected_with_the_state_of_the_devices(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "set"
    words = ["dataset", "collect", "--rig", str(bench), "--out", str(out), "--pairs", "2", "--every", "0"]
    assert mill(*words) == 0
    with (out / "state.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(first["exposed_at_s"]) < float(second["exposed_at_s"])
    assert float(first["speed_rpm"]) == 0
    assert all(-100 < float(first[axis]) < 100 for axis in ("x_mm", "y_mm", "z_mm"))
    for name in (first["left"], second["right"]):
        assert cv2.imread(str(out / "images" / name)).shape == (540, 960, 3)
    assert mill(*words) == 2
    assert "is there already" in capsys.readouterr().err


@pytest.mark.slow
def test_doctor_passes_and_every_check_says_what_it_is(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    results = tmp_path / "doctor.json"
    code = mill("doctor", "--rig", str(bench), "--json", str(results))
    report = json.loads(results.read_text())
    failed = [check for check in report["checks"] if check["verdict"] != "pass"]
    assert (code, failed) == (0, [])
    assert report["passed"] is True
    for check in report["checks"]:
        assert set(check) == {"name", "value", "unit", "limit", "verdict"}
    names = {check["name"] for check in report["checks"]}
    told = {"motion: hold to standstill", "spindle: speed after host silence", "camera: pairs per second"}
    assert told | {"stage: backlash of X", "computer: free disk"} <= names
    assert "every check passed" in capsys.readouterr().out
    certificate = Certificate.load(tmp_path / report["certificate"])
    assert certificate.settings["$100"] == 1000
    assert certificate.calibration is not None
    assert "Certified" in (tmp_path / report["report"]).read_text()
    there = (certificate.motion, certificate.spindle, certificate.camera)
    now = datetime.now(UTC)
    require(tmp_path / "certificates", there, certificate.settings, software=software(), max_age_h=1.0, now=now)


def test_a_run_asks_for_a_certificate_of_these_devices(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rig, calibration = tmp_path / "rig.toml", tmp_path / "calibration.toml"
    rig.write_text(bench.read_text().replace("required = false", "required = true"))
    calibration_of_another_rig(datetime.now(UTC)).save(calibration)
    assert mill("run", "--rig", str(rig), "--calibration", str(calibration)) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "no certificate of these devices; run `mill doctor --rig FILE` first" in said
    assert not (tmp_path / "runs").exists()


def test_jog_homes_and_goes_where_it_is_told(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("jog", "--rig", str(bench), "--home", "--to", "20", "5", "15", "--feed", "20") == 0
    assert capsys.readouterr().out == "idle  tip in {R}: x 20.000  y 5.000  z 15.000 mm\n"
    assert mill("jog", "--rig", str(bench), "--to", "20", "5", "99") == 3
    assert "mill: " in capsys.readouterr().err


def test_a_trace_of_a_jog_begins_with_its_opening_and_ends_with_its_closing(bench: Path, tmp_path: Path) -> None:
    file = tmp_path / "jog.jsonl"
    assert mill("jog", "--rig", str(bench), "--home", "--trace", str(file)) == 0
    log = read_trace(file)
    assert log.header["command"] == "jog"
    assert log.header["rig"]["motion"]["backend"] == "grbl"
    assert [entry.data["verb"] for entry in log.entries if entry.kind == "call"] == [
        "open", "home", "status", "status", "close"
    ]  # fmt: skip
    assert "$H\n" in [entry.data for entry in log.entries if entry.kind == "out"]
    assert mill("jog", "--rig", str(bench), "--home", "--trace", str(file)) == 2


def test_a_move_before_homing_names_the_next_step(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("jog", "--rig", str(bench), "--by", "0", "0", "1") == 3
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.endswith("the position is not trusted; add --home to this command\n")


def write_setting(rig_file: Path, line: bytes) -> None:
    """As somebody does who changes the controller behind mill's back."""
    port = open_serial(load_rig(rig_file).motion.model_dump()["port"], 115200)
    try:
        port.write(line + b"\n")
        said = b""
        while not said.endswith(b"ok\r\n"):
            part = port.read(5.0)
            assert part, "the board is silent"
            said += part
    finally:
        port.close()


def failed_checks(results: Path) -> dict[str, str]:
    checks = json.loads(results.read_text())["checks"]
    assert len(checks) > 5, "the other devices are looked at as well"
    return {check["name"]: check["value"] for check in checks if check["verdict"] == "fail"}


def test_doctor_finds_a_controller_that_is_not_set_as_the_rig_file_says(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rig, results = tmp_path / "rig.toml", tmp_path / "doctor.json"
    rig.write_text(bench.read_text().replace('"$101" = 1000', '"$101" = 800'))
    assert mill("doctor", "--rig", str(rig), "--no-motion", "--json", str(results)) == 1
    (name, words), *others = failed_checks(results).items()
    assert (name, others) == ("motion: answers", [])
    for part in ("$101", "1000", "800", "[motion.settings]"):
        assert part in words


def test_doctor_finds_soft_limits_off(bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    rig, results = tmp_path / "rig.toml", tmp_path / "doctor.json"
    rig.write_text(bench.read_text().replace('"$20" = 1\n', ""))
    write_setting(bench, b"$20=0")
    try:
        assert mill("doctor", "--rig", str(rig), "--no-motion", "--json", str(results)) == 1
    finally:
        write_setting(bench, b"$20=1")
    (name, words), *others = failed_checks(results).items()
    assert (name, others) == ("motion: answers", [])
    for part in ("$20", "soft limits on", "write $20=1"):
        assert part in words


def test_doctor_refuses_a_rig_file_that_cannot_be_used(bench: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(bench.read_text().replace('"$101" = 1000', '"x-steps" = 1000'))
    assert mill("doctor", "--rig", str(rig), "--json", str(tmp_path / "doctor.json")) == 2
    assert not (tmp_path / "doctor.json").exists()


@pytest.mark.parametrize("manner", ["willing", "stubborn"])
def test_stop_ends_who_holds_the_ports_and_stops_both_devices(
    bench: Path, capsys: pytest.CaptureFixture[str], manner: str
) -> None:
    port = load_rig(bench).motion.model_dump()["port"]
    with subprocess.Popen([sys.executable, "-c", HOLDER, port, manner], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"holding\n"
        assert owner_of(port) is not None
        assert mill("stop", "--rig", str(bench)) == 0
        assert holder.wait(5.0) == -(signal.SIGTERM if manner == "willing" else signal.SIGKILL)
    said = capsys.readouterr().out.splitlines()
    asked = [f"asking pid {holder.pid} to lift and stop"]
    killed = [f"pid {holder.pid} does not end: killing it"] if manner == "stubborn" else []
    assert said == [*asked, *killed, "motion: stopped", "spindle: stopped"]
    assert owner_of(port) is None


@pytest.mark.parametrize(("missing", "present"), [("spindle", "motion"), ("motion", "spindle")])
def test_stop_of_one_device_waits_for_no_other(
    bench: Path,
    monkeypatch: pytest.MonkeyPatch,
    mocker: MockerFixture,
    capsys: pytest.CaptureFixture[str],
    missing: str,
    present: str,
) -> None:
    """The system hangs in opening one port until the other device is stopped, and then says that nobody is there."""
    tables = load_rig(bench).model_dump()
    absent = tables[missing].get("port") or tables[missing]["channel"]
    stopped = threading.Event()
    device, verb = (GrblController, "halt") if present == "motion" else (Cia402Spindle, "stop")
    stop, open_port = getattr(device, verb), serial.Serial

    def tell(self: Any) -> None:
        stop(self)
        stopped.set()

    def hang(port: str, *words: Any, **choices: Any) -> serial.Serial:
        if port == absent:
            assert stopped.wait(20.0), f"{present} was not stopped while {missing} was opened"
            raise serial.SerialException(errno.EIO, "no answer")
        return open_port(port, *words, **choices)

    monkeypatch.setattr(device, verb, tell)
    mocker.patch("serial.Serial", side_effect=hang)
    assert mill("stop", "--rig", str(bench)) == 3
    said = capsys.readouterr()
    assert said.out == f"{present}: stopped\n"
    assert said.err.count("\n") == 1
    for part in (f"mill: {missing}: {absent}: cannot be opened", "emergency stop"):
        assert part in said.err


def test_who_holds_the_motion_port_does_not_keep_the_spindle_waiting(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    port = load_rig(bench).motion.model_dump()["port"]
    monkeypatch.setattr("cli.stop.LIFT_S", 30.0)
    with subprocess.Popen([sys.executable, "-c", HOLDER, port, "stubborn"], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"holding\n"
        stop, held = Cia402Spindle.stop, []

        def look(self: Cia402Spindle) -> None:
            held.append(owner_of(port) is not None)
            holder.kill()
            stop(self)

        monkeypatch.setattr(Cia402Spindle, "stop", look)
        assert mill("stop", "--rig", str(bench)) == 0
    assert held[0]
    asked = f"asking pid {holder.pid} to lift and stop"
    assert capsys.readouterr().out.splitlines() == [asked, "motion: stopped", "spindle: stopped"]


def calibration_of_another_rig(date: datetime) -> Calibration:
    """A good one, of a microscope that looks straight down."""
    points_mm = np.random.default_rng(0).uniform((0.0, -20.0, 0.0), (10.0, 0.0, 10.0), (16, 3))
    across_px, down_px = 480.0 + (points_mm[:, 1] + 10.0) / 0.0395, 270.0 + (points_mm[:, 0] - 5.0) / 0.0395
    left_px, right_px = (
        np.column_stack([across_px + sign * 3.2 * points_mm[:, 2], down_px]).round(1) for sign in (1.0, -1.0)
    )
    fit = fit_camera_pair(points_mm, left_px, right_px, size_px=(960, 540), detector_sigma_px=0.3)
    rig = RigIdentity(motion="stage 7", camera="eyes L1 R2")
    made = Provenance(date=date.isoformat(timespec="seconds"))
    return Calibration(fit.pair, "default", fit.model, {}, "right-handed", False, fit.rmse_mm, (), rig, made)


@pytest.mark.parametrize("command", [["run"], ["calibrate", "--verify"]])
def test_a_calibration_of_another_rig_moves_nothing(
    bench: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mocker: MockerFixture,
    command: list[str],
) -> None:
    file = tmp_path / "other.toml"
    calibration_of_another_rig(datetime.now(UTC)).save(file)
    home = mocker.spy(GrblController, "home")
    where = "--calibration" if command == ["run"] else "--out"
    record = ["--record", str(tmp_path / "run")] if command == ["run"] else []
    assert mill(*command, "--rig", str(bench), where, str(file), *record) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for part in (str(file), "another rig", "stage 7", "mill calibrate"):
        assert part in said
    assert home.call_count == 0
    assert not (tmp_path / "run").exists()


def test_an_old_calibration_moves_nothing(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], mocker: MockerFixture
) -> None:
    file = tmp_path / "old.toml"
    calibration_of_another_rig(datetime.now(UTC) - timedelta(hours=200)).save(file)
    home = mocker.spy(GrblController, "home")
    assert mill("run", "--rig", str(bench), "--calibration", str(file), "--record", str(tmp_path / "run")) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for part in (str(file), "200 h old", "allowed 168 h", "max_age_h", "mill calibrate"):
        assert part in said
    assert home.call_count == 0


def test_sigterm_brings_a_moving_jog_to_rest(bench: Path) -> None:
    rig = WiredRig(load_rig(bench), SystemClock(), bench.with_name("truth.json"))
    command = [*MILL, "jog", "--rig", str(bench), "--home", "--to", "-8", "5", "15", "--feed", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, bufsize=0) as process:
        assert line_from(process.stderr) == "homing\n"
        assert line_from(process.stderr) == "moving to x -8.000  y 5.000  z 15.000 mm at 2 mm/s\n"
        process.send_signal(signal.SIGTERM)
        said = process.communicate(timeout=20.0)[1]
    assert process.returncode == 130
    assert said.strip() == b"mill: interrupted"
    first, second = rig.truth(), rig.truth()
    assert first is not None
    assert second is not None
    assert first["monotonic_s"] < second["monotonic_s"]
    assert first["tip_mm"] == second["tip_mm"]
    assert first["tip_mm"][0] > 0.0
