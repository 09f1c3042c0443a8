"""The board's serial port: paced both ways, a bounded receive buffer that drops what does not fit."""

import math
from collections import deque

BYTE_S = 10 / 115200
"""One start bit, eight data bits, one stop bit."""


class Uart:
    """Bytes take their time on the wire; the receive buffer holds ``rx_size`` of them."""

    def __init__(self, rx_size: int) -> None:
        self._rx_size = rx_size
        self._on_wire: deque[tuple[float, int]] = deque()
        self._last_arrival_s = -math.inf
        self._outgoing: deque[tuple[float, bytes]] = deque()
        self._tx_done_s = -math.inf
        self.rx: deque[int] = deque()

    def send_to_board(self, data: bytes, now_s: float) -> None:
        """The host starts to write ``data``."""
        arrival_s = max(self._last_arrival_s, now_s)
        for byte in data:
            arrival_s += BYTE_S
            self._on_wire.append((arrival_s, byte))
        self._last_arrival_s = arrival_s

    @property
    def next_arrival_s(self) -> float:
        """When the next byte will have arrived; infinity when none is on the wire."""
        return self._on_wire[0][0] if self._on_wire else math.inf

    def next_arrived(self, now_s: float) -> int | None:
        """The oldest byte that has arrived and was not yet looked at."""
        if self._on_wire and self._on_wire[0][0] <= now_s:
            return self._on_wire.popleft()[1]
        return None

    def store(self, byte: int) -> None:
        """Into the receive buffer; a byte that does not fit is lost without a word, as on the real board."""
        if len(self.rx) < self._rx_size:
            self.rx.append(byte)

    @property
    def rx_free(self) -> int:
        """Bytes that still fit into the receive buffer."""
        return self._rx_size - len(self.rx)

    def say(self, text: str, now_s: float) -> None:
        """Queue ``text`` for the host."""
        data = text.encode("latin-1")
        start_s = max(self._tx_done_s, now_s)
        self._outgoing.append((start_s, data))
        self._tx_done_s = start_s + len(data) * BYTE_S

    def room_at_s(self, tx_size: int) -> float:
        """When no more than ``tx_size`` bytes wait to be sent."""
        return self._tx_done_s - tx_size * BYTE_S

    def collect(self, now_s: float) -> bytes:
        """What has reached the host by now."""
        arrived = bytearray()
        while self._outgoing:
            start_s, data = self._outgoing[0]
            count = int((now_s - start_s) / BYTE_S + 1e-6)
            if count < len(data):
                if count > 0:
                    arrived += data[:count]
                    self._outgoing[0] = (start_s + count * BYTE_S, data[count:])
                break
            arrived += data
            self._outgoing.popleft()
        return bytes(arrived)
