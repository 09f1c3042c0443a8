"""The slave's end of a Modbus RTU line (Modbus over serial line V1.02; Modbus application protocol V1.1b3).

A frame ends with a silence of 3.5 characters, and at least 1.75 ms. One pair of wires: a slave that talks hears
nothing, and what a master says into its answer spoils both. A frame with a wrong CRC, or for another station, gets no
answer; one for station 0 is obeyed and not answered.
"""

from collections import deque
from collections.abc import Callable

READ, WRITE_ONE, WRITE_MANY = 0x03, 0x06, 0x10
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, FAILURE = 1, 2, 3, 4
RESPONSE_DELAY_S = 0.002
MOST_WORDS = 16
"""A Delta drive reads and writes no more at once."""


class ModbusError(Exception):
    """An exception response."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


def crc16(data: bytes) -> bytes:
    """The two bytes at the end of a frame, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


class ModbusPort:
    """Bytes in and out at the line's pace; ``read`` and ``write`` are the registers behind it."""

    def __init__(
        self, station: int, read: Callable[[int], int], write: Callable[[int, int], None], *, baud: int, bits: int = 11
    ) -> None:
        """``bits`` of a character: start, eight of data, and two of parity and stop."""
        self._station = station
        self._read = read
        self._write = write
        self._byte_s = bits / baud
        self._gap_s = max(3.5 * self._byte_s, 0.00175)
        self._incoming: deque[tuple[float, int]] = deque()
        self._outgoing: deque[tuple[float, int]] = deque()
        self._frame = bytearray()
        self._heard_s = 0.0
        self._last_arrival_s = 0.0
        self._now_s = 0.0
        self.spoken_to_s: float | None = None
        """When the last valid message for this station came."""

    def receive(self, data: bytes) -> None:
        """The host begins to write ``data``."""
        for byte in data:
            self._last_arrival_s = max(self._last_arrival_s, self._now_s) + self._byte_s
            self._incoming.append((self._last_arrival_s, byte))

    def transmit(self) -> bytes:
        """What has reached the host since the last call."""
        arrived = bytearray()
        while self._outgoing and self._outgoing[0][0] <= self._now_s:
            arrived.append(self._outgoing.popleft()[1])
        return bytes(arrived)

    def advance_to(self, time_s: float) -> None:
        """Take what arrives until ``time_s``, and answer."""
        while self._incoming and self._incoming[0][0] <= time_s:
            at_s, byte = self._incoming.popleft()
            if self._frame and at_s - self._byte_s - self._heard_s >= self._gap_s:
                self._end_frame(self._heard_s + self._gap_s)
            if self._talks_at(at_s):
                self._outgoing = deque((when, said ^ byte if when >= at_s else said) for when, said in self._outgoing)
                continue
            self._frame.append(byte)
            self._heard_s = at_s
        if self._frame and time_s - self._heard_s >= self._gap_s:
            self._end_frame(self._heard_s + self._gap_s)
        self._now_s = time_s

    def _talks_at(self, time_s: float) -> bool:
        return bool(self._outgoing) and self._outgoing[0][0] - self._byte_s < time_s <= self._outgoing[-1][0]

    def _end_frame(self, time_s: float) -> None:
        frame = bytes(self._frame)
        self._frame.clear()
        if len(frame) < 4 or crc16(frame[:-2]) != frame[-2:] or frame[0] not in (0, self._station):
            return
        self.spoken_to_s = time_s
        function, data = frame[1], frame[2:-2]
        try:
            answer = bytes((function,)) + self._obey(function, data)
        except ModbusError as error:
            answer = bytes((function | 0x80, error.code))
        if frame[0] == self._station:
            answer = bytes((self._station,)) + answer
            at_s = time_s + RESPONSE_DELAY_S
            for byte in answer + crc16(answer):
                at_s += self._byte_s
                self._outgoing.append((at_s, byte))

    def _obey(self, function: int, data: bytes) -> bytes:
        if function not in (READ, WRITE_ONE, WRITE_MANY):
            raise ModbusError(ILLEGAL_FUNCTION)
        if len(data) < 4:
            raise ModbusError(ILLEGAL_VALUE)
        address, word = int.from_bytes(data[:2], "big"), int.from_bytes(data[2:4], "big")
        if function == WRITE_ONE:
            self._write(address, word)
            return data[:4]
        if not 1 <= word <= MOST_WORDS:
            raise ModbusError(ILLEGAL_VALUE)
        if function == READ:
            values = b"".join(self._read(address + k).to_bytes(2, "big") for k in range(word))
            return bytes((len(values),)) + values
        if len(data) != 5 + 2 * word or data[4] != 2 * word:
            raise ModbusError(ILLEGAL_VALUE)
        for k in range(word):
            self._write(address + k, int.from_bytes(data[5 + 2 * k : 7 + 2 * k], "big"))
        return data[:4]
