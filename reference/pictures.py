"""Make the pictures of the documentation anew.

    python -m reference.pictures                # docs/pictures/bench.png, from a virtual bench, as the tutorial does
    python -m reference.pictures runs/first     # docs/pictures/run.png as well: the top of this run's report

The page beside the machine is drawn by ``tests/live/picture.py``.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from reference.source import ROOT

PICTURES: Final = ROOT / "docs/pictures"
MILL: Final = (sys.executable, "-m", "cli.main")
WIDTH_PX: Final = 640
"""Of each eye."""
REPORT_PX: Final = (1007, 760)


def both_eyes(folder: Path) -> None:
    """What `mill devices --pictures` saves of both eyes while the drill stands over the skull, side by side."""
    rig = ("--rig", str(folder / "rig.toml"))
    serve = [*MILL, "emulate", "--rig-out", rig[1], "--until-stdin-closes"]
    with subprocess.Popen(serve, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as bench:
        assert bench.stdout is not None
        bench.stdout.readline()
        subprocess.run([*MILL, "jog", *rig, "--home", "--to", "5", "-10", "5"], check=True)
        subprocess.run([*MILL, "devices", *rig, "--pictures", str(folder / "shots")], check=True)
        bench.communicate()
    left, right = (cv2.imread(str(next((folder / "shots").glob(f"*-{side}.png")))) for side in ("left", "right"))
    assert left is not None
    assert right is not None
    height = round(left.shape[0] * WIDTH_PX / left.shape[1])
    small = [cv2.resize(eye, (WIDTH_PX, height), interpolation=cv2.INTER_AREA) for eye in (left, right)]
    gap = np.full((height, 6, 3), 255, np.uint8)
    cv2.imwrite(str(PICTURES / "bench.png"), np.hstack([small[0], gap, small[1]]))


def top_of_report(run: Path, folder: Path) -> None:
    """The report's first screen."""
    report = (run / "report.html").resolve().as_uri()
    size = f"--window-size={REPORT_PX[0]},{REPORT_PX[1]}"
    quiet = (
        "--headless",
        "--hide-scrollbars",
        "--no-sandbox",
        "--disable-gpu",
        "--no-first-run",
        f"--user-data-dir={folder / 'browser'}",
    )
    command = ["chromium", *quiet, size, f"--screenshot={PICTURES / 'run.png'}", report]
    subprocess.run(command, check=True, timeout=120.0)


def main() -> None:
    """Without a run, the bench only."""
    with tempfile.TemporaryDirectory() as scratch:
        both_eyes(Path(scratch))
        for run in sys.argv[1:]:
            top_of_report(Path(run), Path(scratch))


if __name__ == "__main__":
    main()
