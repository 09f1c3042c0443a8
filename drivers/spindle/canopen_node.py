"""One CANopen node as its host sees it, without a thread.

canopen keeps its protocol (SDO, NMT, EMCY); its receiving thread is not used, because that thread dies at the first
bus error and nobody notices. Frames are read here while somebody waits for something, and bus errors fill a leaky
bucket: a lone one is forgiven, a run of them is a lost wire.
"""

import logging
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import can
import canopen

from drivers.clock import Clock
from drivers.errors import ConnectionLostError, DeviceFaultError, DeviceTimeoutError, ProtocolError

NMT_START = 0x01
NMT_ENTER_PRE_OPERATIONAL = 0x80
OPERATIONAL = 5

HOST_NODE_ID = 127
SYNC_ID = 0x080
EMERGENCY_ID = 0x080
TPDO1_ID = 0x180
RPDO1_ID = 0x200
_SDO_REPLY_ID = 0x580
_SDO_REQUEST_ID = 0x600
HEARTBEAT_ID = 0x700

_Result = TypeVar("_Result")

# What it would print about a lost answer is told here by errors, and a lone one is asked for again.
logging.getLogger("canopen").addHandler(logging.NullHandler())

_SDO_LIMIT_S = 0.5
_SDO_KIND = 0xE0
_ANSWER_OF_THE_OTHER = {0x20: 0x40, 0x40: 0x60}
"""The answer that an initiated download, or upload, never has: that of the other (CiA 301, 7.2.4.3)."""
_SDO_TRIES = 3
"""A bus that loses a frame now and then is for `mill doctor` to tell of, and no reason not to open; an object may be
read or written again."""
_POKE_S = 0.1
_SLICE_S = 0.01
"""The longest single wait for a frame, so that what falls due in the meantime is done."""

_MOST_FRAMES_AT_ONCE = 10_000
_BEATS_KEPT = 64

_BUCKET_IN = 2
_BUCKET_OUT = 1
_BUCKET_FULL = 10
_ERROR_FRAME_BUS_OFF = 0x40
_MISSING = (0x06020000, 0x06090011)
"""SDO abort codes: no such object, no such sub-index."""


@dataclass(frozen=True)
class Entry:
    """One place in the object dictionary; ``layout`` as for struct, little-endian."""

    index: int
    subindex: int
    layout: str
    name: str

    def __str__(self) -> str:
        return f"{self.name} ({self.index:04X}h:{self.subindex:02X}h)"


class _ThreadlessNetwork(canopen.Network):
    """Hands canopen's frames to the bus, and brings the answer to an SDO request before canopen looks for it."""

    def __init__(self, bus: can.BusABC, exchange: Callable[[bytes], None], transmit: Callable[[int, bytes], object]):
        super().__init__(bus)
        self._exchange = exchange
        self._transmit = transmit

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send; a request of the SDO client returns when its answer is in canopen's queue, or time is up."""
        if remote:
            raise can.CanOperationError("remote frames are not used")
        if can_id & 0x780 == _SDO_REQUEST_ID and data[0] != canopen.sdo.constants.REQUEST_ABORTED:
            self._exchange(bytes(data))
        else:
            self._transmit(can_id, bytes(data))


class CanOpenNode:
    """Objects by SDO, frames by ``send`` and ``wait``, the node's state from its heartbeat.

    One thread reads; ``send`` is for any thread. ``on_wait`` is called whenever time is spent waiting.
    """

    def __init__(self, bus: can.BusABC, clock: Clock, node_id: int) -> None:
        if not 1 <= node_id <= 126:
            raise ValueError(f"CANopen node id {node_id}: allowed 1 to 126, and {HOST_NODE_ID} is the host's")
        self.node_id = node_id
        self.name = f"node {node_id} on {bus.channel_info}"
        self.on_wait: Callable[[], None] = lambda: None
        self.nmt_state: int | None = None
        self.boot_ups = 0
        self.emergencies: list[int] = []
        """Codes in the order of arrival; the reader's to empty."""
        self.report = b""
        """The data of the newest TPDO1."""
        self.reports = 0
        self.heard_at_s: float | None = None
        self.beats_s: deque[float] = deque(maxlen=_BEATS_KEPT)
        """When the newest heartbeats came."""
        self.errors = 0
        """Frames refused, of a wrong length or told as errors, since opening."""
        self._bus = bus
        self._clock = clock
        self._writing = threading.Lock()
        self._bucket = 0
        self._lost: str | None = None
        self._expected: bytes | None = None
        self._answers_no: int | None = None
        """The kind of SDO answer that the request under way does not have, though its object is the same."""
        self._wrong = ""
        """The newest answer of that kind."""
        self._answered = False
        self._answer_limit_s = _SDO_LIMIT_S
        self._network = _ThreadlessNetwork(bus, self._exchange, self.send)
        self._node = canopen.RemoteNode(node_id, canopen.import_od(None))
        self._network[node_id] = self._node
        self._node.sdo.RESPONSE_TIMEOUT = 0
        self._node.nmt.add_heartbeat_callback(self._on_heartbeat)
        self._network.subscribe(TPDO1_ID + node_id, self._on_report)
        # canopen keeps every emergency for ever.
        self._network.unsubscribe(EMERGENCY_ID + node_id)
        self._network.subscribe(EMERGENCY_ID + node_id, self._on_emergency)
        self._lengths = {
            _SDO_REPLY_ID + node_id: 8,
            HEARTBEAT_ID + node_id: 1,
            EMERGENCY_ID + node_id: 8,
        }

    @property
    def lost(self) -> bool:
        """Whether the wire was found lost; it stays lost."""
        return self._lost is not None

    def expect_report_bytes(self, length: int) -> None:
        """From now on a TPDO1 of any other length is a bus error."""
        self._lengths[TPDO1_ID + self.node_id] = length

    def send(self, can_id: int, data: bytes, *, unless: Callable[[], bool] = lambda: False) -> bool:
        """Put a frame on the wire, from any thread; False when ``unless`` says so at the very last moment.

        Raises:
            ConnectionLostError: the frame did not get out.
        """
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        # Frames of two threads must not mix on a serial adapter, but a stop does not wait for a writer that hangs.
        held = self._writing.acquire(timeout=_SLICE_S)
        try:
            if unless():
                return False
            self._bus.send(message)
        except ConnectionLostError as error:
            self._lose(str(error))
            raise
        except (can.CanError, OSError) as error:
            raise self._lose(f"{self.name}: cannot send ({error}); check adapter, cable and bus power") from error
        finally:
            if held:
                self._writing.release()
        return True

    def command(self, nmt_command: int) -> None:
        """Send an NMT command to the node."""
        self.send(0x000, bytes((nmt_command, self.node_id)))

    def pump(self) -> None:
        """Take in whatever has arrived, without waiting.

        Raises:
            ConnectionLostError: the wire is gone.
        """
        for _ in range(_MOST_FRAMES_AT_ONCE):
            if not self._take(0.0):
                return

    def wait(self, until: Callable[[], bool], limit_s: float) -> bool:
        """Take frames in until ``until()``; False when the time is over before. What arrived meanwhile counts."""
        deadline_s = self._clock.now_s() + limit_s
        self.pump()
        while not until():
            remaining_s = deadline_s - self._clock.now_s()
            if remaining_s <= 0:
                # Whoever was kept from running finds more than one frame waiting.
                self.pump()
                return until()
            self.on_wait()
            self._take(min(_SLICE_S, remaining_s))
        return True

    def wait_for_life(self, limit_s: float) -> None:
        """Wait until the node says anything: its boot-up, a heartbeat if the boot-up was missed, or an SDO answer.

        Raises:
            DeviceTimeoutError: nothing came, or nothing but heartbeats.
        """
        deadline_s = self._clock.now_s() + limit_s
        sdo_queue = self._node.sdo.responses
        poke = struct.pack("<BHBI", canopen.sdo.constants.REQUEST_UPLOAD, 0x1000, 0, 0)
        while self._clock.now_s() < deadline_s:
            self.send(_SDO_REQUEST_ID + self.node_id, poke)
            if self.wait(lambda: not sdo_queue.empty(), _POKE_S):
                self.pump()
                return
        heard = (
            "no frame at all" if self.heard_at_s is None else f"frames (NMT state {self.nmt_state}) but no SDO answer"
        )
        raise DeviceTimeoutError(
            f"{self.name}: {heard} within {limit_s:g} s; check that the drive has power, its node id, the bit rate "
            "and the two terminators of 120 ohm"
        )

    def read(self, entry: Entry, *, limit_s: float = _SDO_LIMIT_S) -> int:
        """Upload a number.

        Raises:
            DeviceFaultError: the node refuses.
            DeviceTimeoutError: no answer.
            ProtocolError: an answer of the wrong kind or size.
        """
        value = self.read_if_present(entry, limit_s=limit_s)
        if value is None:
            raise DeviceFaultError(f"{self.name}: has no {entry}, which this drill cannot be run without")
        return value

    def read_if_present(self, entry: Entry, *, limit_s: float = _SDO_LIMIT_S) -> int | None:
        """Upload a number, None where the node has no such object."""
        data = self._upload(entry, limit_s)
        if data is None:
            return None
        if len(data) < struct.calcsize(entry.layout):
            raise ProtocolError(f"{self.name}: {entry} came as {len(data)} bytes, {data.hex()}")
        number: int = struct.unpack_from("<" + entry.layout, data)[0]
        return number

    def read_text(self, index: int, name: str) -> str | None:
        """Upload a visible string, None where the node has no such object."""
        data = self._upload(Entry(index, 0, "", name), _SDO_LIMIT_S)
        return None if data is None else data.rstrip(b"\0 ").decode("ascii", errors="replace")

    def write(self, entry: Entry, value: int) -> None:
        """Download a number. Raises as ``read``."""
        data = struct.pack("<" + entry.layout, value)
        try:
            self._call(entry, lambda: self._node.sdo.download(entry.index, entry.subindex, data), _SDO_LIMIT_S)
        except canopen.SdoAbortedError as error:
            raise DeviceFaultError(f"{self.name}: refuses {entry} = {value:#x} ({error})") from error

    def write_checked(self, entry: Entry, value: int) -> None:
        """Download a number and read it back.

        Raises:
            DeviceFaultError: the node refuses, or holds another value.
        """
        self.write(entry, value)
        found = self.read(entry)
        if found != value:
            raise DeviceFaultError(f"{self.name}: {entry} set to {value:#x} but reads back {found:#x}")

    def _upload(self, entry: Entry, limit_s: float) -> bytes | None:
        try:
            data: bytes = self._call(entry, lambda: self._node.sdo.upload(entry.index, entry.subindex), limit_s)
        except canopen.SdoAbortedError as error:
            if error.code in _MISSING:
                return None
            raise DeviceFaultError(f"{self.name}: does not give {entry} ({error})") from error
        return data

    def _call(self, entry: Entry, transfer: Callable[[], _Result], limit_s: float) -> _Result:
        self._answer_limit_s = limit_s / _SDO_TRIES
        self._wrong = ""
        for left in range(_SDO_TRIES - 1, -1, -1):
            try:
                return transfer()
            except canopen.SdoCommunicationError as error:
                if self._answered:
                    raise ProtocolError(f"{self.name}: wrong SDO answer for {entry} ({error})") from error
                if not left and self._wrong:
                    raise ProtocolError(f"{self.name}: wrong SDO answer for {entry} ({self._wrong})") from error
                if not left:
                    raise DeviceTimeoutError(
                        f"{self.name}: no SDO answer for {entry} within {limit_s:g} s, asked {_SDO_TRIES} times"
                    ) from error
        raise AssertionError("not reached")

    def _exchange(self, request: bytes) -> None:
        kind = request[0] & _SDO_KIND
        self._expected = request[1:4] if kind in _ANSWER_OF_THE_OTHER else None
        self._answers_no = _ANSWER_OF_THE_OTHER.get(kind)
        self.send(_SDO_REQUEST_ID + self.node_id, request)
        sdo_queue = self._node.sdo.responses
        self._answered = self.wait(lambda: not sdo_queue.empty(), self._answer_limit_s)

    def _take(self, timeout_s: float) -> bool:
        if self._lost is not None:
            raise ConnectionLostError(self._lost)
        try:
            message = self._bus.recv(timeout_s)
        except ConnectionLostError as error:
            self._lose(str(error))
            raise
        except can.CanError as error:
            self._spill(str(error))
            return True
        except OSError as error:
            raise self._lose(f"{self.name}: {error}; check adapter and cable, then open the drill again") from error
        if message is None:
            return False
        if message.is_error_frame:
            if message.arbitration_id & _ERROR_FRAME_BUS_OFF:
                raise self._lose(
                    f"{self.name}: bus-off; check wiring, terminators and bit rate, then open the drill again"
                )
            self._spill("error frame")
        elif not message.is_extended_id and not message.is_remote_frame:
            self._sort(message)
        return True

    def _sort(self, message: can.Message) -> None:
        can_id, data = message.arbitration_id, message.data
        if len(data) != self._lengths.get(can_id, len(data)):
            self._spill(f"frame {can_id:03X}h with {len(data)} bytes")
            return
        self._bucket = max(0, self._bucket - _BUCKET_OUT)
        if can_id & 0x7F == self.node_id:
            self.heard_at_s = self._clock.now_s()
        if can_id == _SDO_REPLY_ID + self.node_id and self._expected not in (None, bytes(data[1:4])):
            return  # the late answer to a request that was given up
        if can_id == _SDO_REPLY_ID + self.node_id and data[0] & _SDO_KIND == self._answers_no:
            # A write that was asked twice is answered twice; the second answer is none to the reading back.
            self._wrong = bytes(data).hex(" ")
            return
        if can_id not in (*self._lengths, TPDO1_ID + self.node_id):
            return  # other nodes' frames, which canopen would read or keep without looking at their length
        if can_id == _SDO_REPLY_ID + self.node_id and not self._node.sdo.responses.empty():
            return  # a request has one answer, and it is there
        self._network.notify(can_id, data, self._clock.now_s())

    def _spill(self, what: str) -> None:
        self.errors += 1
        self._bucket += _BUCKET_IN
        if self._bucket >= _BUCKET_FULL:
            raise self._lose(
                f"{self.name}: too many bus errors, the last one: {what}; check wiring, terminators and bit rate, "
                "then open the drill again"
            )

    def _lose(self, reason: str) -> ConnectionLostError:
        self._lost = self._lost or reason
        return ConnectionLostError(reason)

    def _on_heartbeat(self, state: int) -> None:
        self.nmt_state = state
        self.beats_s.append(self._clock.now_s())
        if state == 0:
            self.boot_ups += 1

    def _on_emergency(self, can_id: int, data: bytearray, timestamp: float) -> None:
        self.emergencies.append(int.from_bytes(data[:2], "little"))

    def _on_report(self, can_id: int, data: bytearray, timestamp: float) -> None:
        self.report = bytes(data)
        self.reports += 1
