"""A bench in another process, as a user starts one in another terminal."""

import contextlib
import select
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

MILL = (sys.executable, "-m", "cli.main")


@dataclass(frozen=True)
class ServedBench:
    """`mill emulate`, ready: its rig file is written."""

    process: subprocess.Popen[bytes]
    rig_file: Path
    truth_file: Path
    announced: str


@contextlib.contextmanager
def served_bench(folder: Path, words: Sequence[str] = ()) -> Iterator[ServedBench]:
    """Serve a bench until the with-statement ends."""
    rig_file, truth_file = folder / "rig.toml", folder / "truth.json"
    command = [*MILL, "emulate", "--rig-out", str(rig_file), "--truth-out", str(truth_file), "--until-stdin-closes"]
    pipe = subprocess.PIPE
    with subprocess.Popen([*command, *words], stdin=pipe, stdout=pipe, bufsize=0) as process:
        try:
            yield ServedBench(process, rig_file, truth_file, line_from(process.stdout))
            process.communicate(timeout=20.0)
        finally:
            process.kill()


def line_from(stream: IO[bytes] | None, timeout_s: float = 120.0) -> str:
    """The next line of an unbuffered pipe; a child that stays silent fails the test."""
    assert stream is not None
    assert select.select([stream], [], [], timeout_s)[0], f"no line for {timeout_s:g} s"
    return stream.readline().decode()
