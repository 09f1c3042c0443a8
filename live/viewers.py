"""Those who look: each has one place for each kind of news, where the newest replaces what it has not read yet."""

import asyncio
from collections.abc import Callable, Iterable

from fastapi import WebSocket, WebSocketDisconnect

MOST_VIEWERS = 20
STOP_WORD = "stop"
MOST_WORDS = 20
"""Which a viewer may say in ``WORDS_S``; a person who hammers on the button says ten in a second."""
WORDS_S = 1.0

News = str | bytes


class Viewer:
    """What one page has not been sent yet. Its size is bounded by the kinds of news."""

    def __init__(self) -> None:
        self._waiting: dict[str, News] = {}
        self._some = asyncio.Event()

    def put(self, kind: str, news: News) -> None:
        """In place of older news of this kind."""
        self._waiting[kind] = news

    def wake(self) -> None:
        """Send what waits."""
        if self._waiting:
            self._some.set()

    async def take(self) -> Iterable[News]:
        """Everything that is new, once it is to be sent."""
        await self._some.wait()
        self._some.clear()
        taken, self._waiting = self._waiting, {}
        return taken.values()


class Viewers:
    """All of them."""

    def __init__(self) -> None:
        self._viewers: set[Viewer] = set()
        self._newest: dict[str, News] = {}

    def __len__(self) -> int:
        return len(self._viewers)

    def put(self, kind: str, news: News) -> None:
        """For everybody, and for those who come later."""
        self._newest[kind] = news
        for viewer in self._viewers:
            viewer.put(kind, news)

    def wake(self) -> None:
        """Send everybody what waits, all of it at once: each time costs a viewer's computer, and this one, a switch."""
        for viewer in self._viewers:
            viewer.wake()

    async def serve(self, socket: WebSocket, stop: Callable[[], None], first: Callable[[], str]) -> None:
        """One viewer, until it leaves, says what it may not, or is one too many."""
        await socket.accept()
        if len(self._viewers) >= MOST_VIEWERS:
            await socket.close(1013, "enough viewers")
            return
        viewer = Viewer()
        viewer.put("history", first())
        for kind, news in self._newest.items():
            viewer.put(kind, news)
        viewer.wake()
        self._viewers.add(viewer)
        try:
            async with asyncio.TaskGroup() as both:
                sending = both.create_task(_send(socket, viewer))
                await _listen(socket, stop)
                sending.cancel()
        except* WebSocketDisconnect:
            pass
        finally:
            self._viewers.discard(viewer)


async def _send(socket: WebSocket, viewer: Viewer) -> None:
    while True:
        for news in await viewer.take():
            if isinstance(news, bytes):
                await socket.send_bytes(news)
            else:
                await socket.send_text(news)


async def _listen(socket: WebSocket, stop: Callable[[], None]) -> None:
    """Hear the one word there is; anything else ends the connection."""
    loop = asyncio.get_running_loop()
    said_at: list[float] = []
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        now = loop.time()
        said_at = [each for each in said_at if now - each < WORDS_S] + [now]
        if message.get("text") != STOP_WORD or len(said_at) > MOST_WORDS:
            await socket.close(1008, "a viewer may say stop")
            return
        stop()
