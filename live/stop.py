"""The page's only power: to stop the motion, with no step of the control loop in between."""

import contextlib
import os
import signal
from collections.abc import Callable

from milling import supervisor

ASK_AFTER_S = 2.0
"""The supervisor's stop takes a second, and the run hears of it by itself; asked meanwhile, it would lift at the same
time on the same wire. A run that has said nothing by then hears it from here."""


class Stop:
    """Tells the supervisor at once, and asks the run to end in good order."""

    def __init__(self, run_fd: int | None) -> None:
        """``run_fd`` is a pidfd of the process that mills; None where nothing runs."""
        self._run_fd = run_fd
        self._supervisor: int | None = None
        self._asked = False

    @property
    def possible(self) -> bool:
        """Whether there is anything to stop."""
        return self._run_fd is not None or self._supervisor is not None

    @property
    def immediate(self) -> bool:
        """Whether a supervisor stops the motion whatever the run is doing."""
        return self._supervisor is not None

    def take(self, supervisor_fd: int) -> None:
        """The supervisor's pipe, which is this object's from now on."""
        self._forget_supervisor()
        self._supervisor = supervisor_fd

    def press(self, later: Callable[[float, Callable[[], None]], object]) -> None:
        """Stop. Never waits; may be pressed again and again, and the run is asked once.

        Args:
            later: calls a function after so many seconds, as ``loop.call_later``.
        """
        told = False
        if self._supervisor is not None:
            with contextlib.suppress(OSError):
                os.write(self._supervisor, supervisor.STOP + b"\n")
                told = True
        if not self._asked:
            self._asked = True
            if told:
                later(ASK_AFTER_S, self._ask)
            else:
                self._ask()

    def settle(self) -> None:
        """The run is making the machine safe by itself, and is not asked any more."""
        self._asked = True
        if self._run_fd is not None:
            os.close(self._run_fd)
            self._run_fd = None

    def close(self) -> None:
        """Let go of everything: the supervisor must see that the run is gone."""
        self._forget_supervisor()
        self.settle()

    def _ask(self) -> None:
        if self._run_fd is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._run_fd, signal.SIGINT)

    def _forget_supervisor(self) -> None:
        if self._supervisor is not None:
            os.close(self._supervisor)
            self._supervisor = None
