"""Study records: ids, labels, verification, tables, and two runs beside each other."""

import csv
import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from mill_command import mill
from study_record import HEADER, STUDY, N, study_record

from cli.config import StudyTable
from cli.run_table import POINT_COLUMNS, RUN_COLUMNS, Told, run_row
from cli.study import study_of
from drivers.errors import ConfigError
from milling.job import Job
from milling.labels import read_labels
from milling.record import read_run

DOCS = Path(__file__).parent.parent.parent / "docs/records.md"


@pytest.fixture(autouse=True)
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


def table(path: str) -> list[dict[str, str]]:
    with Path(path).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


# Whose run it is.


def test_the_command_line_goes_before_the_rig_file() -> None:
    rig = StudyTable(protocol="P-7", operator="AK")
    assert study_of({"operator": "BL", "specimen_id": "M12"}, rig) == {
        "specimen_id": "M12",
        "protocol": "P-7",
        "operator": "BL",
    }
    assert study_of({}, StudyTable()) == {}


def test_a_window_is_resumed_in_its_own_specimen(runs: Path) -> None:
    before = read_run(study_record(runs / "a", ended=False))
    rig = StudyTable(operator="BL", protocol="P-8")
    assert study_of({"operator": "CM"}, rig, before) == {**STUDY, "operator": "CM"}
    for told, table_ in (({"specimen_id": "M13"}, rig), ({}, StudyTable(specimen_id="M13"))):
        with pytest.raises(ConfigError, match="was milled in specimen 'M12', and 'M13' is named"):
            study_of(told, table_, before)
    assert study_of({"specimen_id": "M13"}, rig, read_run(study_record(runs / "b", study={})))["specimen_id"] == "M13"


@pytest.mark.parametrize("word", ["", "  ", "two\nlines", "x" * 121])
@pytest.mark.parametrize("option", ["--specimen-id", "--protocol", "--operator"])
def test_an_id_is_one_line(option: str, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert mill("run", "--emulate", option, word) == 2
    said = capsys.readouterr().err
    assert option in said
    assert "one line of 1 to 120 letters" in said
    assert said.count("\n") == 1


def test_list_show_and_report_tell_whose_run_it_is(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study_record(runs / "a")
    assert mill("runs", "list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["run", "specimen", "protocol", "operator", "outcome", "milling", "reason"]
    assert lines[1].split()[:5] == ["a", "M12", "P-7", "AK", "complete"]
    assert mill("runs", "show", "a") == 0
    shown = capsys.readouterr().out
    chain = read_run(runs / "a").chain
    assert chain is not None
    for part in ("specimen  M12", "protocol  P-7", "operator  AK", f"events  {chain.lines}, head {chain.head}"):
        assert part in shown
    assert mill("runs", "report", "a") == 0
    page = (runs / "a/report.html").read_text()
    assert all(word in page for word in ("specimen M12", "operator AK", chain.head))


# Labels.


def test_labels_are_added_and_the_newest_counts(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path.name: path.read_bytes() for path in study_record(runs / "a").glob("*.*")}
    assert mill("runs", "label", "a", "membrane=intact", "flap=free", "--by", "AK") == 0
    assert mill("runs", "label", "a", "flap=attached", "histology= dura  clear ", "--by", "BL") == 0
    assert mill("runs", "label", "a", "membrane=", "--by", "BL") == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("a: histology=dura clear (BL, 20")
    told = [(label.name, label.value, label.by) for label in read_labels(runs / "a")]
    assert told == [
        ("membrane", "intact", "AK"),
        ("flap", "free", "AK"),
        ("flap", "attached", "BL"),
        ("histology", "dura clear", "BL"),
        ("membrane", "", "BL"),
    ]
    assert {path.name: path.read_bytes() for path in (runs / "a").glob("*.*") if path.name in before} == before
    assert mill("runs", "list") == 0
    assert "flap=attached, histology=dura clear  it is" in capsys.readouterr().out
    assert mill("runs", "show", "a", "--json", "-") == 0
    assert len(json.loads(capsys.readouterr().out)["labels"]) == len(told)
    assert mill("runs", "report", "a") == 0
    assert "histology: <b>dura clear</b>" in (runs / "a/report.html").read_text()


def test_who_labels_is_the_login_where_nobody_says(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("getpass.getuser", lambda: "anna")
    study_record(runs / "a")
    assert mill("runs", "label", "a", "flap=free") == 0
    assert read_labels(runs / "a")[0].by == "anna"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["flap"], "NAME=VALUE is needed"),
        (["flap=gone"], "allowed free, attached"),
        (["Flap=free"], "lower-case"),
        (["note=" + "x" * 1001], "1001 letters"),
        (["flap=free", "membrane=broken"], "allowed intact, torn"),
        (["flap=free", "--by", "  "], "--by"),
        ([], "Missing argument"),
    ],
)
def test_a_wrong_label_is_one_line_and_none_is_kept(
    runs: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    study_record(runs / "a")
    assert mill("runs", "label", "a", *words) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert not (runs / "a/labels.jsonl").exists()


@pytest.mark.parametrize("line", [0, 1, 2])
def test_a_changed_label_is_told_by_its_line(runs: Path, line: int, capsys: pytest.CaptureFixture[str]) -> None:
    study_record(runs / "a")
    for value in ("one", "two", "three"):
        assert mill("runs", "label", "a", f"note={value}", "--by", "AK") == 0
    path = runs / "a/labels.jsonl"
    lines = path.read_bytes().split(b"\n")
    lines[line] = lines[line].replace(b"AK", b"BL")
    path.write_bytes(b"\n".join(lines))
    for command in ("show", "verify", "label"):
        capsys.readouterr()
        assert mill("runs", command, "a", *(["note=four"] if command == "label" else [])) in (1, 2)
        said = capsys.readouterr()
        assert f"labels.jsonl line {line + 1}: does not follow" in said.out + said.err


# Whether it is what was written.


def verdict(capsys: pytest.CaptureFixture[str], code: int = 1) -> dict[str, Any]:
    capsys.readouterr()
    assert mill("runs", "verify", "a", "--json", "-") == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)["runs"][0]
    return found


def test_a_whole_record_is_said_to_be_whole(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study_record(runs / "a")
    assert verdict(capsys, 0) | {"chain": None} == {
        "run": "a", "state": "whole", "reasons": [], "files": 1, "chain": None,
    }  # fmt: skip
    assert mill("runs", "verify") == 0
    chain = read_run(runs / "a").chain
    assert chain is not None
    assert capsys.readouterr().out.splitlines()[1].split() == ["a", "whole", str(chain.lines), "1", chain.head]


def outcome_changed(folder: Path) -> None:
    path = folder / "result.json"
    path.write_text(path.read_text().replace('"complete"', '"held"'))


def chain_forgotten(folder: Path) -> None:
    path = folder / "result.json"
    result = json.loads(path.read_text())
    del result["chain"]
    path.write_text(json.dumps(result))


def picture_changed(folder: Path) -> None:
    path = next(folder.glob("frames/*.jpg"))
    path.write_bytes(path.read_bytes()[:-1] + b"?")


def operator_changed(folder: Path) -> None:
    path = folder / "header.json"
    path.write_text(path.read_text().replace('"AK"', '"BL"'))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (outcome_changed, "result.json tells otherwise than the events"),
        (chain_forgotten, "result.json does not tell where the events end"),
        (picture_changed, r"frames/00001-left.jpg was changed"),
        (lambda folder: next(folder.glob("frames/*.jpg")).unlink(), r"frames/00001-left.jpg is missing"),
        (operator_changed, r"events.jsonl line 1: does not follow from the header"),
        (lambda folder: (folder / "labels.jsonl").write_text("x"), "labels.jsonl"),
    ],
)
def test_what_was_changed_is_told(runs: Path, change: Any, why: str, capsys: pytest.CaptureFixture[str]) -> None:
    change(study_record(runs / "a"))
    found = verdict(capsys)
    assert found["state"] == "changed"
    assert re.search(why, found["reasons"][0])


def test_a_killed_run_is_whole_as_far_as_it_goes(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study_record(runs / "a", ended=False)
    assert verdict(capsys)["state"] == "cut off"


def test_nothing_can_be_told_of_a_record_without_chain(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from drivers.checked_lines import checked

    path = study_record(runs / "a") / "events.jsonl"
    path.write_bytes(b"".join(checked(line.partition(b" ")[2]) for line in path.read_bytes().splitlines()))
    chain_forgotten(runs / "a")
    assert verdict(capsys)["state"] == "no chain"


# Tables.


def test_a_row_a_run_with_ids_labels_and_figures(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study_record(runs / "a")
    study_record(runs / "b", ended=False, study={})
    damaged = study_record(runs / "c") / "events.jsonl"
    damaged.write_bytes(damaged.read_bytes()[1:])
    mill("runs", "label", "a", "membrane=intact", "vessel=none", "--by", "AK")
    assert mill("runs", "export", "--csv", "t.csv") == 0
    said = capsys.readouterr()
    assert "t.csv: 3 rows, one a run" in said.out
    assert "events.jsonl line 1" in said.err
    a, b, c = table("t.csv")
    assert list(a) == [*RUN_COLUMNS, "label_flap", "label_membrane", "label_vessel"]
    wanted = {
        "run": "a", "record": "whole", "specimen_id": "M12", "protocol": "P-7", "operator": "AK", "outcome": "complete",
        "reason": 'it is, with a "quote", and a comma', "milling_time_s": "81.6", "points_done": "7",
        "points_stopped": "1",
        "depth_max_mm": "0.37", "permissions_asked": "16", "permissions_granted": "15", "weights_tip_sha256": "a" * 64,
        "calibration_check_off_mm": "0.05", "torque_max": "0.2", "ring_center_mm": "5.0 -10.0 -2.5",
        "job_n_points": "8",
        "label_membrane": "intact", "label_vessel": "none", "label_flap": "", "seed": "",
    }  # fmt: skip
    assert {name: a[name] for name in wanted} == wanted
    assert (b["record"], b["outcome"], b["specimen_id"], b["depth_max_mm"]) == ("cut off", "", "", "0.3")
    assert (c["run"], c["record"], c["outcome"]) == ("c", "damaged", "")


def test_a_row_a_point(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study_record(runs / "a")
    study_record(runs / "b", ended=False)
    assert mill("runs", "export", "a", "b", "--points", "--csv", "-") == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert len(rows) == 2 * N
    assert list(rows[0]) == list(POINT_COLUMNS)
    third = rows[2]
    assert (third["point"], third["angle_deg"], third["depth_mm"]) == ("3", "135.0", "0.32")
    assert (third["permissions_asked"], third["permissions_granted"]) == ("2", "1")
    assert third["withheld_most"] == "no fresh frame"
    assert (rows[1]["state"], rows[1]["why"]) == ("stopped", "the load is lost")
    assert (rows[N]["run"], rows[N]["state"], rows[N]["depth_mm"]) == ("b", "open", "0.3")


def test_every_column_is_documented_and_nothing_else() -> None:
    text = DOCS.read_text(encoding="utf-8")
    run_part, point_part = text.partition("One row a run:")[2].split("One row a point:")
    told = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", run_part, re.M))
    assert told == {name: column.meaning for name, column in RUN_COLUMNS.items()} | {"label_NAME": told["label_NAME"]}
    assert dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", point_part.partition("##")[0], re.M)) == dict(POINT_COLUMNS)


def test_every_key_of_a_job_is_a_column(runs: Path) -> None:
    row = run_row(Told.of_folder(study_record(runs / "a")))
    for each in fields(Job):
        value = getattr(Job(n_points=N), each.name)
        assert row[f"job_{each.name}"] == value


@pytest.mark.parametrize(
    "words", [["export", "--csv", "no/such/t.csv"], ["compare", "a", "a", "--out", "no/such/t.html"]]
)
def test_a_table_or_page_that_cannot_be_written_is_one_line(
    runs: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    study_record(runs / "a")
    assert mill("runs", *words) == 2
    assert re.fullmatch(r"mill: no/such/t\.\w+: cannot .*; name another --(csv|out) file\n", capsys.readouterr().err)


# Two runs.


def test_two_runs_beside_each_other(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study_record(runs / "a")
    weights = {**HEADER["weights"], "completion": "d" * 64}
    study_record(runs / "b", depth_mm=0.2, weights=weights, study={**STUDY, "specimen_id": "<M13>"})
    assert mill("runs", "compare", "a", "b", "--json", "c.json") == 0
    said = capsys.readouterr().out
    assert re.search(r"^specimen_id +M12 +<M13>$", said, re.M)
    assert re.search(r"^weights_completion_sha256 +c{12} +d{12}$", said, re.M)
    assert re.search(r"^\* depth_max_mm +0.37 +0.27$", said, re.M)
    assert re.search(r"^  outcome +complete +complete$", said, re.M)
    assert re.search(r"^no fresh frame +1 +1$", said, re.M)
    assert "protocol" not in said
    assert max(map(len, said.splitlines())) <= 80
    page = Path("compare-a-b.html").read_text()
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!data:)""", page)
    assert page.count("data:image/jpeg;base64,") == 2
    assert "<M13>" not in page
    assert page.count("<polyline") == 6
    given = json.loads(Path("c.json").read_text())
    assert {each["what"] for each in given["set_up"]} == {"specimen_id", "weights_completion_sha256"}


def test_the_same_run_twice_and_one_that_was_cut_off(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study_record(runs / "a")
    study_record(runs / "b", ended=False)
    assert mill("runs", "compare", "a", "a", "--out", "same.html") == 0
    said = capsys.readouterr().out
    assert "They were given the same." in said
    assert "\n* " not in said
    assert mill("runs", "compare", "a", "b") == 0
    assert re.search(r"^\* outcome +complete *$", capsys.readouterr().out, re.M)
    assert "None" not in Path("compare-a-b.html").read_text()
