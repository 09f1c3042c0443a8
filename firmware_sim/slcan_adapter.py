"""A USB-to-CAN adapter that speaks LAWICEL's ASCII protocol (CANUSB manual; `slcan`).

A command ends with CR; the answer is CR, or BEL for an error. Frames for the bus are acknowledged by ``z`` (11 bit) and
``Z`` (29 bit) when the adapter has taken them, and frames from the bus arrive unasked. Extended and remote frames are
taken and go nowhere: no node of this bus answers them. An adapter that is set to another bit rate than the bus hears
nothing, and its transmit queue fills up. Left out: polled reception (``P``, ``A``, ``X0``), acceptance filters that
let only part of the traffic through, and the latency of USB.
"""

from collections.abc import Sequence

from firmware_sim.can_wire import CanNode, CanWire, as_wire

OK, ERROR = b"\r", b"\a"
BIT_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""For S0 to S8."""
VERSION, SERIAL_NUMBER = b"V1013", b"NML01"
TRANSMIT_QUEUE = 32
_LINE_MAX = len("T") + 8 + 1 + 16
_TIME_STAMP_WRAP_MS = 60_000

_TRANSMIT_FULL, _WARNING, _PASSIVE, _BUS_ERROR = 0x02, 0x04, 0x20, 0x80


class SlcanAdapter:
    """The adapter between a host's serial port and a CAN wire, which it brings along in time."""

    def __init__(self, nodes: CanWire | Sequence[CanNode]) -> None:
        self._wire = as_wire(nodes)
        self._port = self._wire.open_port()
        self._line = bytearray()
        self._overlong = False
        self._out = bytearray()
        self._bit_rate: int | None = None
        self._open = False
        self._listen_only = False
        self._time_stamps = False
        self._stuck = 0
        self._flags = 0

    def receive(self, data: bytes) -> None:
        """Bytes from the host, in pieces of any size."""
        for byte in data:
            if byte != ord(OK):
                if len(self._line) < _LINE_MAX:
                    self._line.append(byte)
                else:
                    self._overlong = True
                continue
            line, overlong = bytes(self._line), self._overlong
            self._line.clear()
            self._overlong = False
            self._out += ERROR if overlong else self._answer(line)

    def transmit(self) -> bytes:
        """The bytes for the host since the last call."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def advance_to(self, time_s: float) -> None:
        """Let the wire and its nodes go on, and pass on what the adapter hears."""
        self._wire.advance_to(time_s)
        while self._port.heard:
            arrival_s, (can_id, data) = self._port.heard.popleft()
            if not self._open:
                continue
            if self._bit_rate != self._wire.bit_rate:
                self._flags |= _BUS_ERROR | _WARNING
                continue
            stamp = b"%04X" % (int(arrival_s * 1000) % _TIME_STAMP_WRAP_MS) if self._time_stamps else b""
            self._out += b"t%03X%d" % (can_id, len(data)) + data.hex().upper().encode() + stamp + OK

    # --- commands

    def _answer(self, line: bytes) -> bytes:
        if not line:
            return OK
        command, argument = line[:1], line[1:]
        match command:
            case b"S" | b"s":
                return self._set_bit_rate(command, argument)
            case b"O" | b"L":
                return self._open_channel(argument, listen_only=command == b"L")
            case b"C":
                return self._close_channel(argument)
            case b"t" | b"T" | b"r" | b"R":
                return self._send(command, argument)
            case b"F":
                return self._tell_flags(argument)
            case b"Z":
                return self._set_time_stamps(argument)
            case b"M" | b"m":
                # Taken as the manual says while the channel is closed; this adapter lets everything through.
                return OK if not self._open and _is_hex(argument, 8) else ERROR
            case b"V" if not argument:
                return VERSION + OK
            case b"N" if not argument:
                return SERIAL_NUMBER + OK
        return ERROR

    def _set_bit_rate(self, command: bytes, argument: bytes) -> bytes:
        if self._open:
            return ERROR
        if command == b"s":
            # Bit timing registers of an SJA1000 at 16 MHz.
            if not _is_hex(argument, 4):
                return ERROR
            timing_0, timing_1 = bytes.fromhex(argument.decode())
            quanta = 3 + (timing_1 & 0x0F) + (timing_1 >> 4 & 0x07)
            self._bit_rate = round(16e6 / (2 * ((timing_0 & 0x3F) + 1) * quanta))
            return OK
        if len(argument) != 1 or argument not in b"012345678":
            return ERROR
        self._bit_rate = BIT_RATES[int(argument)]
        return OK

    def _open_channel(self, argument: bytes, *, listen_only: bool) -> bytes:
        if argument or self._open or self._bit_rate is None:
            return ERROR
        self._open, self._listen_only = True, listen_only
        self._flags = 0
        return OK

    def _close_channel(self, argument: bytes) -> bytes:
        if argument or not self._open:
            return ERROR
        self._open = False
        self._stuck = 0
        return OK

    def _set_time_stamps(self, argument: bytes) -> bytes:
        if self._open or argument not in (b"0", b"1"):
            return ERROR
        self._time_stamps = argument == b"1"
        return OK

    def _tell_flags(self, argument: bytes) -> bytes:
        if argument or not self._open:
            return ERROR
        flags, self._flags = self._flags, 0
        return b"F%02X" % flags + OK

    def _send(self, command: bytes, argument: bytes) -> bytes:
        digits = 3 if command in b"tr" else 8
        identifier, length, payload = argument[:digits], argument[digits : digits + 1], argument[digits + 1 :]
        if not _is_hex(identifier, digits) or len(length) != 1 or length not in b"012345678":
            return ERROR
        can_id, size = int(identifier, 16), int(length)
        if can_id > (0x7FF if digits == 3 else 0x1FFF_FFFF):
            return ERROR
        if not _is_hex(payload, 0 if command in b"rR" else 2 * size):
            return ERROR
        if not self._open or self._listen_only:
            return ERROR
        acknowledgement = (b"z" if digits == 3 else b"Z") + OK
        if self._bit_rate != self._wire.bit_rate:
            self._flags |= _BUS_ERROR | _WARNING | _PASSIVE
            if self._stuck >= TRANSMIT_QUEUE:
                self._flags |= _TRANSMIT_FULL
                return ERROR
            self._stuck += 1
        elif command == b"t":
            self._port.send(can_id, bytes.fromhex(payload.decode()))
        return acknowledgement


def _is_hex(text: bytes, digits: int) -> bool:
    return len(text) == digits and all(character in b"0123456789ABCDEFabcdef" for character in text)
