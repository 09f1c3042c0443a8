"""A CAN bus by name: SocketCAN where the kernel has it, else a serial adapter that speaks LAWICEL's ASCII.

python-can's own ``slcan`` closes and opens the channel with whatever state it is in, sleeps two seconds, and takes a
refusal (BEL) for silence. ``SlcanBus`` is a ``can.BusABC`` as well; it asks, looks at the answer, and says what was
refused.
"""

import contextlib
import re
from collections import deque
from typing import Protocol, runtime_checkable

import can
from can.interfaces.socketcan import SocketcanBus

from drivers.errors import ConfigError, ConnectionLostError
from drivers.lock import DeviceLock, can_device
from drivers.motion.transport import SerialLine, SharedLine
from drivers.spindle import emergency
from drivers.spindle.canopen_node import EMERGENCY_ID
from drivers.spindle.interface import AlarmPath

SLCAN_BAUD = 115_200
"""USB adapters take any; LAWICEL's own serial ones are set to this with their U command."""

_BIT_RATE_COMMANDS = {
    10_000: b"S0",
    20_000: b"S1",
    50_000: b"S2",
    100_000: b"S3",
    125_000: b"S4",
    250_000: b"S5",
    500_000: b"S6",
    800_000: b"S7",
    1_000_000: b"S8",
}
_CR = b"\r"
_BEL = b"\a"
_REPLY_S = 0.1
_DRAIN_READS = 50
_LONGEST_LINE = 64
_FRAME = re.compile(rb"(?:t([0-7][0-9A-Fa-f]{2})|T([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2})*)")
_REMOTE_FRAME = re.compile(rb"r[0-9A-Fa-f]{3}[0-8](?:[0-9A-Fa-f]{4})?|R[0-9A-Fa-f]{8}[0-8](?:[0-9A-Fa-f]{4})?")
_FLAGS = {
    0: "receive queue full",
    1: "transmit queue full",
    2: "error warning",
    3: "data overrun",
    5: "error passive",
    7: "bus error",
}
"""What F reports, by bit; bit 4 is unused, and bit 6, a lost arbitration, is the ordinary life of a bus."""


def open_bus(interface: str, channel: str, bitrate: int) -> can.BusABC:
    """Open ``slcan`` (channel: a serial port) or ``socketcan`` (channel: a network interface such as can0).

    SocketCAN takes its bit rate from the kernel (``ip link``), not from here.

    Raises:
        ConfigError: an interface or bit rate that does not exist.
        ConnectionLostError: the adapter or the network interface is not there.
        DeviceBusyError: another process, which the message names, owns it.
    """
    if interface == "slcan":
        from drivers.motion.serial_line import open_serial

        if bitrate not in _BIT_RATE_COMMANDS:
            raise ConfigError(
                f"{channel}: CAN bit rate {bitrate} is not one of {', '.join(map(str, _BIT_RATE_COMMANDS))} bit/s"
            )
        line = open_serial(channel, SLCAN_BAUD)
        try:
            return SlcanBus(line, bitrate)
        except BaseException:
            line.close()
            raise
    if interface == "socketcan":
        try:
            return _OwnedSocketcanBus(channel)
        except (OSError, can.CanError) as error:
            raise ConnectionLostError(
                f"CAN interface {channel}: cannot be opened ({error}); look for it with `ip link`, bring it up with "
                f"`ip link set {channel} up type can bitrate {bitrate}`, or use a serial adapter (interface slcan)"
            ) from error
    raise ConfigError(f"CAN interface {interface!r} is unknown; allowed: slcan, socketcan")


class _OwnedSocketcanBus(SocketcanBus):
    """SocketCAN lets any number of processes speak; one that commands a drill has it to itself."""

    def __init__(self, channel: str) -> None:
        self._lock = DeviceLock(can_device(channel))
        try:
            super().__init__(channel=channel)
        except BaseException:
            self._lock.release()
            raise

    def shutdown(self) -> None:
        super().shutdown()
        self._lock.release()


@runtime_checkable
class AlarmedBus(Protocol):
    """A bus that another process may read along."""

    def alarm_path(self, node_id: int) -> AlarmPath | None:
        """How the emergencies of a node look on its wire."""


class SlcanBus(can.BusABC):
    """A LAWICEL adapter on a serial line. One reader; ``send`` from any thread."""

    def __init__(self, line: SerialLine, bitrate: int) -> None:
        """Close the channel, set the bit rate, open the channel; ``line`` is closed by ``shutdown()``.

        Raises:
            ConnectionLostError: the adapter refuses the bit rate or does not open its channel.
        """
        self._line = line
        self._received = bytearray()
        self._lines: deque[bytes] = deque()
        # The manual asks for empty lines first: they end whatever an earlier host left half said. An adapter whose
        # channel is closed already refuses C, and that is fine.
        self._write(_CR * 3 + b"C" + _CR)
        self._drain()
        for command in (_BIT_RATE_COMMANDS[bitrate], b"O"):
            self._write(command + _CR)
            # Some firmware acknowledges nothing, so silence passes; a refusal does not.
            if self._answer() == _BEL:
                raise ConnectionLostError(
                    f"{line.name}: the CAN adapter refuses {command.decode()} (channel open at {bitrate} bit/s); "
                    "unplug and replug the adapter, and check [spindle] bitrate"
                )
        self.channel_info = f"slcan on {line.name}"
        super().__init__(channel=line.name)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put one data frame on the wire."""
        if msg.is_remote_frame or msg.is_fd:
            raise can.CanOperationError(f"{self.channel_info}: only classic data frames are sent, not {msg}")
        head = f"T{msg.arbitration_id:08X}" if msg.is_extended_id else f"t{msg.arbitration_id:03X}"
        self._write(f"{head}{len(msg.data)}{msg.data.hex().upper()}".encode() + _CR)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The oldest frame; waits once for bytes, so that None may come before the time is over.

        Raises:
            CanOperationError: the adapter refused a frame, or sent a line that no manual allows. The next call goes on.
            ConnectionLostError: the adapter is gone.
        """
        message = self._next_message()
        if message is None:
            self._take(self._line.read(3600.0 if timeout is None else timeout))
            message = self._next_message()
        return message

    def alarm_path(self, node_id: int) -> AlarmPath | None:
        """How a node's EMCY frames look on the wire (CiA 301: the code, its low byte first); "errors are gone" is none.

        None where no other process can read along.
        """
        line = self._line
        if line.descriptor is None or not isinstance(line, SharedLine):
            return None
        head, digit = b"t%03X8" % (EMERGENCY_ID + node_id), rb"[0-9A-Fa-f]"
        pattern = rb"(?:^|[\r\a])t(?i:%b)%b{2}(?!00)%b{14}(?:%b{4})?\r" % (head[1:], digit, digit, digit)

        def words(found: bytes) -> str:
            low, high = bytes.fromhex(found.lstrip(b"\r\a")[len(head) : len(head) + 4].decode())
            return f"{self.channel_info}: the drive's emergency, {emergency.words(high << 8 | low)}"

        return AlarmPath(line.descriptor, pattern, words, line.read_through)

    def shutdown(self) -> None:
        """Close the channel and the line; a second call does nothing."""
        if self._is_shutdown:
            return
        super().shutdown()
        try:
            # A lost wire has no channel to close.
            with contextlib.suppress(ConnectionLostError):
                self._write(b"C" + _CR)
        finally:
            self._line.close()

    def _write(self, data: bytes) -> None:
        self._line.write(data)

    def _drain(self) -> None:
        for _ in range(_DRAIN_READS):
            if not self._line.read(_REPLY_S):
                return

    def _answer(self) -> bytes:
        """The byte that ends the reply to a command, b"" for silence."""
        while data := self._line.read(_REPLY_S):
            if data.endswith((_CR, _BEL)):
                return data[-1:]
        return b""

    def _take(self, data: bytes) -> None:
        self._received += data
        while match := re.search(rb"[\r\a]", self._received):
            self._lines.append(bytes(self._received[: match.end()]))
            del self._received[: match.end()]
        if len(self._received) > _LONGEST_LINE:
            self._lines.append(bytes(self._received))
            self._received.clear()

    def _next_message(self) -> can.Message | None:
        while self._lines:
            line = self._lines.popleft()
            if line.endswith(_BEL):
                self._write(b"F" + _CR)  # the answer says why, and comes as an error of its own
                raise can.CanOperationError(f"{self.channel_info}: the adapter refused a frame (BEL)")
            body = line.removesuffix(_CR)
            if body in (b"", b"z", b"Z") or _REMOTE_FRAME.fullmatch(body):
                continue
            if re.fullmatch(rb"F[0-9A-Fa-f]{2}", body):
                if flags := self._flag_words(int(body[1:], 16)):
                    raise can.CanOperationError(f"{self.channel_info}: {flags}")
                continue
            return self._message(body)
        return None

    def _message(self, body: bytes) -> can.Message:
        match = _FRAME.fullmatch(body)
        # Behind the data may stand a time stamp of four digits, if an earlier host switched stamps on for good.
        surplus = None if match is None else len(match[4]) - 2 * int(match[3])
        if match is None or surplus not in (0, 4):
            raise can.CanOperationError(f"{self.channel_info}: {body!r} is no CAN frame")
        standard, extended, length, data = match.groups()
        return can.Message(
            arbitration_id=int(standard or extended, 16),
            is_extended_id=standard is None,
            data=bytes.fromhex(data[: 2 * int(length)].decode()),
        )

    @staticmethod
    def _flag_words(flags: int) -> str:
        return ", ".join(word for bit, word in _FLAGS.items() if flags >> bit & 1)
