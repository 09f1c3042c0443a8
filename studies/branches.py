"""One run, gone on with in many ways: at a moment the process forks, and in the branch something else happens.

A branch has the whole state of the run, of every board and of the bone, and leaves the trunk as it was. It writes to a
copy of the record, tells its figures through a file, and ends without returning.
"""

import json
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2

from drivers.clock import Clock
from milling.record import RunRecorder

Figures = dict[str, Any]


class BranchingRecorder(RunRecorder):
    """A record that can be left behind in the trunk."""

    def __init__(self, folder: Path, header: Mapping[str, Any], clock: Clock) -> None:
        """As ``RunRecorder``, with the pictures that a later run needs."""
        super().__init__(folder, header, clock)
        self.told = 0
        """How many events there were."""

    def event(self, kind: str, **fields: Any) -> None:
        """Append one event."""
        super().event(kind, **fields)
        self.told += 1

    def branch_to(self, folder: Path) -> None:
        """Go on in a copy; what another process writes to the old one does not concern this one any more."""
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.folder, folder)
        self._lines.go_on_in(folder / "events.jsonl")
        self.folder = folder


def one_thread() -> None:
    """Before the first branch: a fork takes one thread along, and a pool without its threads waits for ever."""
    cv2.setNumThreads(0)


def branch(file: Path, grow: Callable[[], Figures | None]) -> bool:
    """Fork, and wait until the branch has ended; whether this is the branch.

    In the branch, ``grow`` is called: where it tells figures, they are the branch's, and it ends with them. Where it
    tells None it has only planted something: this returns True, the caller goes on, and must call ``end`` at last.
    """
    sys.stdout.flush()
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        return False
    try:
        figures = grow()
    except BaseException:
        fall(file)
    if figures is not None:
        end(file, figures)
    return True


def end(file: Path, figures: Figures) -> None:
    """End a branch with its figures."""
    scratch = file.with_suffix(".new")
    scratch.write_text(json.dumps(figures, allow_nan=False), encoding="utf-8")
    scratch.replace(file)
    os._exit(0)


def fall(file: Path) -> None:
    """End a branch that failed, leaving why."""
    file.with_suffix(".error").write_text(traceback.format_exc(), encoding="utf-8")
    os._exit(1)
