"""A real headless Chromium, driven over its DevTools protocol."""

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

from drivers.clock import SystemClock

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
START_S = 60.0
ANSWER_S = 60.0


class Tab:
    """One page of the browser."""

    def __init__(self, wire: ClientConnection) -> None:
        self._wire = wire
        self._numbers = itertools.count(1)
        self.complaints: list[str] = []
        """What the page itself said against itself."""

    def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol, and its answer."""
        number = next(self._numbers)
        self._wire.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._wire.recv(ANSWER_S))
            if answer.get("method") == "Runtime.exceptionThrown":
                self.complaints.append(
                    str(answer["params"]["exceptionDetails"].get("exception", {}).get("description"))
                )
            if answer.get("method") == "Log.entryAdded" and answer["params"]["entry"]["level"] == "error":
                self.complaints.append(answer["params"]["entry"]["text"])
            if answer.get("id") == number:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result

    def open(self, address: str) -> None:
        """Go there."""
        for domain in ("Page", "Runtime", "Log"):
            self.do(f"{domain}.enable")
        self.do("Page.navigate", url=address)

    def ask(self, script: str) -> Any:
        """The value of an expression; of a promise, what it comes to."""
        result = self.do("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, script: str, timeout_s: float = 20.0) -> float:
        """Wait until an expression is true; how long that took."""
        clock = SystemClock()
        began_s = clock.now_s()
        # A page that is still on its way has none of what is asked for.
        while not self.ask(f"(() => {{ try {{ return Boolean({script}) }} catch {{ return false }} }})()"):
            assert clock.now_s() - began_s < timeout_s, (script, self.complaints, self.ask("document.body.innerText"))
            clock.sleep_s(0.02)
        return clock.now_s() - began_s

    def key(self, key: str) -> None:
        """Press a key, as a keyboard does."""
        code = {"Escape": 27, " ": 32, "Enter": 13, "Tab": 9, "ArrowRight": 39}[key]
        for kind in ("rawKeyDown", "keyUp"):
            self.do("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code)

    def press(self, selector: str) -> None:
        """Press an element with the mouse, where it is."""
        middle = "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
        box = self.ask(f"{middle}(document.querySelector('{selector}').getBoundingClientRect())")
        for kind in ("mousePressed", "mouseReleased"):
            self.do("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def size(self, width: int, height: int, *, dark: bool = False) -> None:
        """Of the window; and the person's taste."""
        self.do("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.do("Emulation.setEmulatedMedia", features=features)

    def picture(self, path: Path) -> None:
        """What it looks like, as PNG."""
        path.write_bytes(base64.b64decode(self.do("Page.captureScreenshot", format="png")["data"]))


@contextlib.contextmanager
def tab() -> Iterator[Tab]:
    """A browser with one page."""
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
        words += ["--no-first-run", "--disable-background-networking", "--disable-dev-shm-usage"]
        words += ["--no-proxy-server", f"--user-data-dir={profile}", "about:blank"]
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port, _ = _said(Path(profile) / "DevToolsActivePort")
            with connect(_page(port), max_size=None, proxy=None) as wire:
                yield Tab(wire)
        finally:
            process.terminate()
            process.wait(20.0)


def _said(path: Path) -> list[str]:
    clock = SystemClock()
    deadline_s = clock.now_s() + START_S
    while not (path.is_file() and len(lines := path.read_text().splitlines()) == 2):
        assert clock.now_s() < deadline_s, "chromium does not start"
        clock.sleep_s(0.05)
    return lines


def _page(port: str) -> str:
    import httpx

    with httpx.Client(trust_env=False) as client:
        for each in client.get(f"http://127.0.0.1:{port}/json/list", timeout=ANSWER_S).json():
            if each["type"] == "page":
                return str(each["webSocketDebuggerUrl"])
    raise AssertionError("chromium has no page")
