"""Draw the page for the documentation, with pictures of the virtual bench.

python tests/annotate/picture.py docs/pictures/annotate.png [dark]
"""

import json
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from bench_album import bench_album
from desk_tab import SAVED, opened, tab

from studies.annotation_walk import browser_at, page_of


def main() -> None:
    out, *taste = sys.argv[1:]
    with tempfile.TemporaryDirectory() as scratch, tab(dark="dark" in taste) as browser:
        album = Path(scratch) / "album"
        mice = bench_album(album, 3)
        off = ((3.0, -2.0), (-1.5, 4.0))
        with page_of(album, "ben") as (_, address), browser_at(address) as other:
            for mouse_, by in zip(mice, off, strict=False):
                places = {"bregma": mouse_.bregma, "lambda": mouse_.lambda_}
                points = {
                    name: {"x_px": x + by[0] * (1 if name == "bregma" else 0.4), "y_px": y + by[1]}
                    for name, (x, y) in places.items()
                }
                other.ask(do="put", picture=mouse_.name, label={"points": points})
        with page_of(album, "anna", "--task", "landmarks", "--task", "completion") as (_, address):
            opened(browser, address)
            for mouse_ in mice[:2]:
                browser.ask(f"go(album.pictures.findIndex(each => each.name === {json.dumps(mouse_.name)}))")
                browser.until(f"bitmap !== null && here().name === {json.dumps(mouse_.name)}")
                browser.press("b")
                browser.draw(mouse_.bregma)
                browser.draw(mouse_.lambda_)
                ring = {**mouse_.ring, "reference": mouse_.name.replace(".png", "-before.png")}
                ring["completion"] = [None] * len(mouse_.completion)
                browser.press("r")
                browser.ask(f"shape({json.dumps(ring)})")
                browser.press("p", "Enter")
                browser.until(f"{SAVED} && here().settled && ring().origin === 'accepted'")
            browser.ask("[3, 4, 5].forEach(k => paint(k, null)); spot = 8; zoom(2.6)")
            browser.until(f"{SAVED} && here().settled")
            browser.ask("pointer = [label().points.bregma.x_px, label().points.bregma.y_px]; draw()")
            browser.until("!drawn")
            browser.picture(Path(out))


if __name__ == "__main__":
    main()
