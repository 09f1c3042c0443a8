"""b-CAP packets as the emulated controller reads and writes them (DENSO, b-CAP communication specification)."""

import struct
from dataclasses import dataclass
from typing import Any, Final

LARGEST_DATAGRAM: Final = 503

_NUMBERS: Final = {2: "h", 3: "i", 4: "f", 5: "d", 11: "h", 17: "B"}
"""VT_I2, VT_I4, VT_R4, VT_R8, VT_BOOL, VT_UI1."""
_VT_BSTR, _VT_VARIANT, _VT_ARRAY = 8, 12, 0x2000


@dataclass(frozen=True)
class Request:
    """What a client asks for. ``retries`` is the serial number of the first try, 0 in the first try itself."""

    serial: int
    retries: int
    function: int
    arguments: tuple[Any, ...]


def read_request(datagram: bytes) -> Request | None:
    """A request; None where the datagram is none, which a controller leaves without an answer."""
    try:
        start, length, serial, retries, function, count = struct.unpack_from("<BIHHiH", datagram)
        if (start, length, datagram[-1]) != (1, len(datagram), 4) or length > LARGEST_DATAGRAM or serial == 0:
            return None
        at, arguments = 15, []
        for _ in range(count):
            (size,) = struct.unpack_from("<I", datagram, at)
            value, end = _read_variant(datagram, at + 4)
            if end != at + 4 + size:
                return None
            arguments.append(value)
            at = end
    except (struct.error, UnicodeDecodeError, KeyError):
        return None
    return Request(serial, retries, function, tuple(arguments)) if at == len(datagram) - 1 else None


def write_reply(serial: int, retries: int, result: int, value: Any = None) -> bytes:
    """The reply with its value, if there is one."""
    arguments = b""
    if value is not None:
        variant = _write_variant(value)
        arguments = struct.pack("<I", len(variant)) + variant
    length = 15 + len(arguments) + 1
    return struct.pack("<BIHHIH", 1, length, serial, retries, result, int(value is not None)) + arguments + b"\x04"


def _read_variant(data: bytes, at: int) -> tuple[Any, int]:
    kind, count = struct.unpack_from("<HI", data, at)
    at += 6
    if count > len(data):
        raise struct.error("count beyond the datagram")
    if not kind & _VT_ARRAY:
        if kind in (0, 1):
            return None, at
        return _read_element(data, at, kind)
    values = []
    for _ in range(count):
        element = kind & ~_VT_ARRAY
        value, at = _read_variant(data, at) if element == _VT_VARIANT else _read_element(data, at, element)
        values.append(value)
    return values, at


def _read_element(data: bytes, at: int, kind: int) -> tuple[Any, int]:
    if kind == _VT_BSTR:
        (size,) = struct.unpack_from("<I", data, at)
        text = data[at + 4 : at + 4 + size]
        if len(text) != size:
            raise struct.error("text beyond the datagram")
        return text.decode("utf-16-le"), at + 4 + size
    code = "<" + _NUMBERS[kind]
    (number,) = struct.unpack_from(code, data, at)
    return number, at + struct.calcsize(code)


def _write_variant(value: Any) -> bytes:
    if isinstance(value, bool):
        return struct.pack("<HIh", 11, 1, -1 if value else 0)
    if isinstance(value, int):
        return struct.pack("<HIi", 3, 1, value)
    if isinstance(value, str):
        text = value.encode("utf-16-le")
        return struct.pack("<HII", _VT_BSTR, 1, len(text)) + text
    return struct.pack(f"<HI{len(value)}d", 5 | _VT_ARRAY, len(value), *value)
