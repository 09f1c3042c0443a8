"""A `mill` command in another process, watched line by line, as a person watches it in a terminal."""

import contextlib
import select
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass

from served_bench import MILL

from drivers.clock import SystemClock


@dataclass
class Command:
    """A running command, and what it has said so far."""

    process: subprocess.Popen[bytes]
    out: str = ""
    err: str = ""

    def wait_for_line(self, start: str, timeout_s: float) -> str:
        """The next line that begins with ``start``; a command that is silent or ends before fails the test."""
        stdout, clock = self.process.stdout, SystemClock()
        assert stdout is not None
        deadline_s = clock.now_s() + timeout_s
        while True:
            left_s = deadline_s - clock.now_s()
            if left_s <= 0 or not select.select([stdout], [], [], left_s)[0]:
                raise AssertionError(f"no line {start!r} within {timeout_s:g} s\n{self.said}")
            line = stdout.readline().decode()
            self.out += line
            if line.startswith(start):
                return line
            if not line:
                code = self.end(timeout_s)
                raise AssertionError(f"ended with exit code {code} before a line {start!r}\n{self.said}")

    def end(self, timeout_s: float) -> int:
        """The exit code; ``out`` and ``err`` are complete afterwards."""
        try:
            out, err = self.process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {timeout_s:g} s\n{self.said}") from None
        self.out += out.decode()
        self.err += err.decode()
        return self.process.returncode

    @property
    def said(self) -> str:
        """For the message of a failing test."""
        return f"--- stdout\n{self.out}\n--- stderr\n{self.err}"


@contextlib.contextmanager
def started(*words: str) -> Iterator[Command]:
    """Start `mill WORDS...`; it is killed if the with-statement ends before it does."""
    pipe = subprocess.PIPE
    with subprocess.Popen([*MILL, *words], stdout=pipe, stderr=pipe, bufsize=0) as process:
        try:
            yield Command(process)
        finally:
            process.kill()
