"""Whether a record is still what was written: events, header, result, pictures, labels.

A chain tells every change by somebody who did not make all of it anew. Who can write the folder can also do that, and
then only its new head betrays it: note heads where nobody can change them (a laboratory notebook, an exported table).
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.checked_lines import ChainEnd
from drivers.errors import ConfigError
from milling.labels import read_labels
from milling.record import CHAIN, Run, read_run

WHOLE, CUT_OFF, UNCHAINED, CHANGED = "whole", "cut off", "no chain", "changed"


@dataclass(frozen=True)
class Verdict:
    """What was found. ``state`` is one of the words above, ``reasons`` say why it is not ``WHOLE``."""

    state: str
    reasons: tuple[str, ...] = ()
    chain: ChainEnd | None = None
    files: int = 0
    """Pictures and other files that are as the events tell."""


def verify(folder: Path) -> Verdict:
    """Read all of it again.

    ``CUT_OFF``: the run was killed, so that nothing tells where its events ended; what is there is as it was written.
    ``UNCHAINED``: written before records were chains, or packed for a maintainer; nothing can be said.
    """
    try:
        run = read_run(folder)
    except ConfigError as error:
        return Verdict(CHANGED, (str(error),))
    files = [event for event in run.events if "sha256" in event]
    changed = [words for event in files if (words := _file(folder, event))]
    chain, good = run.chain, len(files) - len(changed)
    changed += [*_result(run), *_labels(folder)]
    if changed:
        return Verdict(CHANGED, tuple(changed), chain, good)
    if chain is None:
        return Verdict(UNCHAINED, ("its lines have sums only: whether somebody changed it cannot be told",), None, good)
    if run.result is None:
        why = run.damage or "killed: whether events are missing at its end cannot be told"
        return Verdict(CUT_OFF, (why,), chain, good)
    return Verdict(WHOLE, (), chain, good)


def _result(run: Run) -> list[str]:
    """The result stands in the last event as well."""
    if run.result is None or run.chain is None:
        return []
    told = [event for event in run.events if event["kind"] == "outcome"]
    result = {key: value for key, value in run.result.items() if key != CHAIN}
    if CHAIN not in run.result:
        return ["result.json does not tell where the events end"]
    if not told or {key: told[-1].get(key) for key in result} != result:
        return ["result.json tells otherwise than the events"]
    return []


def _labels(folder: Path) -> list[str]:
    try:
        read_labels(folder)
    except ConfigError as error:
        return [str(error)]
    return []


def _file(folder: Path, event: dict[str, Any]) -> str:
    path = folder / str(event["file"])
    if not path.is_file():
        return f"{event['file']} is missing"
    same = hashlib.sha256(path.read_bytes()).hexdigest() == event["sha256"]
    return "" if same else f"{event['file']} was changed"
