"""The page of `mill annotate` in the Chromium that is installed, and a hand for its mouse and keys."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playwright.sync_api import ConsoleMessage, Page

from drivers.clock import SystemClock
from studies.chromium import chromium

SIZE_PX = (1440, 900)
SAVED = "$('saved').textContent === '✓ saved'"
ANY_S = 60.0
"""A network's first answer takes some seconds on a busy machine."""


class Tab:
    """One window."""

    def __init__(self, page: Page, *, dark: bool = False) -> None:
        self._page = page
        self.complaints: list[str] = []
        """What the page itself said against itself."""
        page.set_viewport_size({"width": SIZE_PX[0], "height": SIZE_PX[1]})
        page.emulate_media(color_scheme="dark" if dark else "light")
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", self._listen)

    def _listen(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.complaints.append(message.text)

    def open(self, address: str) -> None:
        """Go there."""
        self._page.goto(address)
        # The page before this one may have complained that its server was gone.
        self.complaints.clear()

    def ask(self, script: str) -> Any:
        """The value of an expression."""
        return self._page.evaluate(script)

    def until(self, script: str) -> None:
        """Wait until an expression is true; what does not exist yet is false."""
        guarded = f"(() => {{ try {{ return Boolean({script}) }} catch {{ return false }} }})()"
        clock = SystemClock()
        deadline_s = clock.now_s() + ANY_S
        # Playwright's own waiting evaluates strings in the page, which its policy forbids.
        while not self.ask(guarded):
            assert clock.now_s() < deadline_s, (script, self.complaints, self.ask("document.body.innerText"))
            self._page.wait_for_timeout(30)

    def press(self, *keys: str) -> None:
        """Keys, one after the other."""
        for key in keys:
            self._page.keyboard.press(key)

    def draw(self, *path: tuple[float, float]) -> None:
        """Press at the first of some places of the picture, draw along the others, let go."""
        for k, (x, y) in enumerate(path):
            at = self.ask(f"(b => to({x}, {y}).map((v, i) => v + [b.left, b.top][i]))(canvas.getBoundingClientRect())")
            self._page.mouse.move(*at)
            if k == 0:
                self._page.mouse.down()
        self._page.mouse.up()

    def picture(self, path: Path) -> None:
        """What it looks like, as PNG."""
        self._page.screenshot(path=path)


@contextlib.contextmanager
def tab(*, dark: bool = False) -> Iterator[Tab]:
    """A browser with one page."""
    with chromium() as browser:
        yield Tab(browser.new_page(), dark=dark)


def opened(browser: Tab, address: str, *, suggesting: bool = False) -> None:
    """Go there, and wait for the first picture, with suggestions or without."""
    browser.open(address)
    browser.until("bitmap !== null")
    if suggesting:
        browser.until("Object.keys(suggested).length === 2")
    elif browser.ask("$('suggesting').checked"):
        browser.press("s")
