"""The page's addresses: itself, the album's pictures, and the WebSocket over which everything is said."""

import asyncio
import json
import secrets
from pathlib import Path

import cv2
from fastapi import FastAPI, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import HTMLResponse
from starlette.concurrency import run_in_threadpool

from annotate.desk import Desk
from drivers.errors import MillError
from live.gate import POLICY

PAGE = Path(__file__).with_name("page.html")
QUALITY = 95
MOST_MESSAGE_BYTES = 16384
"""A ring of the most points that there may be fits in."""
MOST_MESSAGES = 200
"""In a second; a person who holds a key down says thirty."""


def desk_app(desk: Desk) -> FastAPI:
    """What one annotator's browser asks."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    here = _Here()

    @app.get("/")
    async def page() -> HTMLResponse:
        nonce = secrets.token_urlsafe(16)
        text = PAGE.read_text(encoding="utf-8").replace("{{nonce}}", nonce)
        return HTMLResponse(text, headers={"content-security-policy": POLICY.format(nonce=nonce)})

    @app.get("/pictures/{name:path}")
    def picture(name: str) -> Response:
        # As the import will read it, so that a place means the same here and there.
        if not desk.known(name):
            return Response("no such picture", 404)
        try:
            image = desk.picture(name)
        except MillError as error:
            return Response(str(error), 422)
        _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        return Response(data.tobytes(), media_type="image/jpeg")

    @app.websocket("/desk")
    async def sit(socket: WebSocket) -> None:
        await socket.accept()
        await here.take(socket)
        try:
            await socket.send_text(_json(await run_in_threadpool(desk.told)))
            await _talk(socket, desk, here)
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            here.leave(socket)

    return app


class _Here:
    """The one window that may write: the last one that was opened. A second would save over the first."""

    def __init__(self) -> None:
        self._socket: WebSocket | None = None
        self.turn = asyncio.Lock()
        """One message at a time."""

    async def take(self, socket: WebSocket) -> None:
        """Send the window away that was here before."""
        before, self._socket = self._socket, socket
        if before is not None:
            await before.close(4001, "opened in another window")

    def leave(self, socket: WebSocket) -> None:
        """Make room."""
        if self._socket is socket:
            self._socket = None

    def is_here(self, socket: WebSocket) -> bool:
        """Whether it was not sent away."""
        return self._socket is socket


async def _talk(socket: WebSocket, desk: Desk, here: _Here) -> None:
    loop = asyncio.get_running_loop()
    said_at: list[float] = []
    while here.is_here(socket):
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        now = loop.time()
        said_at = [each for each in said_at if now - each < 1.0] + [now]
        if message.get("text") is None or len(said_at) > MOST_MESSAGES:
            await socket.close(1008, "a page says some words a second")
            return
        async with here.turn:
            if here.is_here(socket):
                answer = await run_in_threadpool(desk.answer, message["text"])
                await socket.send_text(_json(answer))


def _json(answer: dict[str, object]) -> str:
    return json.dumps(answer, separators=(",", ":"), allow_nan=False)
