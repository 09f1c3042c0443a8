"""What the driver tests share."""

from collections.abc import Iterator

import pytest
from grbl_wire import Wired, homed


@pytest.fixture(params=["gnea", "grblhal"])
def on_wire(request: pytest.FixtureRequest) -> Iterator[Wired]:
    """A homed controller, its wire and its board."""
    controller, line, bench = homed(request.param)
    yield controller, line, bench
    line.change = lambda line: line
    controller.close()
