"""The walk of docs/your-own-pictures.md, from pictures to a model card, with an album whose labels are known.

    python -m studies.annotation_walk --photographs DIR --out DIR --json FILE

A pretended person labels every picture of DIR through the page's own HTTP and WebSocket, as a browser does; the page's
process is killed half way. A second one labels some of them, all off by the same, so that the disagreement that is
told can be checked. Then the commands of the walk, one after the other. Training takes some 20 minutes of one core.
"""

import argparse
import contextlib
import http.cookiejar
import json
import shutil
import signal
import statistics
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import numpy as np
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from drivers.errors import MillError
from studies.photographs import Photograph, read_table
from vision.album import IMAGES, KEYPOINTS, POINTS
from vision.runtime import read_manifest

TASK = "landmarks"
ONE, TWO = "anna", "ben"
LABELLED_TWICE = 20
OFF_PX = (3.0, 4.0)
"""How far the second person's points lie from the first's: 5 px, always."""
ANSWER_S = 60.0

Mill = Callable[..., None]
"""Runs a `mill` command of these words; raises where it fails."""


class Browser:
    """What a browser does with the link of `mill annotate`, without the browser."""

    def __init__(self, get: Callable[[str], bytes], wire: ClientConnection) -> None:
        """``get`` brings what is at a path; the desk is at the far end of ``wire``."""
        self._get = get
        self._wire = wire
        self.album: dict[str, Any] = json.loads(wire.recv(ANSWER_S))

    def ask(self, **message: Any) -> dict[str, Any]:
        """Say one thing, and hear the answer.

        Raises:
            MillError: it was refused.
        """
        self._wire.send(json.dumps(message))
        answer: dict[str, Any] = json.loads(self._wire.recv(ANSWER_S))
        if answer["kind"] == "refused":
            raise MillError(f"the page refused {message}: {answer['why']}")
        return answer

    def picture(self, name: str) -> bytes:
        """A picture as the page shows it."""
        return self._get(f"/pictures/{quote(name)}")


@contextlib.contextmanager
def browser_at(address: str) -> Iterator[Browser]:
    """Trade the link's token for the cookie, and sit down at the desk."""
    jar = http.cookiejar.CookieJar()
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPCookieProcessor(jar))
    host = urlsplit(address).netloc

    def get(path: str) -> bytes:
        with opener.open(f"http://{host}{path}", timeout=ANSWER_S) as answer:
            return bytes(answer.read())

    get(address.partition(host)[2])
    cookie = {"Cookie": "; ".join(f"{each.name}={each.value}" for each in jar)}
    origin = Origin(f"http://{host}")
    with connect(f"ws://{host}/desk", origin=origin, additional_headers=cookie, proxy=None, max_size=None) as wire:
        yield Browser(get, wire)


@contextlib.contextmanager
def page_of(album: Path, annotator: str, *words: str) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """`mill annotate` as a process, and the address it tells; ended as a person ends it, unless it is dead."""
    command = [sys.executable, "-m", "cli.main", "annotate", str(album), "--annotator", annotator, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = next((line.split()[1] for line in process.stdout if line.startswith("open ")), None)
            if address is None:
                raise MillError(f"`{' '.join(command[2:])}` told no address; see what it says above")
            yield process, address
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(ANSWER_S)


def label_all(browser: Browser, labels: Mapping[str, Mapping[str, Any]]) -> list[float]:
    """Look at every picture that is not done, and say what is known of it; how long each answer took."""
    took_s = []
    for picture in browser.album["pictures"]:
        name = picture["name"]
        if picture["settled"] or name not in labels:
            continue
        if browser.picture(name)[:2] != b"\xff\xd8":
            raise MillError(f"the page shows no picture for {name}")
        began_s = time.monotonic()
        browser.ask(do="put", picture=name, label={"points": labels[name]})
        took_s.append(time.monotonic() - began_s)
    return took_s


def walk(photographs: Path, out: Path, mill: Mill) -> dict[str, Any]:
    """The whole of it.

    Args:
        photographs: an album with the labels of landmarks; it stays as it is.
        out: a new folder for the album, the data set and the weights.
        mill: runs a command; ``mill_process`` as a person would.

    Returns:
        Figures.
    """
    _, known = read_table(photographs, TASK)
    album = out / "album"
    shutil.copytree(photographs / IMAGES, album / IMAGES)
    labels = {each.file.relative_to(photographs / IMAGES).as_posix(): _label(each) for each in known}
    half = dict(list(labels.items())[: len(labels) // 2])
    with page_of(album, ONE, "--task", TASK) as (process, address), browser_at(address) as browser:
        took_s = label_all(browser, half)
        process.kill()
    with page_of(album, ONE, "--task", TASK) as (_, address), browser_at(address) as browser:
        kept = sum(picture["settled"] for picture in browser.album["pictures"])
        took_s += label_all(browser, labels)
    again = {name: _label(each, OFF_PX) for name, each in zip(labels, known, strict=True)}
    with page_of(album, TWO, "--task", TASK) as (_, address), browser_at(address) as browser:
        label_all(browser, dict(list(again.items())[:LABELLED_TWICE]))
    mill("annotate", album, "--compare", "--json", out / "compare.json")
    mill("annotate", album, "--annotator", ONE, "--export")
    mill("dataset", "import", album, "--task", TASK, "--out", out / "set")
    mill("evaluate", TASK, "--data", out / "set", "--json", out / "before.json")
    weights = out / "weights" / f"{TASK}.onnx"
    began_s = time.monotonic()
    mill("train", TASK, "--data", out / "set", "--out", weights)
    took_training_s = time.monotonic() - began_s
    mill("evaluate", TASK, "--data", out / "set", "--weights", weights, "--json", out / "after.json")
    entry = read_manifest(weights.parent)[weights.name]
    return {
        "pictures": len(labels),
        "kept_after_kill": kept,
        "killed_after": len(half),
        "label_saved_median_s": statistics.median(took_s),
        "label_saved_worst_s": max(took_s),
        "exported_off_by_px": _off_by(known, read_table(album, TASK)[1]),
        "compared": json.loads((out / "compare.json").read_text(encoding="utf-8"))["summary"],
        "training_s": took_training_s,
        "steps": entry["steps"],
        "sha256": entry["sha256"],
        "before": json.loads((out / "before.json").read_text(encoding="utf-8")),
        "after": json.loads((out / "after.json").read_text(encoding="utf-8")),
        "model_card": str(weights.with_suffix(".card.html")),
    }


def _label(known: Photograph, off_px: Sequence[float] = (0.0, 0.0)) -> dict[str, Any]:
    told: dict[str, Any] = {}
    for name, (x, y) in zip(POINTS[TASK], known.points_px, strict=True):
        unseen = not np.isfinite([x, y]).all()
        told[name] = "unseen" if unseen else {"x_px": x + off_px[0], "y_px": y + off_px[1]}
    return told


def _off_by(one: Sequence[Photograph], two: Sequence[Photograph]) -> float:
    """Largest distance between the same labels; infinite where a picture is missing."""
    places = {each.file.name: each.points_px for each in two}
    if places.keys() != {each.file.name for each in one}:
        return float("inf")
    return float(max(np.nanmax(np.abs(each.points_px - places[each.file.name])) for each in one))


def mill_process(*words: object) -> None:
    """A `mill` command as a process of its own.

    Raises:
        MillError: it ended otherwise than well.
    """
    print(f"$ mill {' '.join(map(str, words))}", flush=True)
    done = subprocess.run([sys.executable, "-m", "cli.main", *map(str, words)], check=False)
    if done.returncode:
        raise MillError(f"`mill {' '.join(map(str, words))}` ended with {done.returncode}; see what it says above")


def main() -> None:
    """Walk, and tell the figures."""
    parser = argparse.ArgumentParser(description="From pictures to a model card, with known labels.")
    parser.add_argument("--photographs", type=Path, required=True, help=f"folder with {IMAGES}/ and {KEYPOINTS}")
    parser.add_argument("--out", type=Path, required=True, help="new folder for what is made")
    parser.add_argument("--json", type=Path, required=True, help="receives the figures")
    wanted = parser.parse_args()
    figures = walk(wanted.photographs, wanted.out, mill_process)
    result = {"schema": 1, "command": "annotation walk", "seed": 0, **figures}
    wanted.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    after = figures["after"]
    print(f"{figures['pictures']} pictures; mean {after['mean_mm']:.3f} mm, median {after['median_mm']:.3f} mm")


if __name__ == "__main__":
    main()
