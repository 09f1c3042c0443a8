"""A CANopen object dictionary: typed entries with the access rules and abort codes of CiA 301."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

Key = tuple[int, int]
"""Index and sub-index."""


class Abort(IntEnum):
    """SDO abort codes (CiA 301, table 22)."""

    TOGGLE = 0x0503_0000
    UNKNOWN_COMMAND = 0x0504_0001
    UNSUPPORTED_ACCESS = 0x0601_0000
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_TOO_LONG = 0x0604_0042
    INCOMPATIBLE = 0x0604_0043
    WRONG_LENGTH = 0x0607_0010
    TOO_LONG = 0x0607_0012
    TOO_SHORT = 0x0607_0013
    NO_SUBINDEX = 0x0609_0011
    INVALID_VALUE = 0x0609_0030
    VALUE_TOO_HIGH = 0x0609_0031
    VALUE_TOO_LOW = 0x0609_0032
    NO_DATA = 0x0800_0024


class SdoAbort(Exception):  # noqa: N818  (the name that the standard gives it)
    """An access that the dictionary refuses."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"0x{code:08X} {code.name}")
        self.code = code


@dataclass(frozen=True)
class IntegerType:
    """UNSIGNEDn or INTEGERn, little-endian on the wire."""

    size: int
    signed: bool

    @property
    def low(self) -> int:
        """The smallest value that fits."""
        return -(1 << (8 * self.size - 1)) if self.signed else 0

    @property
    def high(self) -> int:
        """The largest value that fits."""
        return (1 << (8 * self.size - 1)) - 1 if self.signed else (1 << (8 * self.size)) - 1

    def encode(self, value: int) -> bytes:
        """The value as bytes."""
        return value.to_bytes(self.size, "little", signed=self.signed)

    def decode(self, data: bytes) -> int:
        """The bytes as a value."""
        return int.from_bytes(data, "little", signed=self.signed)


U8, U16, U32 = IntegerType(1, False), IntegerType(2, False), IntegerType(4, False)
I8, I16, I32 = IntegerType(1, True), IntegerType(2, True), IntegerType(4, True)


@dataclass
class Entry:
    """One sub-index. ``kind`` is None for a VISIBLE_STRING, whose text is in ``text`` and never changes."""

    kind: IntegerType | None
    default: int = 0
    writable: bool = False
    low: int | None = None
    high: int | None = None
    allowed: tuple[int, ...] | None = None
    mappable: bool = False
    text: str = ""
    value: int = 0

    def __post_init__(self) -> None:
        self.value = self.default


class ObjectDictionary:
    """Entries by index and sub-index; plain indexing is the device's own access, which knows no rules."""

    def __init__(self) -> None:
        self._entries: dict[Key, Entry] = {}
        self._indices: set[int] = set()

    def add(self, index: int, subindex: int, entry: Entry) -> None:
        """Define an entry."""
        self._entries[index, subindex] = entry
        self._indices.add(index)

    def add_record(self, index: int, entries: Iterable[Entry]) -> None:
        """Define a record or array: sub-index 0 tells the highest sub-index, the entries follow from 1."""
        entries = tuple(entries)
        self.add(index, 0, Entry(U8, len(entries)))
        for subindex, entry in enumerate(entries, start=1):
            self.add(index, subindex, entry)

    def __getitem__(self, key: Key) -> int:
        return self._entries[key].value

    def __setitem__(self, key: Key, value: int) -> None:
        self._entries[key].value = value

    def entry(self, key: Key) -> Entry:
        """The entry, or the abort that CiA 301 names for its absence."""
        if key in self._entries:
            return self._entries[key]
        raise SdoAbort(Abort.NO_SUBINDEX if key[0] in self._indices else Abort.NO_OBJECT)

    def read(self, key: Key) -> bytes:
        """What an SDO upload returns."""
        entry = self.entry(key)
        return entry.text.encode("ascii") if entry.kind is None else entry.kind.encode(entry.value)

    def check(self, key: Key, data: bytes) -> int:
        """The value that an SDO download or a PDO would store, by the entry's rules; stores nothing."""
        entry = self.entry(key)
        if entry.kind is None or not entry.writable:
            raise SdoAbort(Abort.READ_ONLY)
        if len(data) != entry.kind.size:
            raise SdoAbort(Abort.TOO_LONG if len(data) > entry.kind.size else Abort.TOO_SHORT)
        value = entry.kind.decode(data)
        if entry.allowed is not None and value not in entry.allowed:
            raise SdoAbort(Abort.INVALID_VALUE)
        if entry.high is not None and value > entry.high:
            raise SdoAbort(Abort.VALUE_TOO_HIGH)
        if entry.low is not None and value < entry.low:
            raise SdoAbort(Abort.VALUE_TOO_LOW)
        return value

    def restore(self, *, below: int = 0x1_0000) -> None:
        """Back to the defaults, for indices below ``below``."""
        for (index, _), entry in self._entries.items():
            if index < below:
                entry.value = entry.default
