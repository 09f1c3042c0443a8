"""The conversation with one GRBL controller: lines and their acknowledgements, reports, resets, and what latches.

There is no thread. Whoever calls pumps the wire, and everything that is counted or latched is its own. Another thread
may call ``urgent()`` and ``halt()`` at the same time: they write at once, and all that ``halt()`` leaves behind is two
marks, one before its bytes and one behind them (docs/decisions/0004). One line at a time waits for its
acknowledgement, so that a refusal belongs to the call that caused it and the receive buffer cannot overflow; status
queries are not lines and take no room there.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from drivers.clock import Clock
from drivers.errors import ConnectionLostError, DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.motion.grbl import protocol
from drivers.motion.grbl.codes import alarm_meaning, alarm_words, error_words
from drivers.motion.transport import SerialLine

REPLY_S = 0.1
"""A report is due 4-8 ms after the query; a loaded host or a full wire may add to that. Three missed ones end a motion
within 0.3 s, and one leaves the spindle's heartbeat alive."""
BROKEN_REPORT_S = 0.25
"""After a broken report the wire is left alone this long before the next query."""
MISSED_REPLIES = 3
QUIET_S = 0.05
"""Silence after which a controller that was reset has said what it had to say."""
BANNER_S = 2.5
"""A reset in motion takes 1.1h half a second, an Arduino that DTR resets two seconds."""
_PUMP_S = 0.05


@dataclass(frozen=True)
class Fault:
    """What latched."""

    words: str
    position_lost: bool


_HALTED = Fault("halted by halt()", position_lost=False)


class GrblSession:
    """Speaks to one controller over one line."""

    def __init__(self, line: SerialLine, clock: Clock, *, reply_s: float = REPLY_S) -> None:
        """Wait ``reply_s`` for each report."""
        self._line = line
        self._clock = clock
        self._reply_s = reply_s
        self._parser = protocol.Parser()
        self._unacknowledged: list[str] = []
        self._refusal: str | None = None
        self._replies: list[protocol.Message] = []
        self._heard = 0
        self._expects_banner = True
        self._banners = 0
        self._strikes = 0
        self._reports = 0
        self._unreadable_reports = 0
        self._lost: str | None = None
        self._latched: Fault | None = None
        # Appending is atomic and counting up is not, and two threads may halt at once.
        self._halts_begun: list[None] = []
        self._halts_done: list[None] = []
        self._halts_released = 0
        self.on_report: Callable[[protocol.Report], None] = lambda _report: None
        self.upset: str | None = None
        """The queue is not what the host thinks it is. Dropping the queue, or homing, releases it."""
        self.drill_stopped = False
        """The drill was stopped within a hold, so that going on would start it. Dropping the queue releases it."""
        self.tolerated_alarm: int | None = None
        """An alarm that the caller brings about and deals with."""
        self.report: protocol.Report | None = None
        self.report_time_s = 0.0

    @property
    def name(self) -> str:
        """The line's name, for messages."""
        return self._line.name

    @property
    def descriptor(self) -> int | None:
        """The line's open file, if another process may be handed one."""
        return self._line.descriptor

    @property
    def is_lost(self) -> bool:
        """Whether the wire is known to be gone."""
        return self._lost is not None

    @property
    def has_unacknowledged(self) -> bool:
        """Whether a line was sent that the controller has neither taken nor refused."""
        return bool(self._unacknowledged)

    @property
    def fault(self) -> Fault | None:
        """Latched: the controller stopped, or was stopped. Homing releases it."""
        return self._latched or (_HALTED if self._is_halted else None)

    @property
    def halts(self) -> int:
        """How many halts are over. Who releases asks first thing, so that none that comes later is forgotten."""
        return len(self._halts_done)

    def urgent(self, data: bytes) -> None:
        """Put real-time bytes on the wire now. From any thread."""
        self._line.write(data)

    def halt(self) -> None:
        """Feed hold and reset in one write, and latch. From any thread.

        What happens to the position the controller says by itself: it raises ALARM:3 when it was moving.
        """
        # Before the bytes, so that no line is written behind them unseen.
        self._halts_begun.append(None)
        try:
            self._line.write(protocol.HOLD + protocol.RESET)
        finally:
            # A release that comes between the two releases nothing: the bytes may still reach the wire behind it.
            self._halts_done.append(None)

    def latch(self, words: str, *, position_lost: bool) -> None:
        """Latch a fault; the first one stays, but a position that is lost later is lost."""
        first = self.fault or Fault(words, position_lost)
        self._latched = replace(first, position_lost=first.position_lost or position_lost)

    def check(self) -> None:
        """Raise what has latched.

        Raises:
            ConnectionLostError: the wire is gone.
            DeviceFaultError: a fault is latched.
        """
        if self._lost is not None:
            raise ConnectionLostError(self._lost)
        if self.fault is not None:
            kept = "lost" if self.fault.position_lost else "kept"
            raise DeviceFaultError(f"{self.name}: {self.fault.words}; position {kept}; home() releases the latch")

    def pump(self, timeout_s: float) -> None:
        """Take in what has arrived, waiting up to ``timeout_s`` for the first byte."""
        if self._lost is not None:
            raise ConnectionLostError(self._lost)
        try:
            data = self._line.read(timeout_s)
        except ConnectionLostError as error:
            self._lost = str(error)
            self.latch("connection lost", position_lost=True)
            raise
        for message in self._parser.feed(data):
            self._take(message)

    def pump_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Pump until ``done()`` or the time is over; whether it was done. What arrived in time always counts."""
        deadline_s = self._clock.now_s() + timeout_s
        while not done():
            remaining_s = deadline_s - self._clock.now_s()
            self.pump(min(_PUMP_S, max(0.0, remaining_s)))
            if remaining_s <= 0:
                return done()
        return True

    def command(self, text: str, timeout_s: float = 1.0) -> list[protocol.Message]:
        """Send one line and wait for its ``ok``; what the controller said meanwhile.

        Raises:
            DeviceFaultError: refused, or a fault latched meanwhile.
            DeviceTimeoutError: neither taken nor refused in time.
        """
        self.check()
        self._replies.clear()
        self._refusal = None
        self._unacknowledged.append(text)
        self._line.write(text.encode("ascii") + b"\n")
        self.pump_until(lambda: not self._unacknowledged or self.fault is not None, timeout_s)
        if self._is_halted:
            # The line may have been written just after the halt, by which the controller was idle and open to it.
            self.urgent(protocol.HOLD + protocol.RESET)
        self.check()
        if self._unacknowledged:
            self.upset = f"{text!r} was neither taken nor refused within {timeout_s:g} s"
            raise DeviceTimeoutError(f"{self.name}: {self.upset}; flush() drops it, or look at the cable")
        if self._refusal is not None:
            raise DeviceFaultError(f"{self.name}: {text!r} refused with {self._refusal}")
        return list(self._replies)

    def query(self) -> protocol.Report:
        """A fresh status report, or the last one when a fault latches instead.

        Raises:
            DeviceTimeoutError: three queries without a reply.
            ProtocolError: one broken report is forgiven, a second in a row is not.
        """
        fault = self.fault
        for _ in range(MISSED_REPLIES):
            report = self.try_query()
            if report is None and self.fault is not fault:
                # 1.1h answers no query in an alarm.
                report = self.report
            if report is not None:
                return report
        raise self._silent()

    def try_query(self) -> protocol.Report | None:
        """One query; None without a whole report in time."""
        # What was said before the question is no answer to it.
        self.pump(0.0)
        seen, strikes, fault = self._reports, self._strikes, self.fault
        self.urgent(protocol.STATUS)
        asked_s = self._clock.now_s()
        self.pump_until(
            lambda: self._reports > seen or self._strikes > strikes or self.fault is not fault, self._reply_s
        )
        if self._reports > seen:
            return self.report
        if self._strikes > strikes:
            if self._strikes > 1:
                raise ProtocolError(f"{self.name}: {self.upset}; look at the cable, the baud rate and its shielding")
            self.pump_until(lambda: self._reports > seen, asked_s + BROKEN_REPORT_S - self._clock.now_s())
        return None

    def reset(self) -> None:
        """0x18, and wait for the banner, once more if none comes.

        Lines on their way and the planner's queue are gone afterwards. A fault that latches on the way stays.

        Raises:
            DeviceTimeoutError: no banner.
        """
        seen = self._banners
        self._expects_banner = True
        for _ in range(2):
            self.urgent(protocol.RESET)
            if self.pump_until(lambda: self._banners > seen, BANNER_S):
                break
        else:
            raise DeviceTimeoutError(
                f"{self.name}: no GRBL banner within {2 * BANNER_S:g} s of two resets; is this the motion controller, "
                f"at {protocol.BAUD} baud? `mill devices` lists what is connected"
            )
        # grblHAL may print its banner twice. Whatever it still has to say comes before it answers a question.
        self._wait_for_quiet()
        self._wait_for_an_answer()
        self._expects_banner = False
        self._unacknowledged.clear()
        self._strikes = 0
        self.upset = None
        self.drill_stopped = False

    def reset_and_release(self, halts: int) -> None:
        """Reset, and forget what has latched before or because of it, and the first ``halts`` halts.

        Raises:
            DeviceFaultError: there was one more, from another thread.
        """
        self.reset()
        self._latched = None
        self._halts_released = halts
        self.check()

    def close(self) -> None:
        """Give the line back."""
        self._lost = self._lost or f"{self.name}: the controller was closed; open it again"
        self._line.close()

    @property
    def _is_halted(self) -> bool:
        return len(self._halts_begun) > self._halts_released

    @property
    def _is_resetting(self) -> bool:
        """Whether a banner, half a line before it, and lines without acknowledgement are what is due."""
        return self._expects_banner or self._is_halted

    def _wait_for_quiet(self) -> None:
        # A controller that reports by itself is never quiet.
        for _ in range(20):
            heard = self._heard
            self.pump(QUIET_S)
            if self._heard == heard:
                break

    def _wait_for_an_answer(self) -> None:
        # Any report will do, also one without a machine position: $10 is put right once the settings are known.
        fault, seen = self.fault, self._reports + self._unreadable_reports

        def answered() -> bool:
            return self._reports + self._unreadable_reports > seen or self.fault is not fault

        for _ in range(MISSED_REPLIES):
            self.urgent(protocol.STATUS)
            if self.pump_until(answered, self._reply_s):
                return
        raise self._silent()

    def _silent(self) -> DeviceTimeoutError:
        return DeviceTimeoutError(
            f"{self.name}: no reply to {MISSED_REPLIES} status queries, {MISSED_REPLIES * self._reply_s:g} s in all; "
            "stop the machine by its power switch if it moves, then look at the cable and the controller"
        )

    def _take(self, message: protocol.Message) -> None:
        self._heard += 1
        if not isinstance(message, protocol.Report):
            self._replies.append(message)
        match message:
            case protocol.Report():
                self._strikes = 0
                self._reports += 1
                self.report = message
                self.report_time_s = self._clock.now_s()
                self.on_report(message)
            case protocol.Ok() | protocol.Refused():
                self._acknowledge(message)
            case protocol.Alarm(code) if code != self.tolerated_alarm:
                self.latch(alarm_words(code), position_lost=alarm_meaning(code).position_lost)
            case protocol.Welcome():
                self._banners += 1
                if not self._is_resetting:
                    self.latch("the controller was reset by somebody else or lost its power", position_lost=True)
            case protocol.Broken(line, _) if self._is_resetting:
                self._unreadable_reports += line.startswith("<")
            case protocol.Broken(line, _):
                self._strikes += 1
                if self._strikes > 1:
                    self.upset = f"two broken lines in a row, the last one {line!r}"
            case _:
                pass

    def _acknowledge(self, message: protocol.Ok | protocol.Refused) -> None:
        if self._is_resetting:
            return
        if not self._unacknowledged:
            self.upset = "an acknowledgement that no line was waiting for"
            return
        text = self._unacknowledged.pop(0)
        if isinstance(message, protocol.Refused):
            self._refusal = error_words(message.code)
            self.upset = f"{text!r} was refused with {self._refusal}"
