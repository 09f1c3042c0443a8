"""The rooms keep to their arrows, and the command stays light."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = (
    "drivers",
    "vision",
    "calib",
    "doctor",
    "milling",
    "live",
    "annotate",
    "studies",
    "benchmarks",
    "cli",
    "reference",
    "firmware_sim",
)
MAY_KNOW_THE_EMULATOR = {"cli/emulate.py", "reference/files.py"}
HEAVY = (
    "numpy",
    "scipy",
    "torch",
    "cv2",
    "open3d",
    "numba",
    "onnxruntime",
    "pydantic",
    "rich",
    "foxglove",
    "rerun",
    "canopen",
    "can",
)


def modules() -> Iterator[Path]:
    for room in ROOMS:
        yield from sorted((ROOT / room).rglob("*.py"))


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


@pytest.mark.parametrize("path", list(modules()), ids=lambda path: str(path.relative_to(ROOT)))
def test_only_emulate_studies_and_the_reference_know_that_a_device_can_be_emulated(path: Path) -> None:
    place = path.relative_to(ROOT).as_posix()
    if place in MAY_KNOW_THE_EMULATOR or place.startswith(("studies/", "firmware_sim/")):
        return
    known = {name for name in imported(path) if name.split(".")[0] == "firmware_sim"}
    assert not known, f"{place} imports {known}"


@pytest.mark.parametrize("path", sorted((ROOT / "firmware_sim").rglob("*.py")), ids=lambda path: path.name)
def test_the_emulator_reads_the_manual_on_its_own(path: Path) -> None:
    allowed = {"drivers.errors", "drivers.clock", "drivers.device"}
    for name in imported(path):
        if name.split(".")[0] == "drivers":
            module = ".".join(name.split(".")[:3])
            assert (
                module in allowed
                or any(name.startswith(f"{a}.") for a in allowed)
                or "interface" in name
                or "transport" in name
                or name in {"drivers", "drivers.camera", "drivers.motion", "drivers.spindle"}
            ), f"{path.name} imports {name}"


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys\n"
        "sys.argv = ['mill', '--help']\n"
        "from cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code\n"
        f"loaded = [name for name in {HEAVY!r} if name in sys.modules]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "run" in done.stdout
