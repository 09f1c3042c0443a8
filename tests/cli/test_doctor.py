"""`mill doctor` on wires with faults that need a real port, and what it says to people."""

import json
from pathlib import Path

import pytest
from mill_command import mill
from served_bench import served_bench


def failed(results: Path) -> dict[str, str]:
    checks = json.loads(results.read_text())["checks"]
    return {check["name"]: str(check["value"]) for check in checks if check["verdict"] == "fail"}


def test_a_port_that_another_program_has_is_told_with_its_pid_and_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    results = tmp_path / "doctor.json"
    with served_bench(tmp_path, ["--fault", "port.held"]) as bench:
        assert mill("doctor", "--rig", str(bench.rig_file), "--no-motion", "--json", str(results)) == 1
        found = failed(results)
        # A busy computer may find itself late besides.
        assert "motion: answers" in found
        assert f"in use by pid {bench.process.pid} (" in found["motion: answers"]
        assert "emulate" in found["motion: answers"]
    said = capsys.readouterr().out
    assert f"{len(found)} of " in said
    assert "certificate" not in said.partition("report:")[2].replace("certificates/", "")
    page = (tmp_path / json.loads(results.read_text())["report"]).read_text()
    assert "What failed" in page
    assert "Not certified" in page


def test_a_disk_that_is_nearly_full_is_told_before_anything_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    results = tmp_path / "doctor.json"
    assert mill("doctor", "--emulate", "--fault", "disk.full", "--no-motion", "--json", str(results)) == 1
    assert failed(results)["computer: free disk"] == "12.0"
    assert "make room where records go" in capsys.readouterr().out
