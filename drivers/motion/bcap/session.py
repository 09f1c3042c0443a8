"""The conversation with one b-CAP server over datagrams: requests and their replies, retries, and what latches.

There is no thread, and one request at a time is under way. A datagram may be lost, so that a request without a reply
is sent again, with a new serial number and the first one in ``reserve``: by that the server knows what it has executed
already. Another thread may call ``halt()`` at any time; it writes at once, and all that it leaves behind is two marks,
one before its datagrams and one behind them (docs/decisions/0004).
"""

import itertools
from dataclasses import dataclass, field

from drivers.clock import Clock
from drivers.errors import ConnectionLostError, DeviceError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.motion.bcap.packet import Packet, Value, decode, encode
from drivers.motion.bcap.results import E_HANDLE, S_EXECUTING, failed, result_words
from drivers.motion.transport import DatagramLine

REPLY_S = 0.1
TRIES = 3
LIMIT_S = 1.0
"""What no request but a few may take, however often the server says that it is still executing it."""
HALT_COPIES = 3
"""Nobody waits for the reply of a halt, so that it is sent more than once."""
SERVICE_START, SERVICE_STOP = 1, 2
CONTROLLER_CONNECT, CONTROLLER_DISCONNECT, CONTROLLER_GETROBOT, CONTROLLER_GETVARIABLE, CONTROLLER_EXECUTE = (
    3,
    4,
    7,
    9,
    17,
)
ROBOT_EXECUTE, ROBOT_HALT, ROBOT_RELEASE = 64, 70, 84
VARIABLE_GETVALUE, VARIABLE_RELEASE = 101, 111
_SLICE_S = 0.002
_HALTED = "halted by halt()"


@dataclass
class Call:
    """One request, from its first datagram to its reply."""

    function: int
    arguments: tuple[Value, ...]
    retry_s: float
    tries: int
    began_s: float
    limit_s: float
    first_serial: int = 0
    serials: set[int] = field(default_factory=set)
    unanswered: int = 0
    """Tries since the last sign of life."""
    sent_s: float = 0.0
    result: int | None = None
    value: Value = None
    error: DeviceError | None = None

    @property
    def is_over(self) -> bool:
        """Whether there is a result, or will be none."""
        return self.result is not None or self.error is not None


class BcapSession:
    """Speaks to one server over one line."""

    def __init__(self, line: DatagramLine, clock: Clock, *, reply_s: float = REPLY_S) -> None:
        """Wait ``reply_s`` for each reply before asking again."""
        self._line = line
        self._clock = clock
        self._reply_s = reply_s
        # Counting by next() is atomic, and halt() counts as well.
        self._numbers = itertools.count()
        self._call: Call | None = None
        self._broken: ProtocolError | None = None
        self._lost: str | None = None
        self._latched: str | None = None
        self._halts_begun: list[None] = []
        self._halts_done: list[None] = []
        self._halts_released = 0
        self.is_waiting = False
        """Whether somebody stands in a read: on a virtual bench, waiting is what lets others call."""
        self.handles_lost = False
        """Whether the server has forgotten who we are."""

    @property
    def name(self) -> str:
        """The line's name, for messages."""
        return self._line.name

    @property
    def is_lost(self) -> bool:
        """Whether the wire is known to be gone."""
        return self._lost is not None

    @property
    def fault(self) -> str | None:
        """Latched: the controller stopped, or was stopped. Homing releases it."""
        return self._latched or (_HALTED if self.is_halted else None)

    @property
    def is_halted(self) -> bool:
        """Whether there was a halt that homing has not released."""
        return len(self._halts_begun) > self._halts_released

    @property
    def halts(self) -> int:
        """How many halts are over. Who releases asks first thing, so that none that comes later is forgotten."""
        return len(self._halts_done)

    def latch(self, words: str) -> None:
        """Latch a fault; the first one stays."""
        self._latched = self.fault or words

    def release(self, halts: int) -> None:
        """Forget what has latched, and the first ``halts`` halts."""
        self._latched = None
        self._halts_released = halts

    def check(self) -> None:
        """Raise what has latched.

        Raises:
            ConnectionLostError: the wire is gone.
            DeviceFaultError: a fault is latched.
        """
        if self._lost is not None:
            raise ConnectionLostError(self._lost)
        if self.fault is not None:
            raise DeviceFaultError(f"{self.name}: {self.fault}; position kept; home() releases the latch")

    def halt(self, robot: int | None) -> None:
        """Put a halt on the wire now, and latch. From any thread."""
        # Before the datagrams, so that no set-point is sent behind them unseen.
        self._halts_begun.append(None)
        try:
            if robot is not None:
                self._write_halt(robot)
        finally:
            self._halts_done.append(None)

    def begin(self, function: int, *arguments: Value, retry_s: float | None = None, limit_s: float = LIMIT_S) -> Call:
        """Send a request and wait for nothing; ``poll()`` brings its reply. The one before must be over."""
        assert self._call is None or self._call.is_over
        retry_s = self._reply_s if retry_s is None else retry_s
        tries = max(TRIES, round(TRIES * self._reply_s / retry_s))
        limit_s = max(limit_s, TRIES * self._reply_s)
        self._call = call = Call(function, arguments, retry_s, tries, self._clock.now_s(), limit_s)
        self._send(call)
        return call

    def request(
        self, function: int, *arguments: Value, retry_s: float | None = None, limit_s: float = LIMIT_S
    ) -> Value:
        """Send a request and wait for its reply.

        Raises:
            DeviceFaultError: refused, with the result in words.
            DeviceTimeoutError: no reply to any of its tries, or none within ``limit_s``.
            ProtocolError: what came as a reply is none.
            ConnectionLostError: the wire is gone.
        """
        if self._lost is not None:
            raise ConnectionLostError(self._lost)
        while self._call is not None and not self._call.is_over:
            self.poll(_SLICE_S)
        call = self.begin(function, *arguments, retry_s=retry_s, limit_s=limit_s)
        while not call.is_over:
            self.poll(_SLICE_S)
        if call.error is not None:
            raise call.error
        assert call.result is not None
        if call.result == E_HANDLE:
            self.check()
        if failed(call.result):
            raise DeviceFaultError(f"{self.name}: {_told(call)} refused with {result_words(call.result)}")
        return call.value

    def poll(self, timeout_s: float) -> None:
        """Take in one datagram, waiting up to ``timeout_s`` for it, and ask again where a reply is late.

        Raises:
            ConnectionLostError: the wire is gone.
        """
        if self._lost is not None:
            raise ConnectionLostError(self._lost)
        self.is_waiting = True
        try:
            data = self._line.read(timeout_s)
            if data:
                self._take(data)
            self._ask_again()
        except ConnectionLostError as error:
            self._lost = str(error)
            self.latch("connection lost")
            if self._call is not None:
                self._call.error = error
            raise
        finally:
            self.is_waiting = False

    def close(self) -> None:
        """Give the line back."""
        self._lost = self._lost or f"{self.name}: the controller was closed; open it again"
        self._line.close()

    def _write_halt(self, robot: int) -> None:
        first = 0
        errors: list[ConnectionLostError] = []
        for _ in range(HALT_COPIES):
            serial = self._next_serial()
            try:
                self._line.write(encode(Packet(serial, first, ROBOT_HALT, (robot, ""))))
            except ConnectionLostError as error:
                # A socket tells once, and at the next datagram, that an earlier one found nobody.
                errors.append(error)
            first = first or serial
        if len(errors) == HALT_COPIES:
            raise errors[0]

    def _next_serial(self) -> int:
        return next(self._numbers) % 0xFFFF + 1

    def _send(self, call: Call) -> None:
        serial = self._next_serial()
        call.serials.add(serial)
        call.unanswered += 1
        call.sent_s = self._clock.now_s()
        self._line.write(encode(Packet(serial, call.first_serial, call.function, call.arguments)))
        call.first_serial = call.first_serial or serial

    def _take(self, data: bytes) -> None:
        call = self._call
        try:
            packet = decode(data)
        except ProtocolError as error:
            # As good as lost; the next try tells whether it was the network or somebody who speaks no b-CAP.
            self._broken = error
            return
        if call is None or call.is_over or packet.serial not in call.serials:
            return  # A late or doubled reply, or that of a halt.
        self._broken = None
        if packet.code == S_EXECUTING:
            call.sent_s, call.unanswered = self._clock.now_s(), 0
            return
        if packet.code == E_HANDLE:
            self.handles_lost = True
            self.latch("the controller was restarted, or somebody ended this session")
        call.result = packet.code
        call.value = packet.arguments[0] if packet.arguments else None

    def _ask_again(self) -> None:
        call, now_s = self._call, self._clock.now_s()
        if call is None or call.is_over:
            return
        if now_s - call.began_s > call.limit_s:
            call.error = DeviceTimeoutError(
                f"{self.name}: {_told(call)} not done within {call.limit_s:g} s; look at the controller's own display"
            )
        elif now_s - call.sent_s >= call.retry_s:
            if call.unanswered < call.tries:
                self._send(call)
            else:
                call.error = self._broken or DeviceTimeoutError(
                    f"{self.name}: no reply to {call.unanswered} tries of {_told(call)}; is the controller on, and "
                    "its address right? Look at the network cable"
                )


def _told(call: Call) -> str:
    """What was asked for, as messages say it."""
    word = next((each for each in call.arguments if isinstance(each, str) and each), "")
    return f"function {call.function}" + (f" {word!r}" if word else "")
