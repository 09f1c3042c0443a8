import signal
from pathlib import Path

import pytest

# A shell that runs tests in the background has them ignore Ctrl-C, and what they start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rig",
        type=Path,
        default=None,
        metavar="FILE",
        help="run the conformance tests on the hardware of this rig file as well; the machine moves",
    )
