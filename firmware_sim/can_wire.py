"""The two-wire bus between a host's adapter and the CAN nodes.

Frames take the time that their bits take, one after the other, and the lowest identifier goes first. Left out: bit
errors, error frames and bus-off, acknowledgement (a node alone on the bus is heard all the same), extended and remote
frames (CANopen needs neither), and stuff bits beyond the usual share.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

DEFAULT_BIT_RATE = 1_000_000
_OVERHEAD_BITS = 47
"""A standard data frame without its data, with the space between frames (ISO 11898-1)."""
_STUFF_SHARE = 0.1

Frame = tuple[int, bytes]


class CanNode(Protocol):
    """A device with an 11-bit identifier and up to eight bytes at a time."""

    def receive(self, can_id: int, data: bytes) -> None:
        """A frame from the bus."""

    def transmit(self) -> list[Frame]:
        """The frames that the node wants to send since the last call."""

    def advance_to(self, time_s: float) -> None:
        """Let the node's own time pass; a time that has passed already changes nothing."""


class CanPort:
    """A host's place on the wire: what it hears, and where it speaks."""

    def __init__(self, wire: "CanWire") -> None:
        self._wire = wire
        self.heard: deque[tuple[float, Frame]] = deque(maxlen=4096)
        """Arrival time and frame, oldest first; the host's to empty."""

    def send(self, can_id: int, data: bytes) -> None:
        """Give a frame to the arbitration at the present time."""
        self._wire.post((can_id, bytes(data)), sender=self)


class CanWire:
    """One bus segment with its nodes and any number of host ports.

    A sender never hears its own frames. ``advance_to`` brings the nodes along.
    """

    def __init__(self, nodes: Sequence[CanNode], *, bit_rate: int = DEFAULT_BIT_RATE) -> None:
        self.bit_rate = bit_rate
        self._nodes = tuple(nodes)
        self._ports: list[CanPort] = []
        self._time_s = 0.0
        self._free_at_s = 0.0
        self._pending: list[tuple[Frame, object]] = []
        self._on_the_way: tuple[float, Frame, object] | None = None
        self.carried: Callable[[Frame, bool], Frame | None] = lambda frame, _from_node: frame
        """What arrives of a frame, of a node or of a host; None where it is lost. On a healthy bus all arrive."""

    def open_port(self) -> CanPort:
        """Join the wire as a host; hears everything from now on."""
        port = CanPort(self)
        self._ports.append(port)
        return port

    def post(self, frame: Frame, sender: object) -> None:
        """Put a frame up for arbitration."""
        self._pending.append((frame, sender))

    def frame_time_s(self, data: bytes) -> float:
        """How long a frame with this data keeps the wire busy."""
        return (_OVERHEAD_BITS + 8 * len(data)) * (1 + _STUFF_SHARE) / self.bit_rate

    def advance_to(self, time_s: float) -> None:
        """Advance the nodes, then carry what fits between the last call and ``time_s``."""
        for node in self._nodes:
            node.advance_to(time_s)
        start_s, self._time_s = self._time_s, max(self._time_s, time_s)
        self._free_at_s = max(self._free_at_s, start_s)
        while True:
            self._collect()
            if self._on_the_way is None:
                if not self._pending or self._free_at_s >= self._time_s:
                    return
                # min() keeps the first of equals, so that frames of one identifier stay in order.
                winner = min(self._pending, key=lambda entry: entry[0][0])
                self._pending.remove(winner)
                (frame, sender) = winner
                self._on_the_way = (self._free_at_s + self.frame_time_s(frame[1]), frame, sender)
            arrival_s, frame, sender = self._on_the_way
            if arrival_s > self._time_s:
                return
            self._free_at_s = arrival_s
            self._on_the_way = None
            self._deliver(arrival_s, frame, sender)

    def _collect(self) -> None:
        for node in self._nodes:
            for frame in node.transmit():
                self._pending.append((frame, node))

    def _deliver(self, arrival_s: float, frame: Frame, sender: object) -> None:
        arrived = self.carried(frame, sender in self._nodes)
        if arrived is None:
            return
        for node in self._nodes:
            if node is not sender:
                node.receive(*arrived)
        for port in self._ports:
            if port is not sender:
                port.heard.append((arrival_s, arrived))


def as_wire(nodes: CanNode | CanWire | Sequence[CanNode]) -> CanWire:
    """A wire is itself; nodes get one of their own."""
    if isinstance(nodes, CanWire):
        return nodes
    return CanWire(nodes if isinstance(nodes, Sequence) else (nodes,))
