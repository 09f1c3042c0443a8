"""The table of (bytes, reply) typed from the GRBL manuals, on the board."""

import runpy
from pathlib import Path

import pytest
from grbl_bench import unlocked

ROWS = runpy.run_path(str(Path(__file__).parent.parent / "data" / "grbl_table.py"))["ROWS"]
CASES = [(dialect, data, reply) for dialects, data, reply in ROWS for dialect in dialects]


@pytest.mark.parametrize(("dialect", "data", "reply"), CASES, ids=[f"{d}-{b!r:.40}" for d, b, _ in CASES])
def test_reply(dialect, data, reply):
    host = unlocked(dialect, {})
    assert host.ask(data, 0.1) == reply
