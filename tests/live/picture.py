"""Draw the pages for the documentation.

python tests/live/picture.py docs/pictures

Mills a while on the virtual clock and feeds a page from that record; then calibrates and examines a virtual bench, each
with its page. In a real browser, some minutes.
"""

import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "cli"))

from browser import BRIGHT, DESKTOP_PX, Tab, tab
from processes import started
from rehearsal import rehearsed
from test_page import fed

LAPS = 9
START_S = 600.0
SEEN = "scene.setpoints.filter(each => each.state === 'seen').length"


def main() -> None:
    out = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as scratch, tab() as browser:
        os.chdir(scratch)
        browser.size(DESKTOP_PX)
        run = rehearsed(Path("run"), LAPS)
        last_s = next(run.of_kind("latched"))["t"]
        with fed(run.folder, f"--until={last_s}") as bench:
            browser.open(bench.address)
            browser.until(f"document.getElementById('stop').disabled === false && {BRIGHT}(1) > 10", START_S)
            browser.until("now.t > 0 && now.silent_s > 0.4", START_S)
            browser.picture(out / "live.png")
        watched(browser, "calibrate", f"{SEEN} >= 7 && now.tip_px", out / "live-calibrate.png")
        watched(browser, "doctor", f"{SEEN} >= 1 || ended", out / "live-doctor.png")


def watched(browser: Tab, command: str, moment: str, picture: Path) -> None:
    with started(command, "--emulate", "--live") as running:
        assert running.comes_to("open ", START_S), running.said
        browser.open(running.out.split()[1])
        browser.until(moment, START_S)
        browser.picture(picture)


if __name__ == "__main__":
    main()
