"""A controller that the page of a command may stop, up to the command's last moment with it."""

import os
import pty
import tty
from collections.abc import Iterator

import pytest

from cli.live import stoppable
from drivers.clock import SystemClock
from drivers.errors import SafetyStop
from drivers.motion.interface import MotionController, StopPath
from milling import supervisor


class Controller:
    """All that is asked of it here is its stop path."""

    def __init__(self, fd: int) -> None:
        self.stop_path = StopPath(fd, ((b"!", 0.0),))


class Button:
    """The page: it gets the supervisor's pipe."""

    stop_end = -1

    def hand_over_stop(self, stop_end: int) -> None:
        self.stop_end = stop_end

    def press(self) -> None:
        os.write(self.stop_end, supervisor.STOP + b"\n")


@pytest.fixture
def controller() -> Iterator[MotionController]:
    far, near = pty.openpty()
    tty.setraw(near)
    yield Controller(near)  # type: ignore[misc]
    os.close(near)
    os.close(far)


def test_a_stop_in_the_last_moment_ends_the_command(controller: MotionController) -> None:
    page = Button()
    with (
        pytest.raises(SafetyStop, match="supervisor: it has stopped the motion: told to stop; home next"),
        stoppable(controller, page, SystemClock()),  # type: ignore[arg-type]
    ):
        page.press()


def test_without_a_stop_it_ends_in_peace(controller: MotionController) -> None:
    with stoppable(controller, Button(), SystemClock()):  # type: ignore[arg-type]
        pass
