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

    def comes_to(self, start: str, timeout_s: float) -> bool:
        """Whether it says a line that begins with ``start`` before it ends; silence for so long fails the test."""
        stdout, clock = self.process.stdout, SystemClock()
        assert stdout is not None
        deadline_s = clock.now_s() + timeout_s
        line = " "
        while line:
            left_s = max(0.0, deadline_s - clock.now_s())
            assert select.select([stdout], [], [], left_s)[0], f"no line {start!r} in {timeout_s:g} s\n{self.said}"
            line = stdout.readline().decode()
            self.out += line
            if line.startswith(start):
                return True
        return False

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
