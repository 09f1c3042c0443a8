from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rig",
        type=Path,
        default=None,
        metavar="FILE",
        help="run the conformance tests on the hardware of this rig file as well; the machine moves",
    )
