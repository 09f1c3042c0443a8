"""Soft failure is loud: docs/errors.md is the code's, and errors that are provoked say what, where and what next."""

import ast
import os
import pty
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mill_command import mill
from served_bench import MILL, served_bench
from test_house import ROOT, modules

from cli.config import load_rig
from cli.errors import MOVED_AND_STEP, PAGE, kinds, page
from drivers.lock import DeviceLock
from drivers.motion.grbl.codes import ALARMS, ERRORS
from drivers.spindle.emergency import EXACT


def test_the_page_is_what_the_code_says() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run `python -m cli.errors`"


def test_every_class_of_error_is_on_the_page() -> None:
    bases = {
        node.name: {getattr(base, "id", getattr(base, "attr", "")) for base in node.bases}
        for path in modules()
        if path.parent != ROOT / "firmware_sim"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    }
    found = {"MillError"}
    while more := {name for name, of in bases.items() if of & found} - found:
        found |= more
    assert found == {kind.__name__ for kind in MOVED_AND_STEP} == {kind.__name__ for kind, _ in kinds()}


def test_every_code_that_a_driver_translates_is_on_the_page() -> None:
    text = page()
    assert all(f"| error:{code} |" in text for code in ERRORS)
    assert all(f"| ALARM:{code} |" in text for code in ALARMS)
    assert all(f"| 0x{code:04X} |" in text for code in EXACT)


# --- provoked


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with served_bench(tmp_path_factory.mktemp("bench")) as served:
        yield served.rig_file


def key(bench: Path, name: str) -> str:
    """The line of the bench's rig file that gives this key."""
    found = re.search(rf"(?m)^{re.escape(name)} = .*$", bench.read_text())
    assert found, name
    return found[0]


PROVOKED: dict[str, tuple[str, str, list[str], int, list[str]]] = {
    "a port that is absent": ("port", 'port = "/dev/mill-none"', ["jog"], 3, ["/dev/mill-none", "`mill devices`"]),
    "another firmware": ("firmware", 'firmware = "9.9"', ["jog"], 2, ["9.9", "1.1h", "firmware"]),
    "a setting that is another": ('"$100"', '"$100" = 77', ["jog"], 2, ["$100", "77", "1000"]),
    "a setting that is none": ('"$100"', '"$abc" = 7', ["jog"], 2, ["$abc", "correct"]),
    "a key that is none": ("baud", "bauds = 1", ["jog"], 2, ["motion.bauds", "allowed: port, baud"]),
    "a make that is none": ("backend", 'backend = "cnc"', ["jog"], 2, ["motion.backend", "'cnc'", "install"]),
    "a place outside the travel": ("name", 'name = "b"', ["jog", "--home", "--to", "999", "0", "0"], 3,
                                   ["999", "travel"]),
    "not homed": ("name", 'name = "b"', ["jog", "--by", "0", "0", "-1"], 3, ["home", "add --home"]),
    "another bit rate": ("bitrate", "bitrate = 500000", ["stop"], 3, ["spindle", "emergency stop"]),
    "another node": ("node_id", "node_id = 9", ["stop"], 3, ["node 9", "emergency stop"]),
    "a camera that is absent": ("left", 'left = "http://127.0.0.1:9/left"', ["calibrate"], 3,
                                ["http://127.0.0.1:9/left", "start the camera's server"]),
    "no calibration": ("name", 'name = "never calibrated"', ["run"], 2, ["never-calibrated", "`mill calibrate`"]),
}  # fmt: skip
"""What is changed in a good rig file, what is asked for, and the exit code and the words that come of it."""


@pytest.mark.parametrize(("old", "new", "words", "code", "says"), PROVOKED.values(), ids=PROVOKED.keys())
def test_an_error_is_one_line_that_names_the_thing_and_the_next_step(
    bench: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    old: str,
    new: str,
    words: list[str],
    code: int,
    says: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    rig = tmp_path / "rig.toml"
    rig.write_text(bench.read_text().replace(key(bench, old), new, 1))
    assert mill(*words, "--rig", str(rig)) == code
    require_one_line(capsys.readouterr().err, says)


def require_one_line(said: str, says: list[str]) -> None:
    line = said.splitlines()[-1]
    assert line.startswith("mill: ")
    assert len([each for each in said.splitlines() if each.startswith("mill: ")]) == 1
    assert "Traceback" not in said
    for words in says:
        assert words in line
    assert "; " in line, "no next step"


def test_a_port_that_says_nothing_and_one_that_is_held(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    near, far = pty.openpty()
    try:
        rig = tmp_path / "rig.toml"
        rig.write_text(bench.read_text().replace(key(bench, "port"), f'port = "{os.ttyname(far)}"', 1))
        assert mill("jog", "--rig", str(rig)) == 3
        require_one_line(capsys.readouterr().err, [os.ttyname(far), "GRBL"])
        lock = DeviceLock(os.ttyname(far))
        try:
            assert mill("jog", "--rig", str(rig)) == 3
        finally:
            lock.release()
        require_one_line(
            capsys.readouterr().err, [os.ttyname(far), f"in use by pid {os.getpid()}", "stop that process"]
        )
    finally:
        os.close(near)
        os.close(far)


# --- two processes, one device

HOLDER = """
import sys
from pathlib import Path
from cli.config import load_rig
from cli.rig import WiredRig
from drivers.clock import SystemClock
rig = WiredRig(load_rig(Path(sys.argv[1])), SystemClock())
device = getattr(rig, "open_" + sys.argv[2])()
print("open", flush=True)
sys.stdin.read()
device.close()
"""


@pytest.mark.parametrize(
    ("kind", "words", "thing"),
    [
        ("motion", ["jog"], lambda rig: load_rig(rig).motion.model_dump()["port"]),
        ("spindle", ["calibrate"], lambda rig: load_rig(rig).spindle.model_dump()["channel"]),
        ("camera", ["calibrate"], lambda rig: load_rig(rig).camera.model_dump()["left"]),
    ],
)
def test_the_second_of_two_processes_is_refused_naming_the_first(
    bench: Path, kind: str, words: list[str], thing: Callable[[Path], str]
) -> None:
    pipe = subprocess.PIPE
    holder = [MILL[0], "-c", HOLDER, str(bench), kind]
    with subprocess.Popen(holder, stdin=pipe, stdout=pipe, text=True) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "open\n"
        second = subprocess.run([*MILL, *words, "--rig", str(bench)], capture_output=True, text=True, check=False)
        first.communicate(timeout=20.0)
    assert second.returncode == 3
    said = [thing(bench), f"in use by pid {first.pid} (-c {bench} {kind})", "stop that process, or wait until it ends"]
    require_one_line(second.stderr, said)
    again = subprocess.run([*MILL, "jog", "--rig", str(bench)], capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
