"""The page's addresses, and nothing else: the page, its WebSocket, and of a record its moments and pictures."""

import secrets
from collections.abc import Callable
from pathlib import Path

from fastapi import FastAPI, Response, WebSocket
from fastapi.responses import FileResponse, HTMLResponse

from live.gate import POLICY
from live.player import Player
from live.viewers import Viewers

WEB = Path(__file__).with_name("web")
SCRIPTS = ("base", "gauge", "points", "news", "curves", "eyes", "surface", "air", "live", "record")
"""In the order in which they build on each other; one page takes one request."""


def watched(viewers: Viewers, stop: Callable[[], None], first: Callable[[], str]) -> FastAPI:
    """The page of a run that goes on."""
    app = _bare("live")

    @app.websocket("/watch")
    async def watch(socket: WebSocket) -> None:
        await viewers.serve(socket, stop, first)

    return app


def recorded(player: Player) -> FastAPI:
    """The page of a record."""
    app = _bare("recorded")

    @app.get("/run.json")
    async def run() -> Response:
        return Response(player.story, media_type="application/json")

    @app.get("/frames/{name}")
    async def frame(name: str) -> Response:
        path = player.picture(name)
        return Response("no such picture", 404) if path is None else FileResponse(path, media_type="image/jpeg")

    return app


def _bare(mode: str) -> FastAPI:
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    script = "\n".join((WEB / f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS)
    whole = (WEB / "page.html").read_text(encoding="utf-8").replace("{{mode}}", mode)
    whole = whole.replace("{{style}}", (WEB / "page.css").read_text(encoding="utf-8")).replace("{{script}}", script)

    @app.get("/")
    async def page() -> HTMLResponse:
        nonce = secrets.token_urlsafe(16)
        policy = {"content-security-policy": POLICY.format(nonce=nonce)}
        return HTMLResponse(whole.replace("{{nonce}}", nonce), headers=policy)

    return app
