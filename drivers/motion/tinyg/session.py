"""The conversation with one g2core board: lines and their replies, reports, what the board finds by itself.

The board takes five lines ahead and one more for each reply. Here one waits at a time, so that a refusal belongs to the
call that caused it. JSON lines pass by waiting G-code in the board, so that a status query is answered in any state.

A G-code line carries a checksum, and the reply repeats the line as the board received it. What was not received as it
was written stops the machine.
"""

from collections.abc import Callable
from typing import Any

from drivers.clock import Clock
from drivers.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from drivers.motion.latch import LatchingLine
from drivers.motion.tinyg import protocol
from drivers.motion.tinyg.codes import JOB_KILLED, alarm_words, keeps_position, status_words
from drivers.motion.transport import SerialLine

REPLY_S = 0.1
"""A report is due 2-5 ms after the query; three missed ones end a motion within 0.3 s."""
BROKEN_REPORT_S = 0.25
"""After a broken report the wire is left alone this long before the next query."""
MISSED_REPLIES = 3
QUIET_S = 0.05
"""Silence after which a board that was stopped has said what it had to say."""
REST_S = 3.0
"""Longer than any hold takes to stand."""
LAST_NUMBER = 99_999
SPEAK = b'\n{"clear":null}\n{"ej":1}\n{"jv":5}\n'
"""Has a board answer that is in text mode, or silent, or has just been switched on."""

AT_REST = frozenset({protocol.READY, protocol.ALARM, protocol.STOP, protocol.END, protocol.SHUTDOWN})
MOVING = frozenset({protocol.RUN, protocol.PROBE, protocol.CYCLE, protocol.HOMING, protocol.JOG})


class TinyGSession(LatchingLine):
    """Speaks to one board over one line."""

    def __init__(self, line: SerialLine, clock: Clock, *, reply_s: float = REPLY_S) -> None:
        """Wait ``reply_s`` for each report."""
        super().__init__(line, clock, stop=protocol.KILL_JOB)
        self._reply_s = reply_s
        self._parser = protocol.Parser()
        self._awaited: str | None = None
        self._answer: protocol.Reply | None = None
        self._settles = True
        self._heard = 0
        self._strikes = 0
        self._reports = 0
        self._number = 0
        self.on_report: Callable[[protocol.Report], None] = lambda _report: None
        self.upset: str | None = None
        """The queue is not what the host thinks it is. Dropping the queue, or homing, releases it."""
        self.report: protocol.Report | None = None
        self.report_time_s = 0.0

    @property
    def has_unanswered(self) -> bool:
        """Whether a line was sent that the board has neither taken nor refused."""
        return self._awaited is not None

    def command(self, text: str, key: str, timeout_s: float = 1.0) -> dict[str, Any]:
        """Send one line, and wait for the reply that holds ``key``; its body.

        Raises:
            DeviceFaultError: refused, or a fault latched meanwhile.
            DeviceTimeoutError: neither taken nor refused in time.
        """
        self.check()
        answer = self._exchange(text, key, timeout_s)
        if self._is_halted:
            # The line may have been written just after the halt, by which the board was idle and open to it.
            self.urgent(protocol.KILL_JOB)
        self.check()
        if answer is None:
            self.upset = f"{text!r} was neither taken nor refused within {timeout_s:g} s"
            raise DeviceTimeoutError(f"{self.name}: {self.upset}; flush() drops it, or look at the cable")
        if answer.status:
            self.upset = f"{text!r} was refused with {status_words(answer.status)}"
            raise DeviceFaultError(f"{self.name}: {self.upset}; flush() first, then send it again")
        return dict(answer.body)

    def gcode(self, block: str, timeout_s: float = 1.0) -> None:
        """Send one G-code block with number and checksum, and compare what the board received.

        Raises:
            DeviceFaultError: refused, received as something else, or a fault latched meanwhile.
            DeviceTimeoutError: neither taken nor refused in time.
        """
        self._number = self._number % LAST_NUMBER + 1
        line = protocol.numbered(self._number, block)
        received = self.command(line, "gc", timeout_s)["gc"]
        if received not in (line, line.partition("*")[0]):
            self.urgent(protocol.KILL_JOB)
            self.latch(f"{line!r} was received as {received!r}, and the motion killed", position_lost=False)
            self.check()

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
                report = self.report
            if report is not None:
                return report
        raise self._silent()

    def try_query(self) -> protocol.Report | None:
        """One query; None without a whole report in time."""
        # What was said before the question is no answer to it.
        self.pump(0.0)
        seen, strikes, fault = self._reports, self._strikes, self.fault
        self.urgent(protocol.query("sr").encode() + b"\n")
        asked_s = self._clock.now_s()
        self.pump_until(
            lambda: self._reports > seen or self._strikes > strikes or self.fault is not fault, self._reply_s
        )
        if self._reports > seen:
            if self._is_halted and self.report is not None and self.report.stat in MOVING:
                # The bytes of the halt did not arrive.
                self.urgent(protocol.KILL_JOB)
            return self.report
        if self._strikes > strikes:
            if self._strikes > 1:
                raise ProtocolError(f"{self.name}: {self.upset}; look at the cable and its shielding")
            self.pump_until(lambda: self._reports > seen, asked_s + BROKEN_REPORT_S - self._clock.now_s())
        return None

    def settle(self) -> None:
        """Bring the board to rest, with nothing queued and no alarm. What has latched stays.

        Raises:
            DeviceTimeoutError: no board answers, or it does not come to rest.
            DeviceFaultError: it is in a state that no host can end.
        """
        self._settles = True
        deadline_s = self._clock.now_s() + REST_S
        self.urgent(protocol.KILL_JOB)
        self._wait_for_quiet()
        while (stat := self._stat()) not in AT_REST:
            if stat in (protocol.PANIC, protocol.INTERLOCK):
                raise DeviceFaultError(
                    f"{self.name}: the board is in {'a panic' if stat == protocol.PANIC else 'its safety interlock'}; "
                    "look at the machine, then switch the board off and on"
                )
            if self._clock.now_s() >= deadline_s:
                raise DeviceTimeoutError(
                    f"{self.name}: not at rest {REST_S:g} s after its job was killed (state {stat}); stop the machine "
                    "by its power switch"
                )
            self.urgent(protocol.KILL_JOB)
            self.pump_until(lambda: False, 0.05)
        self._must(protocol.query("clear"), "clear")
        self._wait_for_quiet()
        self._settles = False
        self._strikes = 0
        self.upset = None

    def release(self, halts: int) -> None:
        """Forget what has latched, and the first ``halts`` halts.

        Raises:
            DeviceFaultError: there was one more, from another thread.
        """
        self._release(halts)
        self.check()

    def _stat(self) -> int:
        return int(self._must(protocol.query("stat"), "stat").get("stat", protocol.INITIALIZING))

    def _must(self, text: str, key: str) -> dict[str, Any]:
        """Ask until it answers; the session is settling, so that nothing else is on the wire."""
        for _ in range(MISSED_REPLIES):
            answer = self._exchange(text, key, max(self._reply_s, BROKEN_REPORT_S))
            if answer is not None and answer.status == 0:
                return dict(answer.body)
            self.urgent(SPEAK)
            self._wait_for_quiet()
        raise DeviceTimeoutError(
            f"{self.name}: no reply to {MISSED_REPLIES} times {text}; is this a g2core board, at {protocol.BAUD} baud? "
            "`mill devices` lists what is connected"
        )

    def _exchange(self, text: str, key: str, timeout_s: float) -> protocol.Reply | None:
        fault = self.fault
        self._awaited, self._answer = key, None
        self._line.write(text.encode("ascii") + b"\n")
        self.pump_until(lambda: self._answer is not None or self.fault is not fault, timeout_s)
        self._awaited = None
        return self._answer

    def _wait_for_quiet(self) -> None:
        # A board that reports by itself is never quiet.
        for _ in range(20):
            heard = self._heard
            self.pump(QUIET_S)
            if self._heard == heard:
                break

    def _silent(self) -> DeviceTimeoutError:
        return DeviceTimeoutError(
            f"{self.name}: no reply to {MISSED_REPLIES} status queries, {MISSED_REPLIES * self._reply_s:g} s in all; "
            "stop the machine by its power switch if it moves, then look at the cable and the board"
        )

    def _receive(self, data: bytes) -> None:
        for message in self._parser.feed(data):
            self._heard += 1
            self._take(message)

    def _take(self, message: protocol.Message) -> None:
        match message:
            case protocol.Report():
                self._strikes = 0
                self._reports += 1
                self.report = message
                self.report_time_s = self._clock.now_s()
                self.on_report(message)
            case protocol.Reply():
                self._take_reply(message)
            case protocol.Trouble(status, _) if not (self._stops_by_order and status == JOB_KILLED):
                self.latch(alarm_words(status), position_lost=not keeps_position(status))
            case protocol.Welcome():
                self.latch("the board was reset by somebody else or lost its power", position_lost=True)
            case protocol.Broken(line, _):
                self._strike(f"two broken lines in a row, the last one {line!r}")
            case _:
                pass

    def _take_reply(self, reply: protocol.Reply) -> None:
        if self._awaited is not None and (self._awaited in reply.body or "err" in reply.body):
            self._answer, self._awaited = reply, None
        elif reply.status:
            # What was garbled on its way to the board may have been a status query.
            self._strike(f"two refusals that no line was waiting for, the last with {status_words(reply.status)}")
        elif "sr" not in reply.body and not self._stops_by_order:
            self.upset = f"a reply that no line was waiting for: {sorted(reply.body)}"

    def _strike(self, words: str) -> None:
        if not self._stops_by_order:
            self._strikes += 1
            if self._strikes > 1:
                self.upset = words

    @property
    def _stops_by_order(self) -> bool:
        """Whether replies to lines that nobody waits for any more, and a killed job, are what is due."""
        return self._settles or self._is_halted
