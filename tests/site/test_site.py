"""The site builds without a warning and without a network, and says nothing that the code does not."""

import ast
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
from mkdocs.config.defaults import MkDocsConfig
from pages import DOCS, ROOT

from cli import config
from cli.main import mill
from firmware_sim import specimen
from firmware_sim.faults import CATALOGUE
from milling.latch import Reaction
from reference import bench, files, outputs, records
from reference.commands import commands
from reference.hook import on_config
from reference.source import functions, keys_of

PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built; any warning is an error, a link or an anchor that leads nowhere is a warning."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_is_there_and_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert {"index.html", "tutorial.html", "rig-file.html", "commands.html", "0001-rooms-and-arrows.html"} <= {
        page.name for page in pages
    }
    loaded = re.compile(
        r'<(?:script|img|iframe|source)[^>]*\ssrc="([^"]*)"|<link[^>]*rel="?(?:stylesheet|icon|preload|preconnect)[^>]*>'
    )
    for page in pages:
        text = page.read_text(encoding="utf-8")
        for found in loaded.finditer(text):
            assert "//" not in found[0], f"{page.name}: {found[0]}"


def test_a_page_that_nobody_named_is_found_under_how_to(tmp_path: Path) -> None:
    for name in ("known.md", "new.md"):
        (tmp_path / name).touch()
    site = MkDocsConfig()
    site.load_dict({"site_name": "x", "docs_dir": str(tmp_path), "nav": [{"How-to": []}, {"Known": "known.md"}]})
    assert on_config(site).nav == [{"How-to": ["new.md"]}, {"Known": "known.md"}]


def test_every_command_is_in_the_reference(site: Path) -> None:
    text = (site / "reference/commands.html").read_text(encoding="utf-8")
    for words, command in commands():
        assert f'id="{"-".join(("mill", *words))}"' in text
        for option in command.params:
            assert all(name in text for name in option.opts if name.startswith("--"))


def test_every_key_of_a_file_says_what_it_is() -> None:
    text = files.rig_page() + files.specimen_page()
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    assert len(rows) > 100
    assert not [row for row in rows if row.endswith("|  |")], "say it in a string under the attribute"
    for model in (config.RigConfig, specimen.Specimen):
        assert all(
            f"`{field.alias or name}`" in text or f"[{name}]" in text for name, field in model.model_fields.items()
        )


def test_limits_of_a_file_are_those_that_are_checked() -> None:
    assert "| `reply_s` | number | 0.1 | 0.02 to 1 |" in files.rig_page()
    assert "| `radius_mm` | number | 2 | 2 to 4 |" in files.rig_page()
    assert "| `tilt_deg.pitch` | number | 3 | -20 to 20 |" in files.specimen_page()


def test_every_key_of_a_result_says_what_it_is() -> None:
    said = {command: set(keys) for command, keys in outputs.WORDS.items()}
    assert said == outputs.written(), "say it in reference/outputs.py"


def test_every_event_and_every_key_of_the_header_says_what_it_is() -> None:
    assert set(records.WORDS) == set(records.told()), "say it in reference/records.py"
    assert set(records.HEADER) == records.header_keys(), "say it in reference/records.py"


def test_the_fields_of_a_lap_are_those_of_the_source() -> None:
    tree = ast.parse((ROOT / "milling/journal.py").read_text(encoding="utf-8"))
    (lap_told,) = (function for function in functions(tree) if function.name == "lap_told")
    assert set(records.told()["lap"]) == keys_of(ast.Name("told"), lap_told, tree)


def test_what_the_bench_leaves_out_is_taken_from_its_modules() -> None:
    modules = {name for name, _, _ in bench.left_out()}
    assert {"machine", "skull", "microscope", "cia402_drive", "grbl_board"} <= modules
    assert all(words for _, _, words in bench.left_out())


@pytest.mark.parametrize("name", ["safety.md", "paper.md"])
def test_every_test_that_is_named_exists(name: str) -> None:
    named = TEST.findall((DOCS / name).read_text(encoding="utf-8"))
    assert len(named) > 10
    for path, test in named:
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        assert test in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, f"{path}::{test}"


def test_every_fault_stands_in_the_safety_case_with_a_test() -> None:
    text = (DOCS / "safety.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| `")]
    told = [name for row in rows for name in re.findall(r"`([a-z]+\.\w+)`", row[0])]
    assert sorted(told) == sorted(CATALOGUE)
    assert all(TEST.search(row[-1]) for row in rows)
    assert set(re.findall(r"\b(HOLD|RETRACT|KILL)\b", text)) == {each.name for each in Reaction} - {"NONE"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_that_a_page_names_exists_with_its_options(page: Path) -> None:
    for line in named_commands(page.read_text(encoding="utf-8")):
        command, words = mill, line
        while isinstance(command, click.Group) and words and not words[0].startswith("-"):
            inner = command.get_command(click.Context(command), words[0])
            if inner is None and re.search(r"[A-Z|]", words[0]):
                break
            assert inner is not None, f"mill {' '.join(line)}"
            command, words = inner, words[1:]
        known = {name for option in command.params for name in (*option.opts, *option.secondary_opts)} | {"--help"}
        asked = {word.partition("=")[0] for word in words if word.startswith("--") and word != "--"}
        assert asked <= known, f"mill {' '.join(line)}: {asked - known}"


def named_commands(text: str) -> list[list[str]]:
    """The words behind every `mill` in code: inline, indented, or typed at a prompt."""
    typed = re.findall(r"^(?:    |\$ )mill ([^\n]*)$", text, re.MULTILINE) + re.findall(r"`mill ([^`]*)`", text)
    typed += [piece for line in typed for piece in re.findall(r"\| mill (.*)", line)]
    return [shlex.split(line.replace("'", '"') if line.count("'") % 2 else line, comments=True) for line in typed]
