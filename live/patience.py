"""Connections that are held to their time: what does not ask, does not read or does not answer is dropped."""

import asyncio
from typing import cast

from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

MOST_CONNECTIONS = 64
REQUEST_S = 5.0
"""From opening a connection, or from the last look at it, to a whole request."""
PING_S = 3.0
"""How often a viewer is asked whether it reads, and how long it may take to answer."""
MOST_REQUEST_BYTES = 8192
MOST_MESSAGE_BYTES = 64
"""A page says one word."""


class PatientHttp(H11Protocol):
    """A connection over HTTP."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take it, unless there are too many."""
        if len(self.connections) >= MOST_CONNECTIONS:
            self.transport = transport
            transport.abort()
            return
        super().connection_made(transport)
        self.loop.call_later(REQUEST_S, self._look)

    def _look(self) -> None:
        """Drop a connection on which nothing is being answered."""
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return
        if self.cycle is None or self.cycle.response_complete:
            self.transport.abort()
        else:
            self.loop.call_later(REQUEST_S, self._look)


class PatientSocket(WebSocketsSansIOProtocol):
    """A viewer's WebSocket."""

    def keepalive_timeout(self) -> None:
        """A viewer that does not read takes no farewell either."""
        self.stop_keepalive()
        self.transport.abort()


def patient(app: object, *, message_bytes: int = MOST_MESSAGE_BYTES, ping_s: float = PING_S) -> Config:
    """How uvicorn is to serve, on sockets that it is given.

    Args:
        app: what answers.
        message_bytes: the most that a page says at once.
        ping_s: how often a page is asked whether it reads, and how long it may take to answer.
    """
    return Config(
        cast("type", app),
        http=PatientHttp,
        ws=PatientSocket,
        ws_max_size=message_bytes,
        ws_ping_interval=ping_s,
        ws_ping_timeout=ping_s,
        ws_per_message_deflate=False,
        h11_max_incomplete_event_size=MOST_REQUEST_BYTES,
        timeout_keep_alive=int(REQUEST_S),
        timeout_graceful_shutdown=1,
        lifespan="off",
        log_level="critical",
        access_log=False,
        server_header=False,
        proxy_headers=False,
    )
