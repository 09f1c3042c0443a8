"""A CANopen slave by CiA 301: NMT, SDO server, SYNC, PDOs, emergencies, heartbeats.

Left out: block transfer, node guarding and remote frames, LSS, SYNC and TIME production, storing of parameters, the
dynamic change of identifiers of SDOs. A device derives from it, adds its objects, and overrides the hooks.
"""

from collections import deque
from enum import IntEnum

from firmware_sim.can_wire import Frame
from firmware_sim.canopen_dictionary import U8, U16, U32, Abort, Entry, Key, ObjectDictionary, SdoAbort
from firmware_sim.canopen_pdo import Pdos
from firmware_sim.canopen_sdo import SdoServer

CYCLE_S = 0.002
BOOT_S = 0.08
HISTORY_LENGTH = 8

COMMUNICATION_ERROR = 0x10
GENERIC_ERROR = 0x01


class NmtState(IntEnum):
    """As the heartbeat tells them."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class CanopenSlave:
    """One node. Frames in by ``receive``, out by ``transmit``; time passes in ``advance_to`` only."""

    def __init__(self, *, node_id: int, device_type: int, name: str, hardware: str, software: str, serial: int) -> None:
        if not 1 <= node_id <= 127:
            raise ValueError(f"node id {node_id}: CANopen allows 1 to 127")
        self.node_id = node_id
        self.dictionary = ObjectDictionary()
        self.nmt_state = NmtState.INITIALISING
        self._out: deque[Frame] = deque()
        self._cycle_index = 0
        self._boot_at_s = BOOT_S
        self._heartbeat_at_s = 0.0
        self._watch_until_s: float | None = None
        self.minds_silence = True
        """Whether the heartbeat consumer does what it says; a drive in which it does not looks like any other."""
        self._errors: dict[int, int] = {}
        self._history: list[int] = []
        self._add_communication_objects(device_type, name, hardware, software, serial)
        self._producer_ms = self.dictionary.entry((0x1017, 0))
        self._sdo = SdoServer(self.read_object, self.write_object)
        self.pdos = Pdos(self.dictionary, node_id)

    # --- the wire

    def receive(self, can_id: int, data: bytes) -> None:
        """A frame from the bus; while the node boots it hears nothing."""
        if self.nmt_state is NmtState.INITIALISING:
            return
        if can_id == 0x000:
            self._receive_nmt(data)
        elif can_id == 0x600 + self.node_id:
            if self.nmt_state is not NmtState.STOPPED and len(data) == 8:
                self._out.extend((0x580 + self.node_id, reply) for reply in self._sdo.answer(data))
        elif can_id == self.dictionary[0x1016, 1] >> 16 & 0x7F | 0x700:
            self._receive_heartbeat()
        elif self.nmt_state is NmtState.OPERATIONAL:
            if can_id == self.dictionary[0x1005, 0] & 0x7FF:
                self._synchronise()
            else:
                self._receive_pdo(can_id, data)

    def transmit(self) -> list[Frame]:
        """The frames that the node wants to send since the last call."""
        if not self._out:
            return []
        frames = list(self._out)
        self._out.clear()
        return frames

    def advance_to(self, time_s: float) -> None:
        """Run the node's cycles of 2 ms up to ``time_s``."""
        while (cycle_s := (self._cycle_index + 1) * CYCLE_S) <= time_s + 1e-9:
            self._cycle_index += 1
            self._run_cycle(cycle_s)

    @property
    def time_s(self) -> float:
        """The time of the last cycle."""
        return self._cycle_index * CYCLE_S

    def _run_cycle(self, time_s: float) -> None:
        if self.nmt_state is NmtState.INITIALISING:
            if time_s >= self._boot_at_s:
                self.nmt_state = NmtState.PRE_OPERATIONAL
                self._out.append((0x700 + self.node_id, b"\x00"))
                self._heartbeat_at_s = time_s
                self.on_boot()
            self.run_cycle(time_s)
            return
        if self._watch_until_s is not None and time_s > self._watch_until_s:
            self._watch_until_s = None
            if self.minds_silence:
                self._lose_heartbeat()
        self.run_cycle(time_s)
        producer_s = self._producer_ms.value / 1000
        if producer_s > 0 and time_s >= self._heartbeat_at_s:
            self._out.append((0x700 + self.node_id, bytes((self.nmt_state,))))
            self._heartbeat_at_s = max(self._heartbeat_at_s + producer_s, time_s)
        if self.nmt_state is NmtState.OPERATIONAL:
            self._out.extend(self.pdos.due(time_s))

    # --- hooks of the device

    def on_boot(self) -> None:
        """The node has just said that it is there."""

    def on_reset(self) -> None:
        """The node restarts; the objects are at their defaults."""

    def on_connection_lost(self) -> None:
        """The host's heartbeat stopped, or the host stopped the node."""

    def on_written(self, key: Key) -> None:
        """The host has written an object."""

    def run_cycle(self, time_s: float) -> None:
        """One cycle of the device."""

    # --- errors

    def raise_error(self, code: int, register_bits: int) -> None:
        """Send an emergency and remember the error, once for as long as it lasts."""
        if code in self._errors:
            return
        self._errors[code] = register_bits | GENERIC_ERROR
        self._history = [code, *self._history][:HISTORY_LENGTH]
        self._tell_emergency(code)

    def clear_error(self, code: int) -> None:
        """The error is over; when it was the last one, say so."""
        if self._errors.pop(code, None) is not None:
            self._update_register()
            if not self._errors:
                self._tell_emergency(0x0000)

    @property
    def errors(self) -> tuple[int, ...]:
        """The codes of the errors that last, oldest first."""
        return tuple(self._errors)

    def _update_register(self) -> None:
        register = 0
        for bits in self._errors.values():
            register |= bits
        self.dictionary[0x1001, 0] = register

    def _tell_emergency(self, code: int) -> None:
        self._update_register()
        cob_id = self.dictionary[0x1014, 0]
        if self.nmt_state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL) and not cob_id & 0x8000_0000:
            payload = code.to_bytes(2, "little") + bytes((self.dictionary[0x1001, 0],)) + bytes(5)
            self._out.append((cob_id & 0x7FF, payload))

    # --- network management

    def _receive_nmt(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return
        match data[0]:
            case 1:
                self._enter(NmtState.OPERATIONAL)
            case 2:
                self._enter(NmtState.STOPPED)
            case 128:
                self._enter(NmtState.PRE_OPERATIONAL)
            case 129:
                self._reset(below=0x1_0000)
            case 130:
                self._reset(below=0x2000)

    def _enter(self, state: NmtState) -> None:
        if state is self.nmt_state:
            return
        self.nmt_state = state
        if state is NmtState.OPERATIONAL:
            self.pdos.start(self.time_s)
        elif state is NmtState.STOPPED:
            self.on_connection_lost()

    def _reset(self, *, below: int) -> None:
        self.nmt_state = NmtState.INITIALISING
        self.dictionary.restore(below=below)
        self.pdos.restored()
        self._boot_at_s = self.time_s + BOOT_S
        self._watch_until_s = None
        self._errors.clear()
        self._update_register()
        self._history.clear()
        self._out.clear()
        self._sdo.reset()
        self.on_reset()

    # --- heartbeats

    def _receive_heartbeat(self) -> None:
        # Watching begins with the first beat (CiA 301), not with the writing of 1016.
        watch_s = (self.dictionary[0x1016, 1] & 0xFFFF) / 1000
        if watch_s > 0 and self.dictionary[0x1016, 1] >> 16 & 0x7F:
            self._watch_until_s = self.time_s + watch_s
            self.clear_error(0x8130)

    def _lose_heartbeat(self) -> None:
        self.raise_error(0x8130, COMMUNICATION_ERROR)
        behaviour = self.dictionary[0x1029, 1]
        if behaviour == 0 and self.nmt_state is NmtState.OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL)
        self.on_connection_lost()
        if behaviour == 2:
            self.nmt_state = NmtState.STOPPED

    # --- process data

    def _synchronise(self) -> None:
        for data, mapping in self.pdos.synchronised_inputs():
            self._apply_pdo(data, mapping)
        self._out.extend(self.pdos.on_sync(self.time_s))

    def _receive_pdo(self, can_id: int, data: bytes) -> None:
        accepted = self.pdos.accept(can_id, data)
        if accepted is None:
            return
        if not accepted.long_enough:
            self.raise_error(0x8210, COMMUNICATION_ERROR)
            self.clear_error(0x8210)
        elif accepted.at_once:
            self._apply_pdo(data, accepted.mapping)

    def _apply_pdo(self, data: bytes, mapping: tuple[tuple[Key, int], ...]) -> None:
        offset = 0
        for key, size in mapping:
            # A value that the object refuses leaves the object as it is; the other objects of the PDO are written.
            try:
                self.write_object(key, data[offset : offset + size])
            except SdoAbort:
                self.raise_error(0x8200, COMMUNICATION_ERROR)
                self.clear_error(0x8200)
            offset += size

    # --- objects

    def read_object(self, key: Key) -> bytes:
        """What the host reads."""
        if key[0] == 0x1003:
            if key[1] == 0:
                return bytes((len(self._history),))
            if key[1] > HISTORY_LENGTH:
                raise SdoAbort(Abort.NO_SUBINDEX)
            if key[1] > len(self._history):
                raise SdoAbort(Abort.NO_DATA)
            return U32.encode(self._history[key[1] - 1])
        return self.dictionary.read(key)

    def write_object(self, key: Key, data: bytes) -> None:
        """What the host writes; nothing changes if it is refused."""
        value = self.dictionary.check(key, data)
        self.pdos.check(key, value)
        if key[0] == 0x1016:
            self._check_consumer(value)
        if key[0] == 0x1014:
            self._check_emergency_id(value)
        self.dictionary[key] = value
        self.pdos.written(key)
        if key == (0x1003, 0):
            self._history.clear()
        elif key[0] == 0x1016:
            self._watch_until_s = None
            self.clear_error(0x8130)
        elif key[0] == 0x1017:
            self._heartbeat_at_s = self.time_s
        self.on_written(key)

    def _check_consumer(self, value: int) -> None:
        if value >> 24 or value >> 16 & 0xFF > 127:
            raise SdoAbort(Abort.INVALID_VALUE)
        if value >> 16 & 0xFF == self.node_id:
            raise SdoAbort(Abort.INCOMPATIBLE)

    def _check_emergency_id(self, value: int) -> None:
        if value & 0x7FFF_F800 or not value & 0x7FF:
            raise SdoAbort(Abort.INVALID_VALUE)

    def _add_communication_objects(
        self, device_type: int, name: str, hardware: str, software: str, serial: int
    ) -> None:
        objects = self.dictionary
        objects.add(0x1000, 0, Entry(U32, device_type))
        objects.add(0x1001, 0, Entry(U8, mappable=True))
        objects.add(0x1003, 0, Entry(U8, writable=True, allowed=(0,)))
        for subindex in range(1, HISTORY_LENGTH + 1):
            objects.add(0x1003, subindex, Entry(U32))
        objects.add(0x1005, 0, Entry(U32, 0x80))
        objects.add(0x1008, 0, Entry(None, text=name))
        objects.add(0x1009, 0, Entry(None, text=hardware))
        objects.add(0x100A, 0, Entry(None, text=software))
        objects.add(0x1014, 0, Entry(U32, 0x80 + self.node_id, True))
        objects.add_record(0x1016, [Entry(U32, 0, True)])
        objects.add(0x1017, 0, Entry(U16, 0, True))
        objects.add_record(0x1018, [Entry(U32, 0), Entry(U32, 402), Entry(U32, 0x0001_0000), Entry(U32, serial)])
        objects.add_record(0x1029, [Entry(U8, 0, True, allowed=(0, 1, 2))])
        objects.add_record(0x1200, [Entry(U32, 0x600 + self.node_id), Entry(U32, 0x580 + self.node_id)])
