"""Draw the page for the README.

python tests/live/picture.py docs/pictures/live.png [RUN_FOLDER [SECONDS]]

Feeds a page from a record, or from a short run of its own, up to a time in the record, and takes its picture.
"""

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from browser import tab
from rehearsal import rehearsed
from test_page import BRIGHT, fed

WIDTH_PX, HEIGHT_PX = 1440, 900


def main() -> None:
    out, *rest = sys.argv[1:]
    with tempfile.TemporaryDirectory() as scratch, tab() as browser:
        folder = Path(rest[0]) if rest else rehearsed(Path(scratch) / "run").folder
        until = [f"--until={rest[1]}"] if len(rest) > 1 else ["--withheld"]
        browser.size(WIDTH_PX, HEIGHT_PX)
        with fed(folder, *until) as bench:
            browser.open(bench.address)
            browser.until(f"now && document.getElementById('stop').disabled === false && {BRIGHT}(1) > 10")
            browser.until("now.t > 0 && now.silent_s > 0.4")
            browser.picture(Path(out))


if __name__ == "__main__":
    main()
