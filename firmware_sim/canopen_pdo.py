"""Process data objects (CiA 301, 7.2.2): four each way, mapping, synchronous and event-driven transmission."""

from collections.abc import Iterator
from dataclasses import dataclass

from firmware_sim.can_wire import Frame
from firmware_sim.canopen_dictionary import U8, U16, U32, Abort, Entry, IntegerType, Key, ObjectDictionary, SdoAbort

PDO_COUNT = 4
_INVALID = 0x8000_0000
_NO_RTR = 0x4000_0000
_MAPPED_MAX = 8
_RECEIVE, _TRANSMIT = 0x1400, 0x1800
_MAPPING = 0x200
"""From a PDO's communication record to its mapping record."""

Mapping = tuple[tuple[Key, int], ...]
"""Object and its size in bytes, in the order of the data."""


@dataclass(frozen=True)
class Accepted:
    """A received PDO: whether its data suffice, whether it counts at once or at the next SYNC."""

    mapping: Mapping
    long_enough: bool
    at_once: bool


@dataclass(frozen=True)
class _EventDriven:
    """A PDO that is sent by itself, as its records say until they are written again."""

    number: int
    can_id: int
    inhibit_s: float
    timer_s: float
    mapped: tuple[tuple[IntegerType, Entry], ...]


@dataclass
class _Outgoing:
    sent: bytes | None = None
    sent_at_s: float = float("-inf")
    syncs: int = 0
    changed: bool = False


class Pdos:
    """The node's PDOs, as the dictionary describes them."""

    def __init__(self, dictionary: ObjectDictionary, node_id: int) -> None:
        self._dictionary = dictionary
        self._outgoing = [_Outgoing() for _ in range(PDO_COUNT)]
        self._waiting: dict[int, bytes] = {}
        self._event_driven: list[_EventDriven] | None = None
        """Read from the dictionary when it is needed; None since a record was written."""
        for number in range(PDO_COUNT):
            enabled = 0 if number == 0 else _INVALID
            dictionary.add_record(
                _RECEIVE + number,
                [Entry(U32, enabled | 0x200 + 0x100 * number + node_id, True), Entry(U8, 255, True)],
            )
            dictionary.add_record(
                _TRANSMIT + number,
                [
                    Entry(U32, enabled | _NO_RTR | 0x180 + 0x100 * number + node_id, True),
                    Entry(U8, 255, True),
                    Entry(U16, 0, True),
                    Entry(U8),
                    Entry(U16, 0, True),
                ],
            )
            for base in (_RECEIVE, _TRANSMIT):
                dictionary.add(base + _MAPPING + number, 0, Entry(U8, 0, True, high=_MAPPED_MAX))
                for subindex in range(1, _MAPPED_MAX + 1):
                    dictionary.add(base + _MAPPING + number, subindex, Entry(U32, 0, True))

    def set_default(self, base: int, number: int, *objects: tuple[int, int, int]) -> None:
        """Map (index, sub-index, bits) from power-up on; ``base`` is 1400 or 1800 hex, ``number`` counts from 0."""
        mapped = [index << 16 | subindex << 8 | bits for index, subindex, bits in objects]
        for subindex, value in enumerate([len(mapped), *mapped]):
            entry = self._dictionary.entry((base + _MAPPING + number, subindex))
            entry.default = entry.value = value
        self._event_driven = None

    def start(self, time_s: float) -> None:
        """The node became operational: event-driven PDOs tell their first state."""
        self._waiting.clear()
        self._outgoing = [_Outgoing(sent_at_s=time_s - 1.0) for _ in range(PDO_COUNT)]

    # --- configuration

    def written(self, key: Key) -> None:
        """The host has written an object."""
        if _RECEIVE <= key[0] < _TRANSMIT + _MAPPING + PDO_COUNT:
            self._event_driven = None

    def restored(self) -> None:
        """The dictionary is at its defaults."""
        self._event_driven = None

    def check(self, key: Key, value: int) -> None:
        """Refuse what CiA 301 does not allow to be written to a PDO's records."""
        index, subindex = key
        for base in (_RECEIVE, _TRANSMIT):
            if base <= index < base + PDO_COUNT:
                self._check_communication(base, index, subindex, value)
            elif base + _MAPPING <= index < base + _MAPPING + PDO_COUNT:
                self._check_mapping(base, index, subindex, value)

    def _check_communication(self, base: int, index: int, subindex: int, value: int) -> None:
        present = self._dictionary[index, 1]
        valid = not present & _INVALID
        if subindex == 1:
            if value & 0x3FFF_F800 or not value & 0x7FF:
                raise SdoAbort(Abort.INVALID_VALUE)
            if valid and not value & _INVALID and (value ^ present) & 0x7FF:
                raise SdoAbort(Abort.INVALID_VALUE)
        elif subindex == 2 and (241 <= value <= 251 or 252 <= value <= 253):
            # 252 and 253 wait for a remote frame, which this node does not answer.
            raise SdoAbort(Abort.INVALID_VALUE)
        elif subindex == 3 and base == _TRANSMIT and valid:
            raise SdoAbort(Abort.INVALID_VALUE)

    def _check_mapping(self, base: int, index: int, subindex: int, value: int) -> None:
        if not self._dictionary[index - _MAPPING, 1] & _INVALID:
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if subindex == 0:
            mapped = [self._dictionary[index, number] for number in range(1, value + 1)]
            if 0 in mapped:
                raise SdoAbort(Abort.NO_OBJECT)
            if sum(entry & 0xFF for entry in mapped) > 64:
                raise SdoAbort(Abort.PDO_TOO_LONG)
            return
        if self._dictionary[index, 0]:
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if value == 0:
            return
        entry = self._dictionary.entry((value >> 16, value >> 8 & 0xFF))
        if not entry.mappable or entry.kind is None or (base == _RECEIVE and not entry.writable):
            raise SdoAbort(Abort.NOT_MAPPABLE)
        if value & 0xFF != 8 * entry.kind.size:
            raise SdoAbort(Abort.NOT_MAPPABLE)

    # --- receiving

    def accept(self, can_id: int, data: bytes) -> Accepted | None:
        """The PDO that this frame is, or None; a synchronous one waits for the next SYNC."""
        for number in range(PDO_COUNT):
            cob_id = self._dictionary[_RECEIVE + number, 1]
            if cob_id & _INVALID or cob_id & 0x7FF != can_id:
                continue
            mapping = self._mapping(_RECEIVE + number)
            long_enough = len(data) >= sum(size for _, size in mapping)
            at_once = self._dictionary[_RECEIVE + number, 2] >= 254
            if long_enough and not at_once:
                self._waiting[number] = data
            return Accepted(mapping, long_enough, at_once)
        return None

    def synchronised_inputs(self) -> Iterator[tuple[bytes, Mapping]]:
        """The received PDOs that a SYNC makes count."""
        waiting, self._waiting = self._waiting, {}
        for number, data in sorted(waiting.items()):
            yield data, self._mapping(_RECEIVE + number)

    # --- sending

    def on_sync(self, time_s: float) -> Iterator[Frame]:
        """What a SYNC asks for: every n-th for type n, after a change for type 0."""
        for number, can_id, kind in self._valid_outgoing():
            state = self._outgoing[number]
            if kind > 240:
                continue
            data = self._data(number)
            state.syncs += 1
            if (kind == 0 and data != state.sent) or (kind and state.syncs >= kind):
                state.syncs = 0
                state.sent, state.sent_at_s = data, time_s
                yield can_id, data

    def due(self, time_s: float) -> Iterator[Frame]:
        """Event-driven PDOs: on change, not before the inhibit time, and at the latest after the event timer."""
        if self._event_driven is None:
            self._event_driven = [
                self._sent_by_itself(number, can_id) for number, can_id, kind in self._valid_outgoing() if kind >= 254
            ]
        for pdo in self._event_driven:
            state = self._outgoing[pdo.number]
            data = b"".join([kind.encode(entry.value) for kind, entry in pdo.mapped])
            age_s = time_s - state.sent_at_s + 1e-9
            if (data != state.sent and age_s >= pdo.inhibit_s) or (pdo.timer_s and age_s >= pdo.timer_s):
                state.sent, state.sent_at_s = data, time_s
                yield pdo.can_id, data

    def _sent_by_itself(self, number: int, can_id: int) -> _EventDriven:
        objects = self._dictionary
        entries = [objects.entry(key) for key, _ in self._mapping(_TRANSMIT + number)]
        return _EventDriven(
            number,
            can_id,
            objects[_TRANSMIT + number, 3] * 1e-4,
            objects[_TRANSMIT + number, 5] * 1e-3,
            tuple((entry.kind, entry) for entry in entries if entry.kind is not None),
        )

    def _valid_outgoing(self) -> Iterator[tuple[int, int, int]]:
        for number in range(PDO_COUNT):
            cob_id = self._dictionary[_TRANSMIT + number, 1]
            if not cob_id & _INVALID:
                yield number, cob_id & 0x7FF, self._dictionary[_TRANSMIT + number, 2]

    def _data(self, number: int) -> bytes:
        return b"".join(self._dictionary.read(key) for key, _ in self._mapping(_TRANSMIT + number))

    def _mapping(self, index: int) -> Mapping:
        index += _MAPPING
        mapped = (self._dictionary[index, number] for number in range(1, self._dictionary[index, 0] + 1))
        return tuple(((value >> 16, value >> 8 & 0xFF), (value & 0xFF) // 8) for value in mapped)
