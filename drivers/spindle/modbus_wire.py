"""One question and one answer at a time on a Modbus RTU line (Modbus over serial line V1.02); stops wait for none.

RTU frames end by silence, and the pair of wires carries one talker at a time. So a stop from another thread, which is
written at once, may be lost among the bytes of a question or an answer. Whoever waits for that answer notices, gives
it up, and repeats the stop until it is confirmed; it does so before anything else is asked.
"""

import contextlib

from pymodbus.framer.rtu import FramerRTU
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import ReadHoldingRegistersRequest, WriteSingleRegisterRequest

from drivers.clock import Clock
from drivers.errors import ConnectionLostError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.motion.transport import SerialLine
from drivers.spindle.delta_registers import COMMAND, EXCEPTIONS, FIRMWARE, IDENTITY_CODE, STOP

BAD_REPLIES = 3
"""Missing or broken ones in a row are an error."""
_LOOK_S = 0.002
_ECHO_S = 0.012
"""A stop that got through is answered by then, from 38,400 baud up."""
_LEAST_GAP_S = 0.00175
_GAP_CHARACTERS = 3.5
_BITS = 11
_SHORTEST_REPLY = 5
_FUNCTIONS = (ReadHoldingRegistersRequest.function_code, WriteSingleRegisterRequest.function_code)


class RefusedError(DeviceFaultError):
    """The drive understood and said no: a Modbus exception."""

    def __init__(self, message: str, code: int = 0) -> None:
        super().__init__(message)
        self.code = code


class StoppedError(DeviceFaultError):
    """A stop came from another thread before what was to be written."""


class ModbusWire:
    """The master's end of the line, for one station."""

    def __init__(self, line: SerialLine, clock: Clock, *, station: int, baud: int) -> None:
        self.name = f"{line.name}, station {station}"
        self.stops = 0
        """How many stops were written."""
        self.asked = 0
        self.answered = 0
        self.lost = False
        """Whether the wire is known to be gone."""
        self._confirmed = 0
        self._line = line
        self._clock = clock
        self._station = station
        self._framer = FramerRTU(DecodePDU(is_server=False))
        self._gap_s = max(_LEAST_GAP_S, _GAP_CHARACTERS * _BITS / baud)
        self._stop_request = self._to_write(COMMAND, STOP)
        self._stop_frame = self._framer.buildFrame(self._stop_request)

    def stop(self) -> None:
        """Write the stop now; from any thread. It is confirmed before the next question, or repeated."""
        self.stops += 1
        self._put(self._stop_frame)

    def read(self, address: int, count: int, limit_s: float) -> list[int]:
        """Registers from ``address`` on.

        Raises:
            RefusedError: the drive has none there.
            DeviceTimeoutError, ProtocolError: three bad answers in a row.
        """
        request = ReadHoldingRegistersRequest(dev_id=self._station, address=address, count=count)
        return list(self._exchange(request, limit_s).registers)

    def who(self, limit_s: float) -> str:
        """What a Delta drive tells of itself, parameters 00-00 and 00-06; nothing is written.

        Raises:
            RefusedError, DeviceTimeoutError, ProtocolError: as ``read``.
        """
        code = self.read(IDENTITY_CODE, 1, limit_s)[0]
        firmware = ""
        with contextlib.suppress(RefusedError):
            firmware = f", firmware {self.read(FIRMWARE, 1, limit_s)[0] / 100:.2f}"
        return f"Delta VFD, identity code {code}{firmware}, station {self._station}"

    def write(self, address: int, value: int, limit_s: float, *, seen_stops: int | None = None) -> None:
        """One register; nothing is written when a stop came after ``seen_stops``.

        Raises:
            StoppedError: one came.
            RefusedError: the drive does not take the value.
            DeviceTimeoutError, ProtocolError: three bad answers in a row.
        """
        self._exchange(self._to_write(address, value), limit_s, seen_stops)

    def close(self) -> None:
        """Give the line back."""
        self._line.close()

    def _to_write(self, address: int, value: int) -> WriteSingleRegisterRequest:
        return WriteSingleRegisterRequest(dev_id=self._station, address=address, registers=[value])

    def _exchange(self, request: ModbusPDU, limit_s: float, seen_stops: int | None = None) -> ModbusPDU:
        deadline_s = self._clock.now_s() + limit_s
        while True:
            self._confirm_stop(deadline_s)
            stops = self.stops
            if seen_stops is not None and stops != seen_stops:
                raise StoppedError(f"{self.name}: stop() came while the drill was to run up")
            reply = self._ask(request, deadline_s, stops)
            if reply is not None:
                return reply

    def _confirm_stop(self, deadline_s: float) -> None:
        while (stops := self.stops) != self._confirmed:
            heard = self._listen(self._stop_request, min(_ECHO_S, deadline_s - self._clock.now_s()), stops)
            if isinstance(heard, ModbusPDU) or self._ask(self._stop_request, deadline_s, stops) is not None:
                self._confirmed = stops

    def _ask(self, request: ModbusPDU, deadline_s: float, stops: int) -> ModbusPDU | None:
        """The answer; None when a stop came meanwhile."""
        bad = ""
        for attempt in range(BAD_REPLIES):
            # What was said before the question is no answer to it.
            while self._take(0.0):
                pass
            self.asked += 1
            self._put(self._framer.buildFrame(request))
            share_s = max(_LOOK_S, deadline_s - self._clock.now_s()) / (BAD_REPLIES - attempt)
            heard = self._listen(request, share_s, stops)
            if self.stops != stops:
                return None
            if isinstance(heard, ModbusPDU):
                self.answered += 1
                return heard
            bad = heard
        if bad:
            raise ProtocolError(
                f"{self.name}: {BAD_REPLIES} bad answers in a row, the last one {bad}; check the cable, its shield and "
                "terminator, the baud rate and the framing"
            )
        raise DeviceTimeoutError(
            f"{self.name}: silent, no answer to {BAD_REPLIES} questions; check the drive's power, the cable, the "
            "station (parameter 09-00), the baud rate (09-01) and the protocol (09-04, RTU)"
        )

    def _listen(self, request: ModbusPDU, limit_s: float, stops: int) -> ModbusPDU | str:
        """The answer, or what is bad about it in words, empty where nothing came or a stop did."""
        deadline_s = self._clock.now_s() + limit_s
        data = b""
        while self.stops == stops:
            remaining_s = deadline_s - self._clock.now_s()
            data += self._take(max(0.0, min(_LOOK_S, remaining_s)))
            used, reply = self._parsed(data)
            if reply is not None and not _fits(request, reply):
                # A late answer to an earlier question is none to this one.
                data = data[used:]
            elif reply is not None:
                # The next frame, also a stop, must not touch this one.
                self._clock.sleep_s(self._gap_s)
                return self._accepted(reply)
            elif used:
                self._wait_for_silence()
                return f"{data.hex(' ')}, which is no frame or has a wrong CRC"
            elif remaining_s <= 0:
                return f"{data.hex(' ')} without an end" if data else ""
        return ""

    def _parsed(self, data: bytes) -> tuple[int, ModbusPDU | None]:
        """How many bytes are dealt with, none while the frame is not whole; the frame, None where it is broken."""
        if len(data) >= 2 and (data[0] != self._station or data[1] & 0x7F not in _FUNCTIONS):
            return len(data), None
        return self._framer.handleFrame(data, self._station, 0) if len(data) >= _SHORTEST_REPLY else (0, None)

    def _accepted(self, reply: ModbusPDU) -> ModbusPDU:
        if isinstance(reply, ExceptionResponse):
            self.answered += 1
            code = reply.exception_code
            raise RefusedError(
                f"{self.name}: refused with exception {code} ({EXCEPTIONS.get(code, 'not in the manual')})", code
            )
        return reply

    def _wait_for_silence(self) -> None:
        deadline_s = self._clock.now_s() + _ECHO_S
        while self._take(2 * self._gap_s) and self._clock.now_s() < deadline_s:
            pass

    def _take(self, timeout_s: float) -> bytes:
        try:
            return self._line.read(timeout_s)
        except ConnectionLostError:
            self.lost = True
            raise

    def _put(self, data: bytes) -> None:
        try:
            self._line.write(data)
        except ConnectionLostError:
            self.lost = True
            raise


def _fits(request: ModbusPDU, reply: ModbusPDU) -> bool:
    if isinstance(reply, ExceptionResponse):
        return reply.function_code & 0x7F == request.function_code
    if reply.function_code != request.function_code:
        return False
    if isinstance(request, ReadHoldingRegistersRequest):
        return len(reply.registers) == request.count
    return reply.address == request.address and list(reply.registers) == list(request.registers)
