"""Who may look: this computer, over its loopback, with the link that the terminal printed.

A page of another site can make a browser send requests here, also under a name that it lets point here (DNS
rebinding). So the Host must be ours, an Origin must be ours, and every request needs the cookie that the link's
one-time token was traded for.
"""

import secrets
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

COOKIE_AGE_S = 24 * 3600
HEADERS = (
    (b"cache-control", b"no-store"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Gate:
    """An ASGI application in front of another."""

    def __init__(self, app: App, port: int, *, next_step: str = "mill stop --rig FILE stops the machine") -> None:
        """``port`` of the loopback; ``next_step`` is told to whoever brings no good link."""
        self._app = app
        self._next_step = next_step
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
        self._token: str | None = secrets.token_urlsafe(24)
        self._key = secrets.token_urlsafe(24)
        # Browsers give a cookie to every port of a host.
        self._cookie = f"mill-live-{port}"
        self.address = f"http://127.0.0.1:{port}/?token={self._token}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let through, or refuse."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        status, why, cookie = self._judge(scope)
        if why:
            await _refuse(scope, receive, send, status, why)
            return

        async def marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *HEADERS, *cookie]
            await send(message)

        await self._app(scope, receive, marked)

    def _judge(self, scope: Scope) -> tuple[int, str, list[tuple[bytes, bytes]]]:
        """Status and words of a refusal, no words where there is none; and the cookie to leave."""
        hosts, origins = _values(scope, b"host"), _values(scope, b"origin")
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return 421, "this page answers under 127.0.0.1 and localhost alone", []
        if scope["type"] == "websocket" and not origins:
            return 403, "a page tells where it comes from (Origin)", []
        if any(origin != f"http://{hosts[0]}" for origin in origins):
            return 403, "a page of another origin may not look here", []
        if scope.get("method", "GET") not in ("GET", "HEAD"):
            return 405, "this page is only looked at", []
        if self._known(scope):
            return 200, "", []
        if scope["type"] == "http" and scope["path"] == "/" and self._trade(scope):
            key = f"{self._cookie}={self._key}; Path=/; Max-Age={COOKIE_AGE_S}; HttpOnly; SameSite=Strict"
            return 200, "", [(b"set-cookie", key.encode())]
        return 403, f"the link is not right, or was opened in another browser; {self._next_step}", []

    def _known(self, scope: Scope) -> bool:
        for line in _values(scope, b"cookie"):
            try:
                found = SimpleCookie(line).get(self._cookie)
            except CookieError:
                continue
            if found is not None and _same(found.value, self._key):
                return True
        return False

    def _trade(self, scope: Scope) -> bool:
        """Whether the request brings the token, which is good once."""
        given = parse_qs(scope["query_string"].decode("latin-1"), max_num_fields=4).get("token", [""])[0]
        good = self._token is not None and _same(given, self._token)
        if good:
            self._token = None
        return good


def _same(given: str, right: str) -> bool:
    return secrets.compare_digest(given.encode(), right.encode())


def _values(scope: Scope, name: bytes) -> list[str]:
    headers: Iterable[tuple[bytes, bytes]] = scope["headers"]
    return [value.decode("latin-1") for key, value in headers if key == name]


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})
        return
    body = why.encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", b"%d" % len(body)), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else body})
