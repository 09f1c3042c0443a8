"""A short run on the virtual clock, with its pictures: what the page is fed with in tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "milling"))

from true_eyes import SHORT_JOB, virtual_rig

from milling.record import Run, read_run

LAPS = 3


def rehearsed(folder: Path, most_laps: int = LAPS) -> Run:
    """Milled for some laps, then stopped by a person; with its calibration."""
    laps: list[int] = []
    rig = virtual_rig()
    try:
        rig.run(
            folder,
            SHORT_JOB,
            progress=lambda now: laps.append(1) if now.completion else None,
            stop_requested=lambda: len(laps) >= most_laps,
        )
        rig.calibration.save(folder / "calibration.toml")
    finally:
        rig.close()
    return read_run(folder)
