"""The conversation with one GRBL controller: lines and their acknowledgements, reports, resets, and what latches.

One line at a time waits for its acknowledgement, so that a refusal belongs to the call that caused it and the receive
buffer cannot overflow; status queries are not lines and take no room there.
"""

from collections.abc import Callable

from drivers.clock import Clock
from drivers.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.motion.grbl import protocol
from drivers.motion.grbl.codes import alarm_meaning, alarm_words, error_words
from drivers.motion.latch import LatchingLine
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


class GrblSession(LatchingLine):
    """Speaks to one controller over one line."""

    def __init__(self, line: SerialLine, clock: Clock, *, reply_s: float = REPLY_S) -> None:
        """Wait ``reply_s`` for each report."""
        super().__init__(line, clock, stop=protocol.HOLD + protocol.RESET)
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
    def has_unacknowledged(self) -> bool:
        """Whether a line was sent that the controller has neither taken nor refused."""
        return bool(self._unacknowledged)

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
        self._release(halts)
        self.check()

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

    def _receive(self, data: bytes) -> None:
        for message in self._parser.feed(data):
            self._take(message)

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
