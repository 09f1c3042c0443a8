"""b-CAP packets (DENSO, b-CAP communication specification for the RC8, packet format): values to bytes and back.

A packet is SOH, the length of all of it, a serial number, a reserve, a function (in a reply: a result), the number of
arguments, the arguments and EOT, little-endian. An argument is the length of what follows, a type, a count and data.
Nothing is guessed: bytes that are not exactly one packet are a ``ProtocolError``.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from drivers.errors import ProtocolError

Value = None | bool | int | float | str | tuple["Value", ...]

MAX_BYTES = 503
"""Of a packet over UDP."""
SOH, EOT = 0x01, 0x04
_HEADER = struct.Struct("<BIHHIH")
_LENGTH = struct.Struct("<I")
_TYPE = struct.Struct("<HI")
_EMPTY, _NULL, _I2, _I4, _R4, _R8, _BSTR, _BOOL, _VARIANT, _UI1 = 0, 1, 2, 3, 4, 5, 8, 11, 12, 17
_ARRAY = 0x2000
_FIXED = {
    _I2: struct.Struct("<h"),
    _I4: struct.Struct("<i"),
    _R4: struct.Struct("<f"),
    _R8: struct.Struct("<d"),
    _BOOL: struct.Struct("<h"),
    _UI1: struct.Struct("<B"),
}
_DEEPEST = 4
"""Arrays within arrays; no reply has more than two."""


@dataclass(frozen=True)
class Packet:
    """One request or reply. ``code`` is the function of a request, and the result (HRESULT) of a reply."""

    serial: int
    reserve: int
    code: int
    arguments: tuple[Value, ...] = ()


def encode(packet: Packet) -> bytes:
    """A packet as it goes on the wire: int is I4, float R8, bool BOOL, str BSTR, and a tuple an array of these.

    Raises:
        ProtocolError: it does not fit into a datagram, or a number not into its field.
    """
    try:
        bodies = [_encoded(argument) for argument in packet.arguments]
        body = b"".join(_LENGTH.pack(len(each)) + each for each in bodies)
        length = _HEADER.size + len(body) + 1
        header = _HEADER.pack(SOH, length, packet.serial, packet.reserve, packet.code, len(bodies))
    except struct.error as error:
        raise ProtocolError(f"b-CAP packet {packet}: cannot be written ({error}); this is mill's own mistake") from None
    if length > MAX_BYTES:
        raise ProtocolError(f"b-CAP packet of {length} bytes: at most {MAX_BYTES} go over UDP; send less at once")
    return header + body + bytes((EOT,))


def decode(data: bytes) -> Packet:
    """The packet that ``data`` is, all of it.

    Raises:
        ProtocolError: it is not exactly one packet.
    """
    if not _HEADER.size < len(data) <= MAX_BYTES:
        raise _broken(data, f"{len(data)} bytes, allowed {_HEADER.size + 1} to {MAX_BYTES}")
    soh, length, serial, reserve, code, count = _HEADER.unpack_from(data)
    if soh != SOH or data[-1] != EOT:
        raise _broken(data, f"begins with {soh:#04x} and ends with {data[-1]:#04x}, due are 0x01 and 0x04")
    if length != len(data):
        raise _broken(data, f"says {length} bytes and has {len(data)}")
    reader = _Reader(data, _HEADER.size, len(data) - 1)
    arguments = tuple(_argument(reader) for _ in _counted(reader, count))
    reader.require_end()
    return Packet(serial, reserve, code, arguments)


def _encoded(value: Value) -> bytes:
    """Type, count and data."""
    if isinstance(value, tuple):
        kinds = {_kind(each) for each in value}
        if len(kinds) == 1 and kinds <= _FIXED.keys() | {_BSTR}:
            kind = kinds.pop()
            return _TYPE.pack(kind | _ARRAY, len(value)) + b"".join(_data(kind, each) for each in value)
        return _TYPE.pack(_VARIANT | _ARRAY, len(value)) + b"".join(_encoded(each) for each in value)
    kind = _kind(value)
    return _TYPE.pack(kind, 1) + _data(kind, value)


def _kind(value: Value) -> int:
    match value:
        case None:
            return _EMPTY
        case bool():
            return _BOOL
        case int():
            return _I4
        case float():
            return _R8
        case str():
            return _BSTR
        case _:
            return _VARIANT


def _data(kind: int, value: Value) -> bytes:
    if isinstance(value, str):
        text = value.encode("utf-16-le")
        return _LENGTH.pack(len(text)) + text
    if value is None:
        return b""
    return _FIXED[kind].pack(-1 if value is True else value)


class _Reader:
    """A place in the bytes that never leaves them."""

    def __init__(self, data: bytes, at: int, end: int) -> None:
        self._data = data
        self._at = at
        self._end = end

    @property
    def left(self) -> int:
        return self._end - self._at

    def take(self, size: int) -> bytes:
        if size > self.left:
            raise self.broken(f"an argument wants {size} bytes where {self.left} are left")
        self._at += size
        return self._data[self._at - size : self._at]

    def part(self, size: int) -> "_Reader":
        self.take(size)
        return _Reader(self._data, self._at - size, self._at)

    def require_end(self) -> None:
        if self.left:
            raise self.broken(f"{self.left} bytes more than its arguments")

    def broken(self, found: str) -> ProtocolError:
        return _broken(self._data, found)


def _argument(reader: _Reader) -> Value:
    (size,) = _LENGTH.unpack(reader.take(_LENGTH.size))
    part = reader.part(size)
    value = _value(part, 0)
    part.require_end()
    return value


def _value(reader: _Reader, depth: int) -> Value:
    kind, count = _TYPE.unpack(reader.take(_TYPE.size))
    if kind & _ARRAY:
        element = kind & ~_ARRAY
        if element == _VARIANT:
            if depth >= _DEEPEST:
                raise reader.broken(f"arrays within arrays deeper than {_DEEPEST}")
            return tuple(_value(reader, depth + 1) for _ in _counted(reader, count))
        return tuple(_element(reader, element) for _ in _counted(reader, count))
    if kind in (_EMPTY, _NULL):
        if count > 1:
            raise reader.broken(f"count {count} of nothing")
        return None
    if count != 1:
        raise reader.broken(f"count {count} of a single value")
    return _element(reader, kind)


def _counted(reader: _Reader, count: int) -> Iterator[int]:
    # Every element takes a byte at least, so that a wrong count cannot keep anybody busy.
    if count > reader.left:
        raise reader.broken(f"count {count} where {reader.left} bytes are left")
    return iter(range(count))


def _element(reader: _Reader, kind: int) -> Value:
    if kind == _BSTR:
        (size,) = _LENGTH.unpack(reader.take(_LENGTH.size))
        try:
            return reader.take(size).decode("utf-16-le")
        except UnicodeDecodeError as error:
            raise reader.broken(f"a text that is not UTF-16 ({error.reason})") from None
    shape = _FIXED.get(kind)
    if shape is None:
        raise reader.broken(f"type {kind:#06x}, which mill does not know")
    (number,) = shape.unpack(reader.take(shape.size))
    if kind == _BOOL:
        if number not in (0, -1):
            raise reader.broken(f"truth value {number}, allowed 0 and -1")
        return bool(number)
    return int(number) if isinstance(number, int) else float(number)


def _broken(data: bytes, found: str) -> ProtocolError:
    return ProtocolError(
        f"not a b-CAP packet: {found}; it begins {data[:24].hex(' ')!r}; look at network and controller"
    )
