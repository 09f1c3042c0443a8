"""A reader who follows a page word for word, in a folder of their own, with a shell."""

import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from pages import ROOT, Block, Step, is_shown

from drivers.clock import SystemClock

StandIn = Callable[[Path], None]
"""What a command that takes minutes would leave in the folder."""
LONGEST_S = 900.0
SOON_S = 240.0


class Reader:
    """Has as many terminals as the page asks for; each command runs in a bash of its own."""

    def __init__(self, folder: Path, stand_ins: Mapping[str, StandIn] | None = None) -> None:
        """Without ``stand_ins`` all is done that the page says; with them nothing that takes minutes is."""
        self._folder = folder
        self._stand_ins = stand_ins
        self._going_on: dict[str, subprocess.Popen[bytes]] = {}
        self._said: dict[str, str] = {}
        self._environment = _environment(folder)

    def follow(self, block: Block) -> None:
        """Type what it says; fail where something else is shown."""
        if block.takes_long and self._stand_ins is not None:
            for command, leave in self._stand_ins.items():
                if any(step.command.startswith(command) for step in block.steps):
                    leave(self._folder)
            return
        for step in block.steps:
            if not step.command:
                self._wait_for(block, step)
            elif block.goes_on:
                self._start(block, step)
            else:
                self._run(block, step)

    def _run(self, block: Block, step: Step) -> None:
        done = subprocess.run(
            ["bash", "-c", step.command],
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=LONGEST_S,
            check=False,
        )
        said = plain(done.stdout)
        assert is_shown(step.shown, said), told(block, step, said)
        assert done.returncode == block.exit_code, told(block, step, said, f"exit code {done.returncode}")

    def _start(self, block: Block, step: Step) -> None:
        self._end(block.terminal)
        self._said[block.terminal] = ""
        self._going_on[block.terminal] = subprocess.Popen(
            ["bash", "-c", step.command],
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            bufsize=0,
            start_new_session=True,
        )
        self._wait_for(block, step)

    def _wait_for(self, block: Block, step: Step) -> None:
        """Until the terminal shows this; what was said before is not looked at again."""
        stream = self._going_on[block.terminal].stdout
        assert stream is not None
        clock = SystemClock()
        deadline_s = clock.now_s() + SOON_S
        while not is_shown(step.shown, said := self._said[block.terminal], so_far=True):
            left_s = max(0.0, deadline_s - clock.now_s())
            assert select.select([stream], [], [], left_s)[0], told(block, step, said)
            more = stream.read(65536)
            assert more, told(block, step, said, "and it ended")
            self._said[block.terminal] += plain(more)
        self._said[block.terminal] = ""

    def _end(self, terminal: str) -> None:
        """Ctrl-C, unless it has ended."""
        process = self._going_on.pop(terminal, None)
        if process is None:
            return
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
        try:
            process.communicate(timeout=60.0)
        finally:
            process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for terminal in reversed(list(self._going_on)):
            self._end(terminal)


def plain(said: bytes) -> str:
    """Without colours, and with what a progress bar wrote over left out."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", said.decode(errors="replace"))


def told(block: Block, step: Step, said: str, more: str = "") -> str:
    """For the message of a failing test."""
    return f"{block.page}: $ {step.command}\n--- the page shows\n{step.shown}--- it said\n{said}{more}"


def _environment(folder: Path) -> dict[str, str]:
    """As after `. .venv/bin/activate`: `mill` is this checkout's."""
    tools = folder.with_name(folder.name + "-bin")
    tools.mkdir()
    command = tools / "mill"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m cli.main "$@"\n')
    command.chmod(0o755)
    path = f"{tools}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "TERM": "dumb", "COLUMNS": "80"}
