"""A camera's multipart/x-mixed-replace stream (MJPEG over HTTP), one JPEG at a time, not decoded.

FFmpeg opens such streams too, but throws the part headers away, and with them the time of exposure.
"""

import contextlib
import http.client
import re
import socket
from typing import Protocol
from urllib.parse import urlsplit

from drivers.errors import ConnectionLostError, DeviceTimeoutError, ProtocolError

_LONGEST_LINE = 4096
_MOST_HEADERS = 32
_LARGEST_PICTURE = 32 * 1024 * 1024
_SECONDS = re.compile(r"\d{1,12}(\.\d{1,12})?")


class Readable(Protocol):
    """What an HTTP response and a file have in common."""

    def readline(self, limit: int, /) -> bytes:
        """A line with its end, or its first ``limit`` bytes; b"" at the end of the stream."""

    def read(self, amount: int, /) -> bytes:
        """So many bytes, fewer at the end of the stream."""


class MultipartStream:
    """Open from construction. ``read()`` from one thread; ``interrupt()`` from any."""

    def __init__(self, url: str, timeout_s: float) -> None:
        """Connect; every later wait for bytes lasts at most ``timeout_s``.

        Raises:
            ConnectionLostError: nobody there, or no picture stream at this address.
            DeviceTimeoutError: no answer in time.
        """
        self._url = url
        parts = urlsplit(url)
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        self._connection = kind(parts.hostname or "", parts.port, timeout=timeout_s)
        try:
            self._connection.connect()
            # Kept, because http.client lets go of the socket's name as soon as the headers are in.
            self._socket: socket.socket = self._connection.sock
            target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
            self._connection.request("GET", target, headers={"Accept": "multipart/x-mixed-replace"})
            self._response = self._connection.getresponse()
            self._parts = PartReader(self._response, self._check_head(), url)
            self.serial_number: str | None = self._response.headers.get("X-Serial")
        except BaseException as error:
            self._connection.close()
            if isinstance(error, TimeoutError):
                raise DeviceTimeoutError(
                    f"{url}: no answer within {timeout_s:g} s; is the camera's server up?"
                ) from error
            if isinstance(error, OSError | http.client.HTTPException) and not isinstance(error, ConnectionLostError):
                raise ConnectionLostError(
                    f"{url}: cannot be opened ({error}); start the camera's server, or correct the URL in the rig file"
                ) from error
            raise

    def read(self) -> tuple[bytes, float | None]:
        """The next picture, and its X-Timestamp: seconds of CLOCK_MONOTONIC when exposure began, if the server tells.

        Raises:
            DeviceTimeoutError: no bytes in time; the stream cannot be used any more.
            ConnectionLostError: the server hung up.
            ProtocolError: this is no multipart stream.
        """
        try:
            return self._parts.read()
        except TimeoutError as error:
            raise DeviceTimeoutError(f"{self._url}: the stream stalled; is the camera still running?") from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            if isinstance(error, ConnectionLostError):
                raise
            raise ConnectionLostError(f"{self._url}: the stream broke off ({error}); start the camera again") from error

    def interrupt(self) -> None:
        """Let a waiting ``read()`` end at once."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Hang up; a second call does nothing."""
        self._response.close()
        self._connection.close()

    def _check_head(self) -> bytes:
        kind = self._response.headers.get("Content-Type", "")
        boundary = re.search(r'boundary="?([^";]+)"?', kind)
        if self._response.status != 200 or not kind.startswith("multipart/") or boundary is None:
            self._response.close()
            raise ConnectionLostError(
                f"{self._url}: answers {self._response.status} {kind or 'without a type'}, not a picture stream "
                "(multipart/x-mixed-replace); correct the URL in the rig file"
            )
        # Some servers write the dashes into the header as well.
        return b"--" + boundary[1].encode("latin-1").removeprefix(b"--")


class PartReader:
    """The parts of a multipart stream, one after the other; ``url`` is for the messages."""

    def __init__(self, stream: Readable, boundary: bytes, url: str) -> None:
        self._stream = stream
        self._boundary = boundary
        self._url = url

    def read(self) -> tuple[bytes, float | None]:
        """The next picture, and its X-Timestamp if it has one.

        Raises:
            ConnectionLostError: the stream ended.
            ProtocolError: this is no multipart stream.
        """
        self._skip_to_boundary()
        headers = self._headers()
        picture = self._body(headers)
        stamp = headers.get("x-timestamp")
        if stamp is None:
            return picture, None
        if not _SECONDS.fullmatch(stamp):
            raise ProtocolError(f"{self._url}: X-Timestamp {stamp!r} is no number of seconds, such as 1234.567")
        return picture, float(stamp)

    def _line(self) -> bytes:
        line = self._stream.readline(_LONGEST_LINE)
        if not line:
            raise ConnectionLostError(f"{self._url}: the server hung up; start the camera again")
        return line

    def _skip_to_boundary(self) -> None:
        skipped = 0
        while skipped <= _LARGEST_PICTURE:
            line = self._line()
            skipped += len(line)
            line = line.rstrip(b"\r\n")
            if line == self._boundary:
                return
            if line == self._boundary + b"--":
                raise ConnectionLostError(f"{self._url}: the server ended the stream; start the camera again")
        raise ProtocolError(f"{self._url}: no boundary within {_LARGEST_PICTURE} bytes; is this a multipart stream?")

    def _headers(self) -> dict[str, str]:
        headers: dict[str, str] = {}
        for _ in range(_MOST_HEADERS):
            line = self._line().rstrip(b"\r\n")
            if not line:
                return headers
            name, colon, value = line.decode("latin-1").partition(":")
            if not colon:
                break
            headers[name.strip().lower()] = value.strip()
        raise ProtocolError(f"{self._url}: part without a proper header; is this a multipart stream?")

    def _body(self, headers: dict[str, str]) -> bytes:
        length = headers.get("content-length")
        if length is None:
            raise ProtocolError(f"{self._url}: part without Content-Length; use a server that sends it")
        if not length.isdecimal() or int(length) > _LARGEST_PICTURE:
            raise ProtocolError(f"{self._url}: Content-Length {length!r}, allowed up to {_LARGEST_PICTURE} bytes")
        picture = self._stream.read(int(length))
        if len(picture) != int(length):
            raise ConnectionLostError(f"{self._url}: the server hung up within a picture; start the camera again")
        return picture
