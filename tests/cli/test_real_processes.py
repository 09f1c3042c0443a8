"""Whole commands, each in its own process: one serves a bench on ptys, the others know its rig file alone."""

import contextlib
import json
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from processes import Command, started
from served_bench import ServedBench, served_bench

from calib.calibration_file import Calibration
from cli.config import load_rig
from cli.rig import WiredRig
from drivers.clock import SystemClock
from milling.record import Run, read_run

MILLING_S = 300.0
"""From the start of a command to what is waited for, at most; a free machine takes 40 s."""
ENDING_S = 60.0
"""From there to its end."""
WINDOW_S = 1500.0
"""From the start of `mill run` to its report."""


@dataclass(frozen=True)
class Rig:
    """A served bench, its rig file with a short job, and where its calibration lies."""

    bench: ServedBench
    rig_file: Path
    calibration: Path
    calibrate_json: Path


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Calibrated."""
    folder = tmp_path_factory.mktemp("bench")
    with served_bench(folder) as bench:
        rig = Rig(bench, short_job(bench), folder / "calibration.toml", folder / "calibrate.json")
        words = ("--rig", str(rig.rig_file), "--out", str(rig.calibration), "--json", str(rig.calibrate_json))
        with started("calibrate", *words) as calibrate:
            code = calibrate.end(MILLING_S)
        assert (code, calibrate.err) == (0, ""), calibrate.said
        yield rig


def short_job(bench: ServedBench) -> Path:
    """The rig file of a bench with a ring of few points, which is soon under way; it need not end complete."""
    return patient(bench, "short.toml", "\n[job]\nn_points = 8\n")


def patient(bench: ServedBench, name: str, job: str = "") -> Path:
    """The rig file of a bench whose devices are patient with a busy machine."""
    text = bench.rig_file.read_text().replace("node_id", "heartbeat_s = 1.0\nnode_id")
    path = bench.rig_file.with_name(name)
    path.write_text(text.replace("origin_mm", "reply_s = 1.0\norigin_mm") + job)
    return path


@contextlib.contextmanager
def run_until(line: str, rig_file: Path, calibration: Path, folder: Path) -> Iterator[tuple[Command, Path]]:
    """`mill run` that has come to ``line``, and the folder of its record."""
    record = folder / "run"
    with started("run", *run_words(rig_file, calibration, record)) as run:
        assert run.comes_to(line, MILLING_S), run.said
        yield run, record


def run_words(rig_file: Path, calibration: Path, record: Path) -> list[str]:
    """What follows `mill run`; its JSON lies beside the record."""
    files = {"--rig": rig_file, "--calibration": calibration, "--record": record, "--json": record.with_suffix(".json")}
    return [word for option, file in files.items() for word in (option, str(file))]


def whole_record(folder: Path, said: str) -> tuple[Run, dict[str, Any]]:
    """A record that was closed, and its result: nothing is lost, and the outcome is the last that happened."""
    assert (folder / "events.jsonl").is_file(), said
    record = read_run(folder)
    assert record.damage is None
    assert [event["kind"] for event in record.events[-2:]] == ["outcome", "stage"], said
    assert record.events[-1]["stage"] == "done"
    assert record.result is not None, said
    assert record.result["outcome"] == record.events[-2]["outcome"]
    return record, record.result


def truth_of(rig: Rig) -> dict[str, Any]:
    """What the bench says now."""
    truth = WiredRig(load_rig(rig.rig_file), SystemClock(), rig.bench.truth_file).truth()
    assert truth is not None
    return truth


@pytest.mark.slow
def test_calibrate_writes_a_calibration_that_may_mill(rig: Rig) -> None:
    known = Calibration.load(rig.calibration, None, for_milling=True)
    assert 0.0 < known.rmse_mm < 0.15
    figures = json.loads(rig.calibrate_json.read_text())
    assert figures["rmse_mm"] == pytest.approx(known.rmse_mm, abs=1e-6)
    assert figures["file"] == str(rig.calibration)
    assert "Setpoints" in Path(figures["report"]).read_text(encoding="utf-8")
    assert "truth" not in figures, "a rig file does not say that its devices are emulated"


@pytest.mark.slow
def test_ctrl_c_lifts_the_drill_and_closes_the_record(rig: Rig, tmp_path: Path) -> None:
    clock = SystemClock()
    with run_until("mill: ", rig.rig_file, rig.calibration, tmp_path) as (run, folder):
        asked_s = clock.now_s()
        run.process.send_signal(signal.SIGINT)
        assert run.comes_to("done: ", ENDING_S), run.said
        took_s = clock.now_s() - asked_s
        code = run.end(ENDING_S)
    assert (code, run.err) == (1, ""), run.said
    assert took_s < 5.0, run.said
    record, result = whole_record(folder, run.said)
    assert (result["outcome"], result["reason"]) == ("aborted", "stopped by a person"), run.said
    latched, *safe = record.events[record.events.index(next(record.of_kind("latched"))) : -2]
    safe = [event for event in safe if event["kind"] != "late"]
    assert [(event["kind"], event["state"]) for event in safe] == [("state", "lifted"), ("spindle", "off, confirmed")]
    assert safe[-1]["t"] - latched["t"] < 1.0
    truth = truth_of(rig)
    *_, milled = record.of_kind("load")
    assert truth["tip_mm"][2] - milled["tip_mm"][2] > 1.0
    assert abs(truth["spindle_rpm"]) < 60.0
    assert truth["membrane_touched"] is False
    assert json.loads(folder.with_suffix(".json").read_text())["reason"] == "stopped by a person"
    assert (folder / "report.html").is_file()


@pytest.mark.parametrize(("manner", "until"), [("killed", "mill: "), ("hung up", "contact: ")])
@pytest.mark.slow
def test_a_bench_that_vanishes_ends_the_run(rig: Rig, tmp_path: Path, manner: str, until: str) -> None:
    """By a kill while it mills, or in good order, its stdin closed, while the drill feels for the bone."""
    with contextlib.ExitStack() as serving:
        bench = serving.enter_context(served_bench(tmp_path))
        with run_until(until, short_job(bench), rig.calibration, tmp_path) as (run, folder):
            if manner == "killed":
                bench.process.kill()
            else:
                serving.close()
            code = run.end(ENDING_S)
    assert (code, run.err) == (1, ""), run.said
    assert (folder / "report.html").is_file()
    _, result = whole_record(folder, run.said)
    assert result["outcome"] in {"held", "aborted"}
    assert "\n" not in result["reason"]
    devices = load_rig(bench.rig_file)
    names = (devices.motion.model_dump()["port"], devices.spindle.model_dump()["channel"], "camera")
    assert any(name in result["reason"] for name in names), result["reason"]


def killed_while_milling(rig: Rig, rig_file: Path, folder: Path) -> Path:
    """The record of a run that SIGKILL ended."""
    with run_until("mill: ", rig_file, rig.calibration, folder) as (run, record):
        run.process.kill()
        run.process.wait(ENDING_S)
    return record


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_the_drill_lifted_and_the_spindle_still(rig: Rig, tmp_path: Path) -> None:
    """Nobody is left but the supervisor and the drive."""
    clock = SystemClock()
    folder = killed_while_milling(rig, rig.rig_file, tmp_path)
    deadline_s = clock.now_s() + ENDING_S
    *_, milled = read_run(folder).of_kind("load")
    while (truth := truth_of(rig))["tip_mm"][2] - milled["tip_mm"][2] < 1.0 or abs(truth["spindle_rpm"]) > 60.0:
        assert clock.now_s() < deadline_s, truth
    assert truth["membrane_touched"] is False


@pytest.mark.long
def test_a_run_that_was_killed_is_resumed(rig: Rig, tmp_path: Path) -> None:
    with served_bench(tmp_path) as bench:
        whole, calibration = patient(bench, "whole.toml"), tmp_path / "calibration.toml"
        with started("calibrate", "--rig", str(whole), "--out", str(calibration)) as calibrate:
            assert calibrate.end(MILLING_S) == 0, calibrate.said
        other = Rig(bench, whole, calibration, tmp_path / "calibrate.json")
        folder = killed_while_milling(other, whole, tmp_path)
        words = ("--rig", str(whole), "--record", str(tmp_path / "second"))
        with started("resume", str(folder), *words) as resume:
            code = resume.end(WINDOW_S)
        assert (code, resume.err) == (0, ""), resume.said
        truth = truth_of(other)
    assert truth["success"] is True
    header, chain = read_run(tmp_path / "second").header, read_run(folder).chain
    assert chain is not None
    assert (header["resumes"], header["resumes_head"]) == (str(folder), chain.head)


@pytest.mark.long
def test_a_window_is_milled_from_another_terminal(rig: Rig, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with started("run", *run_words(patient(rig.bench, "whole.toml"), rig.calibration, folder)) as run:
        code = run.end(WINDOW_S)
    assert (code, run.err) == (0, ""), run.said
    _, result = whole_record(folder, run.said)
    assert result["outcome"] == "complete"
    truth = truth_of(rig)
    assert truth["success"] is True
    assert truth["membrane_touched"] is False
