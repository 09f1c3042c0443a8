"""A real headless Chromium, the one that is installed, driven by Playwright."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playwright.sync_api import ConsoleMessage, Page

from drivers.clock import SystemClock
from studies.chromium import CHROMIUM, chromium

__all__ = ["BRIGHT", "CHROMIUM", "DESKTOP_PX", "TABLET_PX", "Tab", "tab"]

ANSWER_S = 60.0
DESKTOP_PX, TABLET_PX = (1600, 900), (1024, 768)
BRIGHT = """(k => {
    const c = document.getElementById(`eye${k}`), d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    let sum = 0;
    for (let i = 0; i < d.length; i += 4004) sum += d[i];
    return sum / (d.length / 4004);
})"""
"""How bright a picture is on the average."""


class Tab:
    """One page of the browser."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.complaints: list[str] = []
        """What the page itself said against itself."""
        page.set_default_timeout(1000 * ANSWER_S)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", self._listen)

    def _listen(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.complaints.append(message.text)

    def open(self, address: str) -> None:
        """Go there."""
        self.complaints.clear()
        self.page.goto(address, wait_until="commit")

    def ask(self, script: str) -> Any:
        """The value of an expression; of a promise, what it comes to."""
        return self.page.evaluate(script)

    def until(self, script: str, timeout_s: float = 20.0) -> float:
        """Wait until an expression is true; how long that took."""
        clock = SystemClock()
        began_s = clock.now_s()
        # A page that is still on its way has none of what is asked for.
        while not self.ask(f"(() => {{ try {{ return Boolean({script}) }} catch {{ return false }} }})()"):
            assert clock.now_s() - began_s < timeout_s, (script, self.complaints, self.ask("document.body.innerText"))
            self.page.wait_for_timeout(20)
        return clock.now_s() - began_s

    def key(self, key: str) -> None:
        """Press a key, as a keyboard does."""
        self.page.keyboard.press(key)

    def click(self, selector: str) -> None:
        """Press the mouse where an element is, whatever it thinks of that."""
        box = self.page.locator(selector).bounding_box()
        assert box is not None
        self.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        self.page.mouse.down()
        self.page.mouse.up()

    def size(self, size_px: tuple[int, int], *, dark: bool = False) -> None:
        """Of the window; and the person's taste."""
        self.page.set_viewport_size({"width": size_px[0], "height": size_px[1]})
        self.page.emulate_media(color_scheme="dark" if dark else "light")

    def picture(self, path: Path) -> None:
        """What it looks like, as PNG."""
        self.page.screenshot(path=path)


@contextlib.contextmanager
def tab() -> Iterator[Tab]:
    """A browser with one page."""
    with chromium() as browser:
        yield Tab(browser.new_page())
