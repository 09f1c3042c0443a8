"""The `mill` command in this process, as a shell would call it."""

import signal

import pytest

from cli.main import main


def mill(*words: str) -> int:
    """Run `mill WORDS...` and return its exit code."""
    before = signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["mill", *words])
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
        finally:
            signal.signal(signal.SIGTERM, before)
    return 0
